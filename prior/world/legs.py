"""Legs between the feet that stand and the hips that are seen, on this person's bones."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import PARENTS, limbs
from steadypose.prior.compiled import njit

LENGTH_SIGMA = 0.025
"""Metres, how well a bone of the legs is known: measured through a sensor's slow error, or a generic adult's."""

_SWEEPS = 4
_LEGS = np.array(limbs(("hip", "knee", "ankle", "foot")))
_BONES = np.array([[joint, PARENTS[joint]] for leg in _LEGS for joint in leg[1:]])
_MIN_NORM = 1e-6


def fit_legs(positions: Floats, sigma: Floats, bone_lengths: NDArray[np.floating]) -> Floats:
    """Hips, knees, ankles and toes, moved towards the lengths of the bones between them; (22, 3) metres.

    Each by as much as it is uncertain, and all by as much as the lengths are known: constraints with compliance (XPBD,
    Macklin et al. 2016), whose converged answer is the most likely one.

    Args:
        positions: (22, 3) metres; NaN where not known.
        sigma: (22,) metres.
        bone_lengths: (22,) metres, each to its parent; what is not above 0 is not known.
    """
    fitted = np.array(positions, dtype=np.float64, order="C")
    _fit(fitted, sigma**2, np.asarray(bone_lengths, dtype=np.float64))
    return fitted


def turn_legs(rotations: NDArray[np.floating], positions: Floats, moved: Floats) -> Floats:
    """Local rotations (22, 4) xyzw of a body whose legs have moved: each bone turned by the shortest way.

    Args:
        rotations: (22, 4) as they fitted ``positions``; of a leg without a rotation, or a position, they stay.
        positions, moved: (22, 3) metres, before and after, in the frame of the root's rotation.
    """
    turned = np.array(rotations, dtype=np.float64, order="C")
    _turn(turned, np.ascontiguousarray(positions, dtype=np.float64), np.ascontiguousarray(moved))
    return turned


@njit("(f8[:,::1], f8[::1], f8[::1])", cache=True)
def _fit(positions, variance, lengths):
    force = np.zeros(len(_BONES))
    compliance = LENGTH_SIGMA**2
    for _ in range(_SWEEPS):
        for k in range(len(_BONES)):
            joint, parent = _BONES[k]
            bone = positions[joint] - positions[parent]
            length = np.sqrt((bone * bone).sum())
            total = variance[joint] + variance[parent] + compliance
            if not (length > 0.0 and lengths[joint] > 0.0 and np.isfinite(total)):
                continue
            step = -(length - lengths[joint] + compliance * force[k]) / total
            force[k] += step
            for axis in range(3):
                positions[joint, axis] += variance[joint] * step / length * bone[axis]
                positions[parent, axis] -= variance[parent] * step / length * bone[axis]


@njit(cache=True)
def _product(a, b):
    """Of quaternions xyzw."""
    return np.array([
        a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1],
        a[3] * b[1] - a[0] * b[2] + a[1] * b[3] + a[2] * b[0],
        a[3] * b[2] + a[0] * b[1] - a[1] * b[0] + a[2] * b[3],
        a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2],
    ])  # fmt: skip


@njit(cache=True)
def _inverse(q):
    return np.array([-q[0], -q[1], -q[2], q[3]])


@njit(cache=True)
def _shortest(a, b):
    """The quaternion that turns the direction of ``a`` (3,) to that of ``b`` by the shortest way."""
    q = np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0], 0.0])
    q[3] = (a * b).sum() + np.sqrt((a * a).sum() * (b * b).sum())
    norm = np.sqrt((q * q).sum())
    return q / norm if norm > _MIN_NORM else np.array([0.0, 0.0, 0.0, 1.0])


@njit("(f8[:,::1], f8[:,::1], f8[:,::1])", cache=True)
def _turn(rotations, before, after):
    for leg in _LEGS:
        whole = np.isfinite(rotations[0]).all()
        for joint in leg:
            norm = np.sqrt((rotations[joint] ** 2).sum())
            whole &= norm > _MIN_NORM and np.isfinite(norm) and np.isfinite(after[joint]).all()
        if not whole:
            continue
        above, above_turned = rotations[0].copy(), rotations[0].copy()  # global rotations, before and after
        for k in range(len(leg)):
            joint = leg[k]
            own = _product(above, rotations[joint])
            turned = own
            if k + 1 < len(leg):
                child = leg[k + 1]
                turned = _product(_shortest(before[child] - before[joint], after[child] - after[joint]), own)
            local = _product(_inverse(above_turned), turned)
            norm = np.sqrt((local**2).sum())
            for i in range(4):
                rotations[joint, i] = local[i] / norm
            above, above_turned = own, turned
