"""Commands of one call each: ``keys``, ``repair`` and ``simulate``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from steadypose.msgs.recording import RecordingReader, RecordingWriter
from steadypose.msgs.security import create_keys
from steadypose.nodes.graph.launch import bundled
from steadypose.nodes.settings import LaunchError
from steadypose.prior.sim.streams import ManifestError, read_manifest, record


def keys(directory: Path) -> None:
    """Make a pair of CurveZMQ keys: who has no key on the list hears nothing.

    Copy own.key of each machine that listens into clients/ here, and own.key of here to those machines as
    server.key. Then name the directory as 'keys' under [transport] of the launch file.

    Args:
        directory: where the keys go; own.key_secret never leaves it.
    """
    try:
        create_keys(directory)
    except ValueError as error:
        raise LaunchError(str(error)) from error
    print(f"{directory}/own.key: to hand out")
    print(f"{directory}/own.key_secret: to keep")
    print(f"{directory}/clients/: the keys of those who may listen")


def repair(
    source: Annotated[Path, tyro.conf.arg(name="in", metavar="IN")],
    out: Annotated[Path, tyro.conf.arg(metavar="OUT")],
) -> int:
    """Write what can be read of a recording into a new one, with its index and metadata, and say what is lost.

    For recordings whose writer was killed, which other programs may not read, and for damaged files: of these a chunk
    is lost, half a second at most, for each place that is damaged. The exit status is 1 if anything is lost.

    Args:
        source: a rosbag2 directory or an .mcap.
        out: the directory to make.
    """
    with RecordingReader(source) as recording, RecordingWriter(out) as writer:
        saved = 0
        for topic, stamp_ns, message in recording:
            writer.write(topic, message, stamp_ns)
            saved += 1
        undecodable = recording.refused.total()
        print(f"{out}: {saved} messages; lost: {recording.lost_bytes} bytes in {recording.gaps} places", end="")
        print(f", {undecodable} messages that cannot be decoded" if undecodable else "")
        return 1 if recording.lost_bytes or undecodable else 0


def simulate(
    out: Annotated[Path, tyro.conf.Positional],
    stream: tuple[str, ...] = (),
    manifest: Path | None = None,
) -> None:
    """Make streams as a depth camera would see them, with the truth on a topic of its own.

    The same manifest gives the same bytes on the same machine. For scenes of your own copy sim_data/manifest.json,
    change script, seed, camera or noise, and name it with --manifest.

    Try:
      steadypose simulate /tmp/streams                        all of sim_data
      steadypose simulate /tmp/streams --stream walk_turn
      steadypose run --input /tmp/streams/walk_turn --view

    Args:
        out: folder to write to; each stream gets a folder in it, which must not be there yet.
        stream: names of the streams to make; all of them if left out.
        manifest: what to make; that of sim_data if left out.
    """
    path = manifest or bundled("sim_data", "manifest.json")
    known = read_manifest(path)
    if unknown := set(stream) - known.keys():
        raise ManifestError(f"{path} has no stream {', '.join(sorted(unknown))}; it has {', '.join(known)}")
    for name in stream or known:
        record(known[name], out / name)
        print(f"{out / name}: {known[name].what}")
