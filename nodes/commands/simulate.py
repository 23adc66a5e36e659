"""``steadypose simulate``: make the streams of a manifest, such as those of ``sim_data/``, again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from steadypose.nodes.graph.launch import bundled
from steadypose.prior.sim.streams import ManifestError, read_manifest, record


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
