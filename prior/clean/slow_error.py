"""The sensor's slow error, found from bones: no filter averages it out, but it makes a person's bones change length.

The length of a rigid part of the body varies by the noise that the smoother leaves, which it states, and by the
sensor's slow error: what is left of the variance, halved since a bone has two ends, is that error's variance. Where the
mean length differs from the person's bone, or one part varies by more than the others do, the sensor's idea of a joint
differs from the skeleton's: that part's length is uncertain. It says how far this person's bones are to be measured
rather than taken from human proportions, and how firmly they hold hidden joints. Moving seen joints onto the bones by
it was tried: 0.2 % of a Kinect's error, for 0.6 mm of a perfect input's.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from steadypose.prior.body.inverse_kinematics import RIGID
from steadypose.prior.body.skeleton import PARENT
from steadypose.prior.clean.frame import Bools, Floats
from steadypose.prior.compiled import median
from steadypose.prior.timing.fixed_lag import Smoothed
from steadypose.prior.timing.rate import FPS

MEMORY = round(3.0 * FPS)
"""Frames of the running moments: long beside an error that lasts for half a second, short beside a change of sensor."""

PRIOR_FRAMES = round(0.5 * FPS)
"""Frames that what is expected of the sensor counts for."""

JITTER_RATIO = 4.0
"""Times its jitter that a sensor's slow error is expected to be at most, so that nothing is expected of one without
any. A Kinect v2's bones say 5.5 mm where third differences say 0.7 (medians of UI-PRMD, s01 to s06); what the gate
measures is larger, for it includes what the body's own motion adds."""

MIN_FRAMES = 3
"""Frames of which a length's mean and variance are known."""

UNKNOWN_VARIANCE = 1e-4
"""m², of a length seen for fewer frames: a centimetre."""

INDEPENDENT = 5.0
"""Frames after which what the smoother leaves of the noise is another."""

SURE = 0.05
"""Metres along an axis: a joint whose place is known less well measures no length."""

_BONE = np.array([k for k, (end, start) in enumerate(RIGID) if start == PARENT[end]])


class SlowError(NamedTuple):
    """What was found of the sensor's slow error.

    Attributes:
        bias_sigma: (S,) metres along an axis, by body.
        length_variance: (S, R) m², of each of `RIGID`: by how much the length seen is not that of the person's bones.
    """

    bias_sigma: Floats
    length_variance: Floats


class SlowErrorEstimator:
    """Keeps, for each body, running moments of the lengths of all that is rigid.

    Args:
        bias_sigma: metres along an axis, the slow error to be expected at most, before it is found.
        slots: bodies.

    Attributes:
        bias_sigma: (S,) metres along an axis, as last found.
    """

    def __init__(self, bias_sigma: float, slots: int) -> None:
        self._expected = bias_sigma
        self.bias_sigma = np.full(slots, bias_sigma)
        self._moments = np.zeros((4, slots, len(RIGID)))  # frames, mean, variance, variance by noise

    def forget(self, slot: Bools) -> None:
        """Start these slots afresh."""
        self._moments[:, slot] = 0.0
        self.bias_sigma = np.where(slot, self._expected, self.bias_sigma)

    def update(self, smoothed: Smoothed | None, offsets: Floats, jitter: Floats) -> SlowError:
        """Take a smoothed frame in, if there is one.

        Args:
            smoothed: (S, 22) joints and their standard deviations.
            offsets: (S, 22, 3) metres, the bones in use.
            jitter: (S,) metres along an axis, the noise from frame to frame.
        """
        expected = np.minimum(self._expected, JITTER_RATIO * jitter)
        bias, length = expected.copy(), np.full((len(offsets), len(RIGID)), UNKNOWN_VARIANCE)
        if smoothed is not None:
            _find(smoothed.positions, smoothed.sigma, offsets, expected, self._moments, bias, length)
        self.bias_sigma = bias
        return SlowError(bias, length)


@njit(cache=True)
def _find(positions, sigma, offsets, expected, moments, bias, length_variance):
    """As `SlowErrorEstimator.update`; writes ``bias`` (S,) and ``length_variance`` (S, R)."""
    rest, lasting = np.zeros((22, 3)), np.empty(len(_BONE))
    for s in range(len(positions)):
        for joint in range(1, 22):
            for axis in range(3):
                rest[joint, axis] = rest[PARENT[joint], axis] + offsets[s, joint, axis]
        frames, mean, variance, noise = moments[0, s], moments[1, s], moments[2, s], moments[3, s]
        most = 0.0
        for k in range(len(RIGID)):
            a, b = RIGID[k]
            left = sigma[s, a] ** 2 + sigma[s, b] ** 2
            length = _apart(positions[s], a, b)
            most = max(most, frames[k])
            if not (left < 2 * SURE**2 and math.isfinite(length)):
                continue
            frames[k] += 1
            most = max(most, frames[k])
            share = 1.0 / min(frames[k], MEMORY)
            off = length - mean[k]
            mean[k] += share * off
            variance[k] = (1.0 - share) * (variance[k] + share * off * off)
            noise[k] += share * (left - noise[k])
        known = 0
        for k in _BONE:
            if frames[k] > MIN_FRAMES:
                lasting[known] = max(variance[k] - noise[k], 0.0)
                known += 1
        found = 0.5 * median(lasting[:known]) if known else 0.0
        square = (PRIOR_FRAMES * expected[s] ** 2 + most * found) / (PRIOR_FRAMES + most)
        bias[s] = math.sqrt(square)
        for k in range(len(RIGID)):
            if frames[k] <= MIN_FRAMES:
                length_variance[s, k] = UNKNOWN_VARIANCE
                continue
            own = _apart(rest, RIGID[k, 0], RIGID[k, 1])
            apart = (mean[k] - own) ** 2 - noise[k] / max(frames[k] / INDEPENDENT, 1.0)
            length_variance[s, k] = max(apart, 0.0) + max(variance[k] - noise[k] - 2.0 * square, 0.0)


@njit(cache=True)
def _apart(positions, a, b):
    square = 0.0
    for axis in range(3):
        square += (positions[a, axis] - positions[b, axis]) ** 2
    return math.sqrt(square)
