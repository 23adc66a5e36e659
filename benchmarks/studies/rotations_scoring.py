"""Errors of orientations: of all joints, of the root's heading and tilt, along and about bones, from frame to frame."""

from __future__ import annotations

from typing import Any

import numpy as np

from steadypose.benchmarks.studies.rotations_truth import SCORED
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import heading
from steadypose.prior.body.skeleton import CHILDREN, JOINTS, REST_OFFSETS, J

_BALLS = [SCORED.index(J[name]) for name in ("left_hip", "right_hip", "left_shoulder", "right_shoulder")]
STRAIGHT, BENT = np.radians((10.0, 30.0))
"""Bend of knee or elbow below which a limb is straight, and above which it is bent."""
SLOW, FAST = 0.5, 1.5
"""m/s of the joint at the bone's end."""
_ROUNDS, _NEAR = 8, np.radians(2.0)


def child_of(joint: int) -> int:
    """The joint at the end of the bone that a joint turns: of pelvis and chest the one above."""
    return {J["pelvis"]: J["spine1"], J["spine3"]: J["neck"]}.get(joint, CHILDREN[joint][0])


_BONE = np.array([REST_OFFSETS[child_of(j)] / np.linalg.norm(REST_OFFSETS[child_of(j)]) for j in SCORED])


def align(truth: Floats, perfect: Floats) -> Floats:
    """The file's orientations in a method's own convention: ``truth @ A``.

    A file's joint at rest is not turned as the canonical one, nor as any method's. A (C, 17, 3, 3), one constant
    rotation a clip and joint, is the median of ``truth.T @ perfect`` over the clip (Weiszfeld's rounds on chordal
    means), ``perfect`` being that method's answer to the joints without any noise. What then differs on a perfect input
    is definition: a pelvis drawn through hips and spine bends with the spine, and a straight limb shows no twist.

    Args:
        truth: (T, C, 17, 3, 3) the file's.
        perfect: (T, C, 17, 3, 3) the method's.

    Returns:
        (T, C, 17, 3, 3).
    """
    apart = truth.swapaxes(-1, -2) @ perfect
    weight, mean = np.ones(apart.shape[:-2]), apart[0]
    for _ in range(_ROUNDS):
        u, _, vt = np.linalg.svd(np.einsum("tcj,tcjab->cjab", weight, apart))
        u[..., -1] *= np.linalg.det(u @ vt)[..., None]
        mean = u @ vt
        weight = 1.0 / np.maximum(angle(mean.swapaxes(-1, -2) @ apart), _NEAR)
    return truth @ mean


def angle(rotation: Floats) -> Floats:
    """(...) radians of rotations (..., 3, 3), exact for small ones too."""
    skew = rotation - rotation.swapaxes(-1, -2)
    sine = 0.5 * np.sqrt(skew[..., 2, 1] ** 2 + skew[..., 0, 2] ** 2 + skew[..., 1, 0] ** 2)
    return np.arctan2(sine, 0.5 * (np.trace(rotation, axis1=-2, axis2=-1) - 1.0))


def score(found: Floats, truth: Floats, positions: Floats) -> dict[str, Any]:
    """Degrees; of errors the median and the 95th percentile.

    Args:
        found: (T, C, 17, 3, 3) orientations.
        truth: (T, C, 17, 3, 3) aligned.
        positions: (T, C, 22, 3) metres, true.
    """
    error = found.swapaxes(-1, -2) @ truth
    off = angle(error)
    swing, twist = _swing_twist(error)
    root, true_root = found[:, :, 0], truth[:, :, 0]
    turned, tilt = wrapped(heading(root) - heading(true_root)), tilt_between(root, true_root)
    result: dict[str, Any] = {
        "all": spread(off), "root": spread(off[:, :, 0]), "heading": spread(turned), "tilt": spread(tilt),
        "direction": spread(swing), "twist": spread(twist[:, :, _BALLS]),
        "turn beyond": _excess(found, truth), "root turn beyond": _excess(found[:, :, :1], truth[:, :, :1]),
        "joints": {JOINTS[joint]: spread(off[:, :, k]) for k, joint in enumerate(SCORED)},
    }  # fmt: skip
    ends = [child_of(joint) for joint in SCORED]
    speed = np.linalg.norm(np.gradient(positions[:, :, ends], 1 / 30, axis=0), axis=-1)
    result["by speed"] = {
        name: spread(off[mask])
        for name, mask in (
            ("slow", speed < SLOW),
            ("middling", (speed >= SLOW) & (speed < FAST)),
            ("fast", speed >= FAST),
        )
    }
    bend = _bend(positions)
    result["by bend"] = {
        name: {"twist": spread(twist[:, :, _BALLS][mask]), "direction": spread(swing[:, :, _BALLS][mask])}
        for name, mask in (
            ("straight", bend < STRAIGHT), ("half", (bend >= STRAIGHT) & (bend < BENT)), ("bent", bend >= BENT)
        )
    }  # fmt: skip
    return result


def spread(radians: Floats) -> list[float]:
    """Median and 95th percentile, degrees, of what is finite."""
    finite = radians[np.isfinite(radians)]
    if not len(finite):
        return [float("nan")] * 2
    return [round(float(v), 2) for v in np.degrees(np.quantile(np.abs(finite), (0.5, 0.95)))]


def _excess(found: Floats, truth: Floats) -> float:
    """Degrees a frame that orientations turn beyond the true turn, in the mean."""
    mine, real = (angle(r[:-1].swapaxes(-1, -2) @ r[1:]) for r in (found, truth))
    return round(float(np.degrees(np.nanmean(mine - real))), 3)


def tilt_between(found: Floats, truth: Floats) -> Floats:
    """(...) radians by which two orientations (..., 3, 3) lean differently, whatever their headings."""
    return np.arccos(np.clip((found[..., 2, :] * truth[..., 2, :]).sum(axis=-1), -1.0, 1.0))


def wrapped(angles: Floats) -> Floats:
    """The same angles, radians, between -pi and pi."""
    return (angles + np.pi) % (2 * np.pi) - np.pi


def _swing_twist(error: Floats) -> tuple[Floats, Floats]:
    """Radians by which a bone's direction is off, and by which it is turned about itself, of (T, C, 17, 3, 3)."""
    bone = np.broadcast_to(_BONE, error.shape[:-1])
    moved = np.einsum("...ab,...b->...a", error, bone)
    swing = np.arctan2(np.linalg.norm(np.cross(bone, moved), axis=-1), (bone * moved).sum(axis=-1))
    skew = np.stack([error[..., 2, 1] - error[..., 1, 2], error[..., 0, 2] - error[..., 2, 0],
                     error[..., 1, 0] - error[..., 0, 1]], axis=-1)  # fmt: skip
    # of a quaternion, vector part by scalar part: skew / (1 + trace)
    about = (skew * bone).sum(axis=-1)
    return swing, np.abs(2.0 * np.arctan2(about, 1.0 + np.trace(error, axis1=-2, axis2=-1)))


def _bend(positions: Floats) -> Floats:
    """(T, C, 4) radians by which knees and elbows are bent."""
    chains = [(J[f"{side}_{a}"], J[f"{side}_{b}"], J[f"{side}_{c}"])
              for a, b, c in (("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist"))
              for side in ("left", "right")]  # fmt: skip
    start, middle, end = (positions[:, :, list(joints)] for joints in zip(*chains, strict=True))
    upper, lower = middle - start, end - middle
    return np.arctan2(np.linalg.norm(np.cross(upper, lower), axis=-1), (upper * lower).sum(axis=-1))
