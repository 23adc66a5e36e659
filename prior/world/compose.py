"""Composes a body of `pose/world` from the stages' estimates.

While the root is observed, joints keep their positions from `pose/clean`. The exceptions are resting feet, which stand
still, and the leg joints that bones connect to them. While the root is unobserved, the whole body moves with its root.
A body with both feet at rest is published as standing, with the root velocity of a swaying body.

Legs that are only guesses (`LegMemory`) have no contacts. Their feet may still be placed as if they stood, because a
guess on the floor is better than one above it, but their standard deviations stay.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.topics import are_unit
from steadypose.msgs.types import JointState, Tracking, WorldBody
from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import PARENTS, limbs
from steadypose.prior.compiled import njit
from steadypose.prior.world.core import BodyEstimate
from steadypose.prior.world.observe import FEET, FEET_OF_LEGS, LEG_CONTACTS

LENGTH_SIGMA = 0.025
"""Standard deviation of a leg bone's length, whether measured by a biased sensor or of a generic adult, metres."""

_SWEEPS = 4
_LEGS = np.array(limbs(("hip", "knee", "ankle", "foot")))
_BONES = np.array([[joint, PARENTS[joint]] for leg in _LEGS for joint in leg[1:]])
_MIN_NORM = 1e-6


def fit_legs(positions: Floats, sigma: Floats, bone_lengths: NDArray[np.floating]) -> Floats:
    """Move hips, knees, ankles and toes (22, 3) metres, NaN where unknown, towards the lengths (22,) of the bones
    between them; a length not above 0 is unknown.

    The joints are weighted by their variances, and the lengths by theirs (compliant constraints, XPBD, Macklin et al.
    2016). The converged result is the maximum likelihood estimate.
    """
    fitted = np.array(positions, dtype=np.float64, order="C")
    _fit(fitted, sigma**2, np.asarray(bone_lengths, dtype=np.float64))
    return fitted


def turn_legs(rotations: NDArray[np.floating], positions: Floats, moved: Floats) -> Floats:
    """Return local rotations (22, 4) xyzw after legs have moved, with the smallest rotation of each bone.

    ``positions`` and ``moved`` (22, 3) metres are before and after, in the frame of the root's rotation. A leg with a
    missing rotation or position keeps its rotations.
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
    """Product of quaternions xyzw."""
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
    """The quaternion of the smallest rotation from the direction of ``a`` (3,) to that of ``b``."""
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


SWAY, MOVES = 0.015, 0.1
"""Standard deviations along an axis of the root's velocity over two resting feet, m/s: of a swaying body, and of a body
that bends or shifts. In the training motion, half of the bodies with both feet at rest only sway."""

SWAYS = 0.5  # prior probability that a body with both feet at rest only sways

VELOCITY_ERROR = 0.3
"""Error-to-sigma ratio of the filter's velocity for a standing body with an observed root (validation)."""

VELOCITY_SCALE = 0.6
"""Factor on the filter's standard deviation of the velocity while the pelvis is observed: the error-to-sigma ratio in
motion on validation, for noise of 0 to 4 cm (benchmarks/NOTEBOOK.md)."""


def compose(estimate: BodyEstimate, lost_sigma: float) -> WorldBody:
    """Compose the published body; LOST if the root's horizontal standard deviation exceeds ``lost_sigma`` metres."""
    observed, root, rest = estimate.observed, estimate.root, estimate.stance.rest
    spread = root.position_sigma
    sigma = np.sqrt(observed.sigma**2 + (0.0 if observed.root_observed else float(np.mean(spread**2))))
    moved = observed.positions + root.shift
    placed = np.isfinite(root.feet[:, 0])
    joints = np.array(FEET)[placed]
    least = np.where(estimate.guessed[FEET_OF_LEGS][placed], sigma[joints], 0.0)
    moved[joints], sigma[joints] = estimate.feet.positions[placed], np.maximum(estimate.feet.sigma[placed], least)
    moved[0], sigma[0] = root.position, math.sqrt(float(np.mean(spread**2)))
    positions = fit_legs(moved, sigma, observed.body.bone_lengths)
    rotations = observed.body.rotations.astype(np.float64)
    rotations[0] = observed.orientation
    rotations = turn_legs(rotations, observed.positions, positions)
    rotations[~are_unit(rotations)] = [0.0, 0.0, 0.0, 1.0]  # the publisher may send positions without rotations
    known = np.isfinite(positions).all(axis=1) & np.isfinite(sigma)
    tracking = Tracking.OK if observed.root_observed else Tracking.COASTING
    both_rest = float(rest.reshape(2, 2).max(axis=0).min()) if observed.root_observed else 0.0
    contacts = estimate.contacts.load.copy()
    contacts[LEG_CONTACTS][estimate.guessed] = np.nan
    scale = VELOCITY_SCALE if observed.pelvis_observed else 1.0
    velocity, covariance = standing_velocity(root.velocity, root.covariance, both_rest, scale=scale)
    return WorldBody(
        id=observed.body.id,
        root_position=root.position,
        root_orientation=observed.orientation,
        root_velocity=velocity,
        covariance=covariance,
        positions=positions,
        rotations=rotations,
        state=np.where(known, observed.body.state, JointState.UNKNOWN),
        sigma=sigma,
        contacts=contacts,
        tracking=Tracking.LOST if math.hypot(*spread[:2]) > lost_sigma else tracking,
    )


def standing_velocity(velocity: Floats, covariance: Floats, both_rest: float, *, scale: float) -> tuple[Floats, Floats]:
    """Return velocity (3,) m/s and covariance (6, 6) of [position, velocity] of a root that may only sway.

    They are mean and covariance of a mixture of two cases: the root sways, or it moves as estimated.

    Args:
        velocity: (3,) m/s, the filter's estimate.
        covariance: (6, 6) of [position, velocity], the filter's: m², m²/s, m²/s².
        both_rest: probability that both feet rest.
        scale: factor on the filter's standard deviation of ``velocity``.
    """
    variance = float(np.trace(covariance[3:, 3:])) / 3.0
    error = VELOCITY_ERROR**2 * variance
    squared, sway, moves = float(velocity @ velocity), SWAY**2 + error, MOVES**2 + error
    log_odds = 1.5 * math.log(moves / sway) - 0.5 * squared * (1.0 / sway - 1.0 / moves)
    odds = SWAYS * both_rest / (1.0 - SWAYS * both_rest) * math.exp(log_odds)
    sways, slowed = odds / (1.0 + odds), error / sway
    spread = scale**2 * variance
    within = sways * SWAY**2 * spread / (SWAY**2 + spread) + (1.0 - sways) * spread
    scales = np.repeat([1.0, math.sqrt(within / variance)], 3)
    covariance = covariance * np.outer(scales, scales)
    covariance[3:, 3:] += sways * (1.0 - sways) * slowed**2 * np.outer(velocity, velocity)
    return velocity * (1.0 - sways * slowed), covariance
