"""Compiles the numba loops of prior and trajectory once, before any node needs them, and reports progress.

Two processes share the work: one compiles from the first stage of the prior onwards, the other from the last stage
backwards. They share the compiled loops through the cache on disk.
``python -I -m steadypose.nodes.graph.loops`` does only this.
"""

import fcntl
import gc
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TextIO

from steadypose.nodes.graph.process import own_command, own_environment
from steadypose.prior import loop_cache

COMPILED = {"prior", "trajectory"}  # names of the nodes that need compiled loops
WAIT_S = 600.0  # longest time to wait for another process that compiles, seconds. That process may be suspended.
SAY_S = 5.0  # interval between progress lines, seconds
_GARBAGE = 20_000
"""Garbage collector's threshold while compiling, objects. With Python's 700, collection takes a seventh of the time."""


def compile_from_the_beginning() -> None:
    """Clean a few frames with the default settings."""
    from steadypose.prior.clean.pipeline import load_loops
    from steadypose.prior.clean.settings import PriorSettings

    load_loops(PriorSettings())


def compile_from_the_end() -> None:
    """Run each network, the smoother's features, the pose solver and orientations separately.

    Importing the trajectory compiles its loops. The order lets the other process, which starts with the large bank of
    smoothers, find each loop compiled when it needs it.
    """
    import numpy as np

    from steadypose.prior.body.inverse_kinematics import fit_lengths, solve_pose
    from steadypose.prior.body.skeleton import REST_OFFSETS, REST_POSITIONS
    from steadypose.prior.clean.frame import Estimate
    from steadypose.prior.clean.rotations import Orient
    from steadypose.prior.clean.settings import OrientSettings
    from steadypose.prior.models.hgvae.faults import LiveFaultNet
    from steadypose.prior.models.hgvae.features import body_size, from_tracks, to_tracks
    from steadypose.prior.models.hgvae.inference import LiveHGVAE
    from steadypose.prior.models.mixture.inference import MixtureSmoother

    size, sigma = body_size(REST_OFFSETS[None]), np.array([0.02])
    hgvae = LiveHGVAE.load("default", max_batch=1)
    windows = np.tile(REST_POSITIONS, (1, hgvae.frames, 1, 1))
    windows[:, -5:, -1] = np.nan
    tracks = to_tracks(windows, size)
    found = hgvae.reconstruct(tracks.x, tracks.observed, sigma)
    from_tracks(found.mean, tracks, size)
    rotations, placed = solve_pose(REST_POSITIONS, REST_OFFSETS)
    fit_lengths(placed, REST_OFFSETS, np.ones(22))
    smoother = MixtureSmoother(delay=1, slots=1)
    smoother.skip(0.0)
    smoother.flush()
    LiveFaultNet.load("default", max_batch=1)(tracks.x, found.mean, found.sigma, tracks.observed, sigma)
    import steadypose.nodes.graph.trajectory_node  # noqa: F401

    deviations, state = np.full((1, 22), 0.02), np.zeros((1, 22), dtype=np.uint8)
    at_rest = Estimate(0.0, REST_POSITIONS[None], rotations[None], REST_OFFSETS[None], deviations, state)
    Orient(OrientSettings(), slots=1).update(at_rest)


def compile_part() -> None:
    """Entry point of a compiling process: does one of the two parts, and writes each finished loop's name to a pipe."""
    part, pipe = sys.argv[1:]
    gc.set_threshold(_GARBAGE)
    with open(int(pipe), "w", encoding="utf-8", buffering=1) as names:
        loop_cache.watchers.append(lambda name: print(name, file=names))
        {"beginning": compile_from_the_beginning, "end": compile_from_the_end}[part]()


def compile_missing(say: Callable[[str], None]) -> None:
    """Compile all loops that the nodes need and that are not on disk. Returns at once if none is missing.

    If they cannot be stored or compiled, it reports that and returns; each node then compiles them itself, or fails
    with the reason. ``say`` receives progress lines.
    """
    if loop_cache.is_complete():
        return
    folder = loop_cache.writable()
    if folder is None:
        loop_cache.warn_uncached(say)
        return
    with open(folder.parent / "lock", "w", encoding="utf-8") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            say("waiting for another process that compiles the loops")
            if not _locked(lock, WAIT_S):
                say(f"another process has been compiling the loops for {WAIT_S / 60:g} minutes: not waiting any longer")
                return
        if not loop_cache.is_complete():
            _compile(folder, say)


def _locked(file: TextIO, within_s: float) -> bool:
    ends = time.monotonic() + within_s
    while time.monotonic() < ends:
        with suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        time.sleep(0.1)
    return False


def _compile(folder: Path, say: Callable[[str], None]) -> None:
    started = reported = time.monotonic()
    there = {file.name for other in loop_cache.readable() for file in other.iterdir()} - {loop_cache.COMPLETE}
    if there:
        say("the program has changed since the loops were compiled: loading them, and compiling what is missing")
    else:
        say("compiling the loops for this processor, once; this takes about half a minute on two cores")
    ready: set[str] = set()
    reading, writing = os.pipe()
    with tempfile.TemporaryFile("w+") as errors:
        processes = [
            subprocess.Popen(
                own_command("steadypose.nodes.graph.loops:compile_part", part, str(writing)),
                pass_fds=[writing],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=errors,
                env=own_environment(),
            )
            for part in ("beginning", "end")
        ]
        os.close(writing)
        try:
            with open(reading, encoding="utf-8") as names:
                for name in names:
                    ready.add(name.strip())
                    if time.monotonic() - reported >= SAY_S:
                        reported = time.monotonic()
                        say(f"compiling {len(ready)} of {loop_cache.LOOPS}, once")
            statuses = [process.wait() for process in processes]
        finally:
            for process in processes:
                process.kill()
                process.wait()
        if any(statuses):
            errors.seek(0)
            last = (errors.read().strip().splitlines() or [f"status {max(statuses, key=abs)}"])[-1]
            say(f"the loops could not be compiled beforehand: {last}")
            return
    try:
        loop_cache.mark_complete(folder, ready)
    except OSError as error:
        say(f"compiled loops cannot be kept in {folder}: {error.strerror}")
        return
    loaded = f", loaded {len(ready & there)}" * bool(ready & there)
    say(f"compiled {len(ready - there)} loops{loaded} in {time.monotonic() - started:.0f} s, once")


if __name__ == "__main__":
    compile_missing(lambda line: print(line, file=sys.stderr, flush=True))
