"""Compiles the loops of prior and trajectory before anything waits for them, once, and says how far it is.

Two processes do it at once, one from the beginning of a frame's way through the prior and one from its end; what one
has compiled, the other finds on disk. ``python -I -m steadypose.nodes.graph.loops`` does no more than that.
"""

from __future__ import annotations

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

COMPILED = {"prior", "trajectory"}
"""the nodes that need them"""
WAIT_S = 600.0
"""for another process that compiles; it may have been stopped"""
SAY_S = 5.0
"""between two lines that say how far it is"""
_GARBAGE = 20_000
"""objects between two looks for garbage: with Python's 700, they take a seventh of the time"""


def compile_from_the_beginning() -> None:
    """Clean a few frames with the settings that ship."""
    from steadypose.prior.clean.pipeline import load_loops
    from steadypose.prior.clean.settings import PriorSettings

    load_loops(PriorSettings())


def compile_from_the_end() -> None:
    """Run each network, the smoother's features, the pose solver and orientations by themselves, and import the
    trajectory, whose loops are compiled by that.

    In an order in which the other process, whose first great loop is the bank of smoothers, finds each done.
    """
    import numpy as np

    from steadypose.prior.body.inverse_kinematics import fit_lengths, solve_pose
    from steadypose.prior.body.skeleton import REST_OFFSETS, REST_POSITIONS
    from steadypose.prior.clean.frame import Estimate
    from steadypose.prior.clean.rotations import Orient, OrientSettings
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
    """Do one of the two, in a process of its own, and write the name of each loop that is ready into a pipe."""
    part, pipe = sys.argv[1:]
    gc.set_threshold(_GARBAGE)
    with open(int(pipe), "w", encoding="utf-8", buffering=1) as said:
        loop_cache.watchers.append(lambda name: print(name, file=said))
        {"beginning": compile_from_the_beginning, "end": compile_from_the_end}[part]()


def compile_missing(say: Callable[[str], None]) -> None:
    """Compile all loops that the nodes take and that are not on disk; returns when they are, at once if nothing is due.

    Where they cannot be kept, or not be compiled, it says so: then the nodes do it themselves, or say why not.

    Args:
        say: takes a line about how far it is.
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
                say(f"another process compiles the loops for more than {WAIT_S / 60:g} minutes: going on without")
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
    started = said = time.monotonic()
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
                    if time.monotonic() - said >= SAY_S:
                        said = time.monotonic()
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
    say(f"compiled {len(ready)} loops in {time.monotonic() - started:.0f} s, once")


if __name__ == "__main__":
    compile_missing(lambda line: print(line, file=sys.stderr, flush=True))
