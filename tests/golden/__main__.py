"""Whether a change of the code leaves every published byte as it was: ``python -m tests.golden write|check FILE``.

Hashes the encoded ``pose/clean`` and ``pose/world`` of the bundled streams at four delays and with stages switched off,
of a batch of two streams, and the ``.npz`` and MCAP that ``clean`` writes. Compare on one machine only: floats differ
between processors, so this is a tool for refactoring and no test.
"""

import hashlib
import json
import sys
import tempfile
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from steadypose.msgs.codec import encode
from steadypose.msgs.types import Message, PoseClean, PoseRaw, PoseWorld
from steadypose.nodes.commands.output import clean_recording
from steadypose.nodes.driving import stream
from steadypose.nodes.graph.prior_node import make_prior
from steadypose.nodes.graph.trajectory_node import make_trajectory
from steadypose.nodes.sources.recording import open_recording
from steadypose.prior.clean.batch import StreamBatch
from steadypose.prior.clean.settings import PriorSettings

STREAMS = sorted(path.parent for path in (Path(__file__).parents[2] / "sim_data").glob("*/metadata.yaml"))
OFF = ("gate", "denoise", "person", "score", "impute", "fuse")
VARIANTS: dict[str, dict[str, Any]] = {
    **{f"delay {delay}": {"delay": delay} for delay in (0, 2, 4, 16)},
    **{f"no {stage}": {stage: {"enabled": False}} for stage in OFF},
    "refine": {"refine": {"enabled": True}},
    "identify": {"identify": {"enabled": True}},
    "kinect": {"correct": {"sensor": "kinect_v2"}},
}
FRAMES = 240


def digest(messages: Iterable[Message]) -> str:
    """Of all encoded messages, one after the other."""
    found = hashlib.sha256()
    for message in messages:
        found.update(encode(message))
    return found.hexdigest()[:24]


def outcomes() -> Iterator[tuple[str, str]]:
    """Name and digest of every case."""
    for path in STREAMS:
        raw = [item for item in open_recording(path) if isinstance(item[1], PoseRaw)]
        for name, settings in VARIANTS.items():
            few = raw if name == "delay 4" else islice(raw, FRAMES)
            answers = [message for _, message in stream(few, make_prior(settings), make_trajectory({}))]
            for kind in (PoseClean, PoseWorld):
                yield f"{path.name}, {name}, {kind.__name__}", digest(m for m in answers if isinstance(m, kind))
    yield "batch", digest(_batch())
    with tempfile.TemporaryDirectory() as folder:
        empty: dict[str, dict[str, Any]] = {"prior": {}, "trajectory": {}}
        clean_recording(STREAMS[-1], Path(folder) / "out.npz", empty)
        found = hashlib.sha256()
        with np.load(Path(folder) / "out.npz") as arrays:
            for name in sorted(arrays.files):
                found.update(name.encode() + np.ascontiguousarray(arrays[name]).tobytes())
        yield "npz", found.hexdigest()[:24]
        clean_recording(STREAMS[-1], Path(folder) / "mcap", empty)
        yield "mcap", digest(m for _, m in open_recording(Path(folder) / "mcap") if not isinstance(m, PoseRaw))


def _batch() -> Iterator[Message]:
    batch = StreamBatch(PriorSettings(), 2)
    kept = [[m for _, m in islice(open_recording(path), FRAMES) if isinstance(m, PoseRaw)] for path in STREAMS[:2]]
    for k, (first, second) in enumerate(zip(*kept, strict=False)):
        for source, message in (("a", first), ("b", second)):
            message.source = source
            yield from batch.process_at(message, 10**9 + k * 33_333_333, hurry=False)


def compare(verb: str, file: Path, found: dict[str, str]) -> int:
    """Write the digests ``found``, or say which are not as they were written: 0 if all are."""
    if verb == "write":
        file.write_text(json.dumps(found, indent=1) + "\n")
        return 0
    before = json.loads(file.read_text())
    changed = [name for name in before if found.get(name) != before[name]]
    print("\n".join(f"changed: {name}" for name in changed) or f"all {len(before)} as they were")
    return bool(changed)


if __name__ == "__main__":
    sys.exit(compare(sys.argv[1], Path(sys.argv[2]), dict(outcomes())))
