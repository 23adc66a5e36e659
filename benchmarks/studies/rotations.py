"""Orientations of joints on motion whose files have rotations.

The input is joints, with noise, of people on whom nothing was trained (CMU's 02, DanceDB, LAFAN1; `rotations_truth`).
Global orientations of the 17 joints that carry another are compared. A file's joint at rest has another orientation
than the canonical one. So the columns "file" compare with the file's orientations after one constant rotation per clip
and joint, fitted to the method's own output for the joints without noise (`rotations_truth.align`). They include the
difference of definitions, which the rows without noise show. "Noise alone" compares with that output itself. The first
two seconds of a clip are not scored.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from steadypose.benchmarks import product
from steadypose.benchmarks.baselines.rotations import (
    DENSITIES,
    Baseline,
    RotationNet,
    baselines,
    predict_rotations,
    smooth_rotations,
    train_rotations,
)
from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.corruption import correlated, gaussian
from steadypose.benchmarks.provenance import VARIANTS_22
from steadypose.benchmarks.results import Result, Table
from steadypose.benchmarks.scores import ratio
from steadypose.benchmarks.studies.humor_fits import seen_joints, shipped, starts_of
from steadypose.benchmarks.studies.rotations_truth import SCORED, SKIPPED, align, angle, read, score
from steadypose.prior.arrays import Floats
from steadypose.prior.body.bone_lengths import estimate_offsets
from steadypose.prior.body.inverse_kinematics import solve_rotations
from steadypose.prior.body.kinematics import global_rotations, rotation_matrices
from steadypose.prior.clean.settings import OrientSettings, PriorSettings, RefineSettings
from steadypose.prior.fit.bodies import lowest_floor
from steadypose.prior.fit.solve import FitSettings
from steadypose.prior.fit.windows import Track, fit_track
from steadypose.prior.models.pelvis import RootCovariance
from steadypose.prior.timing.rate import FPS

DEPENDS_ON = (*VARIANTS_22, "humor weights", "prior.fit")

DELAY, FIT_DELAY = PriorSettings().delay, 8
"""Delays of the live output that is scored, and of that from which fits start, frames."""
CORRELATION = math.exp(-1.0 / (0.5 * FPS))  # between frames; 1 / e over half a second
CAMERA_M, DEPTH = 4.0, 4.0
"""Distance of a camera from the middle of a clip, metres; its errors along the line of sight over those across it."""
PERFECT, AIMED, STEADYPOSE, FIT = "none", "aimed bones", "steadypose", "`steadypose fit`, offline"
FILTERED, REGRESSED = "raw joints' aimed bones, Kalman filter", "positions to rotations, GRU"
METHODS: Mapping[str, PriorSettings] = {
    AIMED: PriorSettings(orient=OrientSettings(enabled=False)),
    "HM-VAE, one pass": product.PRODUCT["HM-VAE"],
    STEADYPOSE: PriorSettings(),
    "steadypose with HM-VAE, which is off": PriorSettings(refine=RefineSettings(enabled=True)),
}


def depth_errors(truth: Floats, rng: np.random.Generator) -> Floats:
    """Add time-correlated noise to (T, C, 22, 3), 1 cm across the line of sight of a camera and 4 cm along it."""
    seen = correlated(truth, 0.01, rng, CORRELATION)
    sight = truth - truth.mean(axis=(0, 2), keepdims=True) - (CAMERA_M, 0.0, 0.0)
    sight /= np.linalg.norm(sight, axis=-1, keepdims=True)
    return seen + (DEPTH - 1.0) * ((seen - truth) * sight).sum(axis=-1, keepdims=True) * sight


CONDITIONS: Mapping[str, Callable[[Floats, np.random.Generator], Floats]] = {
    PERFECT: lambda truth, _: truth,
    "white, 1 cm": lambda truth, rng: gaussian(truth, 0.01, rng),
    "white, 2 cm": lambda truth, rng: gaussian(truth, 0.02, rng),
    "correlated, 2 cm": lambda truth, rng: correlated(truth, 0.02, rng, CORRELATION),
    "a camera's depth, correlated": depth_errors,
}
"""Errors of joints (T, C, 22, 3), metres."""


class _Turned(NamedTuple):
    """Output of one method: orientations (T, C, 17, 3, 3), and the root's covariance (T, C, 3, 3) rad²."""

    orientations: Floats
    covariance: Floats


