"""Heading from a real Kinect, and the root's orientation in the bundled streams.

The root is the pelvis. A trunk's frame is steadier, but something else: the heading against the Vicon's hips is that of
the pelvis, against the mean of hips and shoulders that of the trunk, which `hips and shoulders` measures by definition.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from steadypose.benchmarks import product
from steadypose.benchmarks.baselines.body import facing
from steadypose.benchmarks.baselines.rotations import Baseline, baselines
from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.motion import side_by_side
from steadypose.benchmarks.provenance import ROOT, VARIANTS
from steadypose.benchmarks.results import Result, Table
from steadypose.benchmarks.studies.rotations import AIMED, DELAY, METHODS, STEADYPOSE, matrices, pair
from steadypose.benchmarks.studies.rotations_truth import angle, spread, tilt_between, wrapped
from steadypose.msgs.types import PoseRaw, PoseWorld
from steadypose.nodes.sources.recording import open_recording
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import heading, quaternion_product, rotation_matrix
from steadypose.prior.body.skeleton import HIPS, SHOULDERS
from steadypose.prior.clean.pipeline import PriorPipeline
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.timing.rate import FPS
from steadypose.training.data.readers import VALIDATION_SUBJECTS, load_pairs

DEPENDS_ON = VARIANTS

_PARTS = {"pelvis": (HIPS,), "trunk": (HIPS, SHOULDERS)}  # parts whose heading the Kinect's is compared with
_STREAMS = ROOT / "sim_data"


def run(bench: Bench) -> Result:
    roots = baselines(bench.training_clips(), bench.seeds[0])
    kinect = _kinect(bench, roots)
    bundled = {
        path.parent.name: {name: _errors(path.parent, METHODS[name]) for name in (AIMED, STEADYPOSE)}
        for path in sorted(_STREAMS.glob("*/metadata.yaml"))
    }
    return Result([_kinect_table(kinect), _bundled_table(bundled)], {"kinect": kinect, "bundled": bundled})


def _errors(path: Path, settings: PriorSettings) -> dict[str, list[float]]:
    """Return errors of root, heading and tilt in a stream: median and 95th percentile, degrees."""
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


def _kinect(bench: Bench, roots: Mapping[str, Baseline]) -> dict[str, dict[str, list[float]]]:
    """Return heading errors against Vicon's `_PARTS`: median and 95th percentile, degrees.

    Each clip's median is subtracted, because the two systems define "hip" differently.
    """
    assert bench.mocap is not None
    pairs = [recorded for subject in VALIDATION_SUBJECTS for recorded in
             load_pairs(bench.mocap / "ui_prmd.npz", (subject,))[:: 40 if bench.quick else 6]]  # fmt: skip
    seen = side_by_side([recorded.kinect for recorded in pairs])
    off: dict[str, dict[str, list[Floats]]] = {}
    for name, settings in METHODS.items():
        cleaned = product.run(settings, seen, np.arange(len(seen)) / FPS, DELAY, "kinect22")
        for clip, recorded in enumerate(pairs):
            length = len(recorded.kinect)
            mine = {name: matrices(cleaned.rotations[:length, clip, 0])}
            if name == STEADYPOSE:
                mine |= {other: root(cleaned.positions[:length, clip]) for other, root in roots.items()}
            for (of, parts), (method, turned) in itertools.product(_PARTS.items(), mine.items()):
                apart = wrapped(heading(turned) - facing(recorded.vicon, parts))
                off.setdefault(of, {}).setdefault(method, []).append(apart - np.nanmedian(apart))
    return {of: {method: spread(np.concatenate(parts)) for method, parts in each.items()} for of, each in off.items()}


def _kinect_table(kinect: Mapping[str, Mapping[str, list[float]]]) -> Table:
    return Table(
        "heading", "Real Kinect: heading in degrees, median / 95th percentile",
        ["method", *kinect],
        [[method, *(pair(each[method]) for each in kinect.values())] for method in kinect["pelvis"]],
        "UI-PRMD's s07 and s08, each clip's median removed, delay 4. Pelvis: against Vicon's hips, which a root's "
        "heading means; trunk: against the mean of hips and shoulders.",
    )  # fmt: skip


def _bundled_table(bundled: Mapping[str, Mapping[str, Mapping[str, list[float]]]]) -> Table:
    return Table(
        "heading-bundled", "The bundled streams: error of the root in degrees, median / 95th percentile",
        ["stream: method", "root", "heading", "tilt"],
        [
            [f"{stream}: {method}", *(pair(errors[part]) for part in ("root", "heading", "tilt"))]
            for stream, methods in bundled.items()
            for method, errors in methods.items()
        ],
        "Against the simulator's pelvis, from `sim_data/`, as published.",
    )  # fmt: skip
