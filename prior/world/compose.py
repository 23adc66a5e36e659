"""A body of `pose/world`, composed of what the stages estimate of it.

Where the root is observed, joints stay where `pose/clean` has them, but for the feet, which stand as far as they rest,
and what of the legs hangs on them by bones. Where it is not, the body goes with its root. A body with both feet at rest
is published standing, its root at the velocity of one that sways.
"""

from __future__ import annotations

import math

import numpy as np

from steadypose.msgs.contract import are_unit
from steadypose.msgs.types import JointState, Tracking, WorldBody
from steadypose.prior.arrays import Floats
from steadypose.prior.world.core import BodyEstimate
from steadypose.prior.world.legs import fit_legs, turn_legs
from steadypose.prior.world.observe import FEET

SWAY, MOVES = 0.015, 0.1
"""Standard deviations along an axis of the velocity of a root that sways over both feet, as in half of the training
motion with both at rest, and of one that bends or shifts, m/s."""

SWAYS = 0.5
"""Share of bodies with both feet at rest that only sway."""

VELOCITY_ERROR = 0.3
"""Ratio of the error to the filter's standard deviation of an observed velocity, of a body that stands (validation)."""

VELOCITY_STATED = 0.6
"""Ratio of the published to the filter's standard deviation of an observed velocity: what validation finds in motion,
from noise of 0 to 4 cm (benchmarks/NOTEBOOK.md)."""


def compose(estimate: BodyEstimate, lost_sigma: float) -> WorldBody:
    """The body as published; LOST where the root's horizontal standard deviation exceeds ``lost_sigma`` metres."""
    observed, root, rest = estimate.observed, estimate.root, estimate.stance.rest
    spread = root.position_sigma
    sigma = np.sqrt(observed.sigma**2 + (0.0 if observed.root_observed else float(np.mean(spread**2))))
    moved = observed.positions + root.shift
    placed = np.isfinite(root.feet[:, 0])
    joints = np.array(FEET)[placed]
    moved[joints], sigma[joints] = estimate.feet.positions[placed], estimate.feet.sigma[placed]
    moved[0], sigma[0] = root.position, math.sqrt(float(np.mean(spread**2)))
    positions = fit_legs(moved, sigma, observed.body.bone_lengths)
    rotations = observed.body.rotations.astype(np.float64)
    rotations[0] = observed.orientation
    rotations = turn_legs(rotations, observed.positions, positions)
    rotations[~are_unit(rotations)] = [0.0, 0.0, 0.0, 1.0]  # a message of somebody who knows positions alone
    known = np.isfinite(positions).all(axis=1) & np.isfinite(sigma)
    tracking = Tracking.OK if observed.root_observed else Tracking.COASTING
    both_rest = float(rest.reshape(2, 2).max(axis=0).min()) if observed.root_observed else 0.0
    stated = VELOCITY_STATED if observed.pelvis_observed else 1.0
    velocity, covariance = standing_velocity(root.velocity, root.covariance, both_rest, stated=stated)
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
        contacts=estimate.contacts.load,
        tracking=Tracking.LOST if math.hypot(*spread[:2]) > lost_sigma else tracking,
    )


def standing_velocity(
    velocity: Floats, covariance: Floats, both_rest: float, *, stated: float
) -> tuple[Floats, Floats]:
    """The velocity (3,) m/s of a root that may only sway, and the covariance (6, 6) of [position, velocity] then.

    Mean and covariance under a mixture of two: it sways, or moves, and then as estimated.

    Args:
        velocity: (3,) m/s, as the filter estimates it.
        covariance: (6, 6) of [position, velocity]: m², m²/s, m²/s², as the filter states it.
        both_rest: the probability that both feet rest.
        stated: of the standard deviation of ``velocity`` that the filter states, what is to be published.
    """
    variance = float(np.trace(covariance[3:, 3:])) / 3.0
    error = VELOCITY_ERROR**2 * variance
    squared, sway, moves = float(velocity @ velocity), SWAY**2 + error, MOVES**2 + error
    log_odds = 1.5 * math.log(moves / sway) - 0.5 * squared * (1.0 / sway - 1.0 / moves)
    odds = SWAYS * both_rest / (1.0 - SWAYS * both_rest) * math.exp(log_odds)
    sways, slowed = odds / (1.0 + odds), error / sway
    spread = stated**2 * variance
    within = sways * SWAY**2 * spread / (SWAY**2 + spread) + (1.0 - sways) * spread
    scale = np.repeat([1.0, math.sqrt(within / variance)], 3)
    covariance = covariance * np.outer(scale, scale)
    covariance[3:, 3:] += sways * (1.0 - sways) * slowed**2 * np.outer(velocity, velocity)
    return velocity * (1.0 - sways * slowed), covariance
