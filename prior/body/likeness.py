"""Measures how well joints fit a human body, and with which layout, unit, up axis and handedness they fit better.

It diagnoses input whose declared layout may be wrong, and changes no pose. Lengths are compared as logarithms, so that
a wrong unit is a common offset.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats, medians
from steadypose.prior.body.layouts import SKELETONS, Skeleton, to_canonical
from steadypose.prior.body.skeleton import REST_POSITIONS, J, finite_joints

_SIDE = ("shoulder-elbow", "elbow-wrist", "hip-knee", "knee-ankle")
_SPANS = (
    ("left_hip", "right_hip"),
    ("left_shoulder", "right_shoulder"),
    ("pelvis", "neck"),
    ("neck", "head"),
    *((f"{side}_{a}", f"{side}_{b}") for side in ("left", "right") for a, b in (s.split("-") for s in _SIDE)),
)
SPANS: NDArray[np.intp] = np.array([[J[a], J[b]] for a, b in _SPANS])
"""(S, 2) pairs of canonical joints whose distance hardly depends on the pose."""
SPAN_NAMES: tuple[str, ...] = tuple(f"{a} to {b}" for a, b in _SPANS)
MIN_SPANS = 5
"""Least number of observed spans for a judgement."""
BODY_ERROR = 0.5
"""Largest RMS of the logarithms of lengths relative to a human's at which joints form a body. Real trackers stay below
0.35; joints read in the order of another layout exceed 0.55."""
NO_LENGTH = 1e-4  # least length relative to an adult's, which keeps logarithms finite if two joints coincide

HUMAN: Floats = np.linalg.norm(REST_POSITIONS[SPANS[:, 0]] - REST_POSITIONS[SPANS[:, 1]], axis=1)
"""(S,) lengths of an adult's spans, metres."""


@dataclass(frozen=True)
class Likeness:
    """The fit of joints, read in the order of a layout, to a human body."""

    skeleton: str  # the layout in which they are read
    scale: float  # ratio of their lengths to an adult's: 1 in metres, 1000 in millimetres
    error: float
    """RMS over the spans of the logarithm of the ratio of a length to the human length at that scale, and of its spread
    over time. A statue with the proportions of the canonical skeleton has 0"""
    worst: str  # the span that differs most
    ratio: float  # ratio of that span's length to the human length at that scale

    @property
    def is_body(self) -> bool:
        return self.error < BODY_ERROR


def likeness(skeleton: Skeleton, positions: NDArray[np.floating]) -> Likeness | None:
    """Measure how well joints (T, J, 3), of any unit and frame and NaN where missing, fit a human body in the order of
    a layout of J joints. None if too few joints were observed."""
    joints, _ = to_canonical(skeleton, positions.astype(np.float64))
    lengths = np.linalg.norm(joints[:, SPANS[:, 0]] - joints[:, SPANS[:, 1]], axis=-1)
    observed = np.isfinite(lengths).sum(axis=0) > len(lengths) / 4
    if observed.sum() < MIN_SPANS:
        return None
    logs = np.log(np.maximum(lengths[:, observed] / HUMAN[observed], NO_LENGTH))
    middle = medians(logs)
    scale = float(np.median(middle))
    spread = np.minimum(medians(np.abs(logs - middle)), 1.0)
    off = np.clip(middle - scale, -3.0, 3.0)
    worst = int(np.argmax(np.abs(off)))
    return Likeness(
        skeleton.name,
        float(np.exp(scale)),
        float(np.sqrt(np.mean(off**2 + spread**2))),
        SPAN_NAMES[int(np.flatnonzero(observed)[worst])],
        float(np.exp(off[worst])),
    )


def likenesses(positions: NDArray[np.floating]) -> list[Likeness]:
    """Return the fits of all layouts with this number of joints, best first."""
    fitting = [s for s in SKELETONS.values() if len(s.joints) == positions.shape[1]]
    likenesses = [like for skeleton in fitting if (like := likeness(skeleton, positions))]
    return sorted(likenesses, key=lambda like: like.error)


@dataclass(frozen=True)
class Stance:
    """Up axis and handedness of bodies in their frame."""

    up: Floats  # (3,) unit vector from feet to heads, in the frame of the joints
    handed: float
    """-1 to 1, agreement of toes, noses and knees with the forward direction that left and right imply. It is near -1
    for a mirrored body, and NaN if no joint shows it"""


def stance(skeleton: Skeleton, positions: NDArray[np.floating]) -> Stance | None:
    """Estimate the up axis and handedness of joints (T, J, 3) in a layout of J joints, of any unit, NaN where missing.
    None if it is impossible, or if the up axis changes."""
    positions = positions.astype(np.float64)
    joints, _ = to_canonical(skeleton, positions)
    low = _mean(joints, "left_ankle", "right_ankle", "left_hip", "right_hip", "left_knee", "right_knee")
    high = _mean(joints, "left_shoulder", "right_shoulder", "neck", "head")
    ups = _unit(high - low)
    ups = ups[np.isfinite(ups[:, 0])]
    if not len(ups):
        return None
    up = ups.mean(axis=0)
    if np.linalg.norm(up) < 0.9:  # no common direction: a body falls, or the joints form none
        return None
    return Stance(up / np.linalg.norm(up), _handedness(skeleton, positions, joints))


def _handedness(skeleton: Skeleton, positions: Floats, joints: Floats) -> float:
    """Mean cosine between directions that point forward on a body and the forward direction of its left and right."""
    upwards = _unit(_mean(joints, "left_shoulder", "right_shoulder") - _mean(joints, "left_hip", "right_hip"))
    leftwards = sum(_unit(joints[:, J[f"left_{j}"]] - joints[:, J[f"right_{j}"]]) for j in ("hip", "shoulder"))
    forwards = _unit(np.cross(leftwards, upwards))
    shown: list[Floats] = []
    for side in ("left", "right"):
        hip, knee, ankle, foot = (joints[:, J[f"{side}_{j}"]] for j in ("hip", "knee", "ankle", "foot"))
        shown.append(_unit(foot - ankle))
        bent = knee - (hip + ankle) / 2
        flexed = np.linalg.norm(bent, axis=1) > 0.08 * np.linalg.norm(hip - ankle, axis=1)
        shown.append(np.where(flexed[:, None], _unit(bent), np.nan))
    names = {name.lower().replace("_", ""): index for index, name in enumerate(skeleton.joints)}
    ears = [names[name] for name in ("leftear", "rightear", "lear", "rear", "earleft", "earright") if name in names]
    if "nose" in names and len(ears) == 2:
        shown.append(_unit(positions[:, names["nose"]] - positions[:, ears].mean(axis=1)))
    cosines = np.concatenate([(forwards * direction).sum(axis=1) for direction in shown])
    cosines = cosines[np.isfinite(cosines)]
    return float(np.median(cosines)) if len(cosines) else float("nan")


def _mean(joints: Floats, *names: str) -> Floats:
    """(T, 3) mean of the observed joints among these; NaN if none is observed."""
    chosen = joints[:, [J[name] for name in names]]
    observed = finite_joints(chosen)
    total = np.where(observed[..., None], chosen, 0.0).sum(axis=1)
    counts = observed.sum(axis=1)[:, None]
    return np.where(counts > 0, total / np.maximum(counts, 1), np.nan)


def _unit(vectors: Floats) -> Floats:
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(lengths > 0, vectors / np.where(lengths > 0, lengths, 1.0), np.nan)