def run(bench: Bench) -> Result:
    assert bench.mocap is not None
    clips = read(bench.mocap, bench.split, 4 if bench.quick else 8)
    rng, scored = np.random.default_rng(bench.seeds[0]), slice(SKIPPED, None)
    training = bench.training_clips()
    roots = baselines(training, bench.seeds[0])
    track = partial(bench.progress.track, description=REGRESSED)
    net = train_rotations(training, SCORED, DELAY, 20 if bench.quick else 3000, track)
    perfect: dict[str, Floats] = {}
    plain = np.full(len(clips.person), np.nan)
    records: list[dict[str, Any]] = []
    for condition, corrupt in bench.progress.track(CONDITIONS.items(), description="rotations"):
        seen, density = corrupt(clips.positions, rng), best_density(training.every(20).positions, corrupt)
        for method, found in _answers(seen, roots, net, density).items():
            own = perfect.setdefault(method, found.orientations)
            record: dict[str, Any] = {"method": method, "noise": condition}
            for against, truth in (("noise alone", own), ("file", align(clips.orientations, own))):
                record[against] = score(found.orientations[scored], truth[scored], clips.positions[scored])
            record["squared error over variance"] = _ratio(found, own, scored)
            off = np.degrees(np.median(angle(own[scored, :, 0].swapaxes(-1, -2) @ found.orientations[scored, :, 0]), 0))
            plain = off if method == AIMED else plain
            record["root, of aimed bones'"] = (
                [round(v, 3) for v in ratio(off, plain, clips.person)[:3]] if condition != PERFECT else None
            )
            records.append(record)
    data = {"clips": {source: int((clips.source == source).sum()) for source in np.unique(clips.source)},
            "people": len(set(clips.person)), "records": records}  # fmt: skip
    return Result([_table(records, tuple(roots)), _bends(records)], data)


def best_density(truth: Floats, corrupt: Callable[[Floats, np.random.Generator], Floats]) -> float:
    """Return the process density of `smooth_rotations` with the least error on training clips (T, C, 22, 3) in this
    noise."""
    seen, wanted = aimed(corrupt(truth, np.random.default_rng(0))), aimed(truth)
    return min(DENSITIES, key=lambda d: np.median(angle(smooth_rotations(seen, d, DELAY).swapaxes(-1, -2) @ wanted)))


def aimed(joints: Floats) -> Floats:
    """Return the orientations (T, C, 17, 3, 3) of each frame's bones, aimed at joints (T, C, 22, 3)."""
    clips = [global_rotations(solve_rotations(one, estimate_offsets(one))) for one in joints.swapaxes(0, 1)]
    return np.stack(clips, axis=1)[:, :, list(SCORED)]


def _answers(seen: Floats, roots: Mapping[str, Baseline], net: RotationNet, density: float) -> dict[str, _Turned]:
    found: dict[str, _Turned] = {}
    joints, unknown = seen, np.full((*seen.shape[:2], 3, 3), np.nan)
    for name, settings in METHODS.items():
        cleaned = product.run(settings, seen, np.arange(len(seen)) / FPS, DELAY)
        turned = global_rotations(matrices(cleaned.rotations))[:, :, list(SCORED)]
        found[name] = _Turned(turned, _covariance(cleaned, turned) if name == STEADYPOSE else unknown)
        joints = cleaned.positions if name == STEADYPOSE else joints
    found[FIT] = _Turned(_fitted(seen), unknown)
    found[FILTERED] = _Turned(smooth_rotations(aimed(seen), density, DELAY), unknown)
    found[REGRESSED] = _Turned(predict_rotations(net, seen), unknown)
    for name, root in roots.items():  # of the root only, from the joints that steadypose publishes
        turned = found[AIMED].orientations.copy()
        turned[:, :, 0] = root(joints.reshape(-1, 22, 3)).reshape(turned[:, :, 0].shape)
        found[name] = _Turned(turned, unknown)
    return found


def _fitted(seen: Floats) -> Floats:
    """Return the orientations (T, C, 17, 3, 3) of fits of joints (T, C, 22, 3)."""
    cleaned = product.run(PriorSettings(), seen, np.arange(len(seen)) / FPS, FIT_DELAY)
    model, found = shipped(), []
    for joints, start in zip(seen.swapaxes(0, 1), starts_of(cleaned, len(seen), lowest_floor), strict=True):
        fitted = fit_track(model, Track([start], seen_joints(joints)), FitSettings())
        found.append(global_rotations(fitted.rotations)[:, list(SCORED)])
    return np.stack(found, axis=1)


