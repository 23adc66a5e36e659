"""Real MediaPipe beside four cameras: one man on a standing treadmill (Pose2Sim's demo), for validation only.

The input is world landmarks of each camera, at 60 frames a second split into two streams of 30 Hz, with MediaPipe's
confidences. They have no position in the world, so joints are compared relative to the middle of the hips, after one
rotation per clip. The reference is joints triangulated from all four cameras, accurate to 1 to 2 cm. It defines joints
as MediaPipe does. One camera has a third of its frames with left and right swapped and is scored separately.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from steadypose.benchmarks.baselines.filters import FILTERS, Baseline
from steadypose.benchmarks.bench import Answer, Bench, Methods, answers, tune, tuning_log
from steadypose.benchmarks.motion import side_by_side
from steadypose.benchmarks.product import PRODUCT
from steadypose.benchmarks.provenance import CLEAN
from steadypose.benchmarks.results import Result
from steadypose.benchmarks.scores import errors_mm, pivot
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import rigid_alignment
from steadypose.prior.body.layouts import BLAZEPOSE33, to_canonical
from steadypose.prior.body.skeleton import HIPS
from steadypose.prior.timing.rate import FPS

DEPENDS_ON = CLEAN

CAMERAS = ("cam01", "cam03", "cam04", "cam02")
EXCHANGED = "cam02"
Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rotation from MediaPipe's x right, y down, z forward to z up."""


class Stream(NamedTuple):
    """Every other frame of a camera."""

    camera: str
    seen: Floats  # (T, 22, 3) metres, canonical, z up, NaN where missing
    truth: Floats  # (T, 22, 3) metres, canonical, z up


def read_streams(path: Path) -> list[Stream]:
    streams = []
    with np.load(path) as data:
        reference = np.where(data["reference/valid"][..., None], data["reference/positions"], np.nan)
        truth = to_canonical(BLAZEPOSE33, reference.astype(np.float64))[0]
        for camera in CAMERAS:
            seen = to_canonical(BLAZEPOSE33, data[f"{camera}/positions"].astype(np.float64) @ Z_UP.T)[0]
            streams += [Stream(camera, seen[half::2], truth[half::2]) for half in (0, 1)]
    return streams


def error_of(answer: Floats, stream: Stream) -> dict[str, float]:
    """Return errors of (T, 22, 3), mm and mm/frame², relative to the middle of the hips and rotated as a whole onto the
    truth.

    The constant offset of each joint, which partly depends on its definition, is subtracted.
    """
    both = np.isfinite(answer).all(axis=-1).any(axis=0) & np.isfinite(stream.truth).all(axis=-1).any(axis=0)
    own, wanted = ((x - x[:, HIPS].mean(axis=1, keepdims=True))[:, both] for x in (answer, stream.truth))
    rotation, _ = rigid_alignment(own, wanted)
    turned = own @ rotation.T
    turned = turned + np.nanmean(wanted - turned, axis=0)
    return errors_mm(turned, wanted)


def run(bench: Bench) -> Result:
    assert bench.mocap is not None
    streams = read_streams(bench.mocap / "mediapipe_pose.npz")
    seen = side_by_side([stream.seen for stream in streams])
    stamps = np.arange(len(seen)) / FPS
    methods = Methods(FILTERS, {"steadypose": PRODUCT["steadypose"]}, bench.delays)

    def evaluate(baseline: Baseline, delay: int, parameters: Mapping[str, float]) -> dict[str, float]:
        answer = baseline.run(seen, stamps, delay, **parameters)
        return _mean([error_of(answer[: len(s.seen), c], s) for c, s in enumerate(streams)])

    tuned = tune(bench, evaluate, "MediaPipe", methods.baselines, methods.delays)
    records = [
        record
        for answer in answers(bench, seen, stamps, tuned, "MediaPipe", methods)
        for record in _records(answer, streams)
    ]
    note = (
        f"{len(streams)} streams of {len(streams[0].seen)} frames, one person, relative to the hips' middle, one "
        f"rotation and a constant offset a joint; in {EXCHANGED} a third of the frames have left and right exchanged. "
        "Baselines are tuned on these very streams. For validation: the reference shares MediaPipe's idea of a joint."
    )
    tables = [
        pivot(records, "camera", "position_mm", "mediapipe", "MediaPipe beside four cameras: position error, mm", note),
        pivot(records, "camera", "acceleration_mm", "mediapipe-acceleration",
              "MediaPipe beside four cameras: acceleration error, mm/frame²", note, digits=2),
    ]  # fmt: skip
    return Result(tables, {"records": records, "tuning": tuning_log(tuned)})


def _records(answer: Answer, streams: Sequence[Stream]) -> list[dict[str, Any]]:
    """Return a record for the cameras that swap nothing, and for the one that does."""
    found: dict[str, list[dict[str, float]]] = {"three cameras": [], EXCHANGED: []}
    for number, stream in enumerate(streams):
        name = EXCHANGED if stream.camera == EXCHANGED else "three cameras"
        found[name].append(error_of(answer.positions[: len(stream.seen), number], stream))
    head = {"method": answer.method, "delay": answer.delay, "parameters": dict(answer.parameters)}
    return [{**head, "camera": name, **_mean(some)} for name, some in found.items()]


def _mean(found: Sequence[Mapping[str, float]]) -> dict[str, float]:
    return {key: round(float(np.mean([figures[key] for figures in found])), 4) for key in found[0]}
