"""The bundled streams: how the published root is turned, against the simulator's."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from steadypose.benchmarks.machine import ROOT
from steadypose.benchmarks.studies.rotations_scoring import angle, spread, tilt_between, wrapped
from steadypose.msgs.types import PoseRaw, PoseWorld
from steadypose.nodes.sources.recording import open_recording
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import heading, quaternion_product, rotation_matrix
from steadypose.prior.clean.pipeline import PriorPipeline
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.timing.rate import FPS

STREAMS = ROOT / "sim_data"


def root_errors(methods: Mapping[str, PriorSettings]) -> dict[str, dict[str, dict[str, list[float]]]]:
    """Degrees, median and 95th percentile, of root, heading and tilt, by stream and method."""
    return {
        path.parent.name: {name: _errors(path.parent, settings) for name, settings in methods.items()}
        for path in sorted(STREAMS.glob("*/metadata.yaml"))
    }


def _errors(path: Path, settings: PriorSettings) -> dict[str, list[float]]:
    prior, raw, truth = PriorPipeline(settings), [], {}
    for _, message in open_recording(path):
        if isinstance(message, PoseRaw):
            raw.append(message)
        elif isinstance(message, PoseWorld):
            truth |= {(message.stamp_ns, body.id): body.root_orientation for body in message.bodies}
    stamps = np.array(sorted({stamp for stamp, _ in truth}))
    pairs: list[tuple[Floats, Floats]] = []
    for clean in [clean for message in raw for clean in prior.process(message)] + prior.flush():
        nearest = int(stamps[np.abs(stamps - clean.stamp_ns).argmin()])
        if abs(nearest - clean.stamp_ns) * 1e-9 > 0.5 / FPS:
            continue
        for body in clean.bodies:
            if (nearest, body.id) in truth:
                root = quaternion_product(clean.sensor_pose.orientation, body.rotations[0].astype(np.float64))
                pairs.append((rotation_matrix(root), rotation_matrix(truth[nearest, body.id])))
    found, true = (np.stack(part) for part in zip(*pairs, strict=True))
    return {
        "root": spread(angle(found.swapaxes(-1, -2) @ true)),
        "heading": spread(wrapped(heading(found) - heading(true))),
        "tilt": spread(tilt_between(found, true)),
    }
