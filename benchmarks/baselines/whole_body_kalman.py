"""A baseline for hidden joints: one Kalman filter of the whole body, with correlated joint accelerations.

The state is the position and velocity of 22 joints. Velocities are damped, and joints accelerate with the covariance of
training motion (`prior.models.mixture.tracks`), the only thing learned. It is the same for x, y and z, so one
covariance (44, 44) serves all three axes. A hidden joint contributes no measurement; it follows from the others'.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from steadypose.benchmarks.baselines.body import beside
from steadypose.prior.arrays import Floats
from steadypose.prior.compiled import njit
from steadypose.prior.models.mixture.tracks import body_covariance
from steadypose.prior.timing.rate import FPS

MIN_SIGMA = 0.01
"""Lower bound of a measurement's standard deviation along an axis, metres. Modes are not exact: with less, a joint's
noise moves hidden joints."""

FIRST_PLACE, FIRST_SPEED = 1.0, 1.0
"""Standard deviations of a joint before its first measurement: position in metres, velocity in m/s."""


class WholeBody(NamedTuple):
    """State of S bodies."""

    mean: Floats
    """(S, 44, 3) positions in metres, then velocities in m/s; positions are NaN before a first measurement"""
    covariance: Floats
    """(S, 44, 44) the same for each axis"""


def whole_body_kalman(seen: Floats, stamps_s: Floats, delay: int, density: float, damping: float) -> Floats:
    """Return joints (T, C, 22, 3) metres, z up, with hidden ones (NaN) estimated by the filter from the measurements up
    to their own frame.

    ``density`` is the mean process density of the joints, m²/s³, ``damping`` that of velocities, 1/s.
    """
    answers, clips, sigma = beside(seen, stamps_s, delay), seen.shape[1], np.full(22, MIN_SIGMA)
    first = np.diag(np.repeat(np.square([FIRST_PLACE, FIRST_SPEED]), 22))
    state = WholeBody(np.zeros((clips, 44, 3)), np.tile(first, (clips, 1, 1)))
    state.mean[:, :22] = np.nan
    for t, frame in enumerate(np.ascontiguousarray(seen)):
        step = stamps_s[t] - stamps_s[t - 1] if t else 1 / FPS
        for clip, measured in enumerate(frame):
            _step(state, clip, measured, sigma, body_covariance(), step, density, damping)
            hidden = np.isnan(measured[:, 0]) & np.isfinite(state.mean[clip, :22, 0])
            answers[t, clip, hidden] = state.mean[clip, :22][hidden]
    return answers


@njit(cache=True)
def _step(state, slot, measured, sigma, modes, dt, density, damping):
    """Predict a body's state by ``dt`` seconds, and update it by each measured joint (22, 3) metres, NaN if missing, in
    turn.

    ``sigma`` (22,) is in metres along an axis, ``modes`` (22, 22) is the covariance of joint accelerations, of mean
    variance 1; the rest as in `whole_body_kalman`.
    """
    mean, covariance, joints = state.mean[slot], state.covariance[slot], 22
    kept = math.exp(-damping * dt)
    moved = (1.0 - kept) / damping
    twice = (1.0 - kept * kept) / (2.0 * damping)
    of_speed = density * twice
    of_both = density * (moved - twice) / damping
    of_place = density * (dt - 2.0 * moved + twice) / damping**2
    for i in range(joints):
        for axis in range(3):
            mean[i, axis] += moved * mean[joints + i, axis]
            mean[joints + i, axis] *= kept
    for i in range(joints):
        for j in range(joints):
            xx, xv, vx, vv = (
                covariance[i, j],
                covariance[i, joints + j],
                covariance[joints + i, j],
                covariance[joints + i, joints + j],
            )
            noise = modes[i, j]
            covariance[i, j] = xx + moved * (xv + vx) + moved * moved * vv + of_place * noise
            covariance[i, joints + j] = kept * (xv + moved * vv) + of_both * noise
            covariance[joints + i, j] = kept * (vx + moved * vv) + of_both * noise
            covariance[joints + i, joints + j] = kept * kept * vv + of_speed * noise
    for joint in range(joints):
        if math.isfinite(measured[joint, 0]):
            _measure(mean, covariance, joint, measured[joint], max(sigma[joint], MIN_SIGMA))


@njit(cache=True)
def _measure(mean, covariance, joint, measured, sigma):
    """Update by one joint (3,)."""
    if math.isnan(mean[joint, 0]):
        # the first measurement is independent of all other joints
        for k in range(len(mean)):
            covariance[joint, k] = covariance[k, joint] = 0.0
        covariance[joint, joint] = sigma * sigma
        for axis in range(3):
            mean[joint, axis] = measured[axis]
        return
    size = len(mean)
    row = covariance[joint].copy()
    inverse = 1.0 / (row[joint] + sigma * sigma)
    off = np.empty(3)
    for axis in range(3):
        off[axis] = measured[axis] - mean[joint, axis]
    for k in range(size):
        gain = row[k] * inverse
        for axis in range(3):
            mean[k, axis] += gain * off[axis]
        for j in range(size):
            covariance[k, j] -= gain * row[j]