def _covariance(cleaned: product.Cleaned, turned: Floats) -> Floats:
    """Return the covariance (T, C, 3, 3) of the roots of orientations (T, C, 17, 3, 3)."""
    parts = cleaned.positions.reshape(-1, 22, 3), cleaned.sigma.reshape(-1, 22), turned[:, :, 0].reshape(-1, 3, 3)
    return RootCovariance()(*parts).reshape(turned[:, :, 0].shape)


def matrices(quaternions: Floats) -> Floats:
    """Return rotations (..., 3, 3) of quaternions (..., 4) that were rounded to float32."""
    return rotation_matrices(quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True))


def _ratio(found: _Turned, truth: Floats, scored: slice) -> float:
    """Return the mean squared error of the root over the predicted variance, along an axis; 1 when calibrated."""
    apart = (truth[scored, :, 0] @ found.orientations[scored, :, 0].swapaxes(-1, -2)).reshape(-1, 3, 3)
    error, covariance = Rotation.from_matrix(apart).as_rotvec(), found.covariance[scored].reshape(-1, 3, 3)
    known = np.isfinite(covariance).all(axis=(1, 2))
    if not known.any():
        return math.nan
    white = np.linalg.solve(covariance[known], error[known][..., None])[..., 0]
    return round(float((error[known] * white).sum(axis=-1).mean()) / 3.0, 3)


def _share(values: list[float] | None) -> str:
    return "" if values is None else f"{values[0]:.2f} ({values[1]:.2f} to {values[2]:.2f})"


def pair(values: list[float]) -> str:
    return f"{values[0]:.1f} / {values[1]:.1f}"


def _table(records: list[dict[str, Any]], roots: tuple[str, ...]) -> Table:
    rows = []
    for record in records:
        alone, against = record["noise alone"], record["file"]
        whole = record["method"] not in roots
        variance = record["squared error over variance"]
        rows.append(
            [
                f"{record['noise']}: {record['method']}",
                *(pair(part["all"]) if whole else "" for part in (alone, against)),
                *(pair(alone[key]) for key in ("root", "heading", "tilt")), pair(against["root"]),
                *(pair(alone[key]) if whole else "" for key in ("direction", "twist")),
                f"{alone['turn beyond']:.2f}" if whole else "", f"{alone['root turn beyond']:.2f}",
                "" if math.isnan(variance) else f"{variance:.2f}",
                _share(record["root, of aimed bones'"]),
            ]
        )  # fmt: skip
    return Table(
        "rotations", "Rotations: error of joints' orientations in degrees, median / 95th percentile",
        ["noise: method", "17 joints", "17 joints, file", "root", "heading", "tilt", "root, file", "direction", "twist",
         "turn beyond", "root turn beyond", "root², by variance", "root, of aimed bones'"],
        rows,
        "People whom nothing was trained on, delay 4. Against the method's answer to the same joints without noise; "
        '"file": against the rotations of the file, after one constant rotation a clip and joint. Direction: of bones; '
        "twist: of hips and shoulders about theirs; turn beyond: degrees a frame beyond the true turn; last column: a "
        "person's mean, in units of the same by aimed bones, with its 95 % interval over people. Details: "
        "`benchmarks/studies/rotations.py`.",
    )  # fmt: skip


def _bends(records: list[dict[str, Any]]) -> Table:
    kept = [record for record in records if record["method"] in METHODS]
    rows = [
        [
            f"{record['noise']}: {record['method']}",
            *(pair(record["file"]["by bend"][bend]) for bend in ("straight", "half", "bent")),
            *(pair(record["file"]["by speed"][speed]) for speed in ("slow", "middling", "fast")),
        ]
        for record in kept
    ]
    return Table(
        "rotations-bend", "Rotations by bend of the limb (twist of hips and shoulders) and by speed, degrees, file",
        ["noise: method", "straight, < 10°", "10 to 30°", "bent", "< 0.5 m/s", "0.5 to 1.5", "faster"], rows,
    )  # fmt: skip
