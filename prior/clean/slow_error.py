"""Estimate of the sensor's slow error (bias) from bones: no filter averages it out, but it varies their lengths.

The observed length of a rigid segment varies by the noise that the smoother leaves, whose variance it states, and by
the sensor's slow error: the rest of the variance, halved because a bone has two ends, is that error's variance. Where
the mean length differs from the person's bone, or one segment varies by more than the others, the sensor's definition
of a joint differs from the skeleton's, and that segment's length is uncertain. The estimates weigh measured bones
against human proportions (`prior.body.bone_lengths`), and say how firmly bones hold hidden joints. Moving observed
joints onto the bones by them was tried: it gains 0.2 % of a Kinect's error, and costs 0.6 mm on a perfect input.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.inverse_kinematics import RIGID
from steadypose.prior.body.skeleton import PARENT
from steadypose.prior.compiled import median, njit
from steadypose.prior.timing.fixed_lag import Smoothed
from steadypose.prior.timing.rate import FPS

MEMORY = round(3.0 * FPS)
"""Frames of the running moments: long against an error's correlation time of half a second, short against a change of
sensor."""

PRIOR_FRAMES = round(0.5 * FPS)
"""Frames for which the expected slow error counts, as a prior."""

JITTER_RATIO = 4.0
"""Upper bound of the expected slow error, as a multiple of the jitter, so that none is expected of a perfect sensor. Of
a Kinect v2, bones give a slow error of 5.5 mm where third differences give a jitter of 0.7 mm (medians of UI-PRMD, s01
to s06); the gate's estimate of the jitter is larger, as it includes part of the body's motion."""

MIN_FRAMES = 3
"""A length's mean and variance are used only after more frames than this."""

UNKNOWN_VARIANCE = 1e-4
"""m², length variance of a segment seen for no more frames: (1 cm)²."""

CORRELATION_FRAMES = 5.0
"""Correlation time of the noise that the smoother leaves, in frames."""

MAX_SIGMA = 0.05
"""Metres along an axis: joints of a larger standard deviation do not count for lengths."""

_BONE = np.array([k for k, (end, start) in enumerate(RIGID) if start == PARENT[end]])


class SlowError(NamedTuple):
    """The sensor's slow error, and what it does to lengths.

    Attributes:
        bias_sigma: (S,) metres along an axis, estimated from each body.
        length_variance: (S, R) m², of each segment of `RIGID`: of its observed length about the person's bone.
    """

    bias_sigma: Floats
    length_variance: Floats


class SlowErrorEstimator:
    """Keeps, for each body, running moments of the lengths of the segments of `RIGID`.

    Args:
        bias_sigma: metres along an axis, the expected slow error, at most.
        slots: bodies.

    Attributes:
        bias_sigma: (S,) metres along an axis, the latest estimate.
    """

    def __init__(self, bias_sigma: float, slots: int) -> None:
        self._expected = bias_sigma
        self.bias_sigma = np.full(slots, bias_sigma)
        self._moments = np.zeros((4, slots, len(RIGID)))  # frames, mean, variance, variance by noise

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        self._moments[:, slot] = 0.0
        self.bias_sigma = np.where(slot, self._expected, self.bias_sigma)

    def update(self, smoothed: Smoothed | None, offsets: Floats, jitter: Floats) -> SlowError:
        """Take a smoothed frame in, if there is one.

        Args:
            smoothed: (S, 22) joints and their standard deviations.
            offsets: (S, 22, 3) metres, the bones in use.
            jitter: (S,) metres along an axis.
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
            if not (left < 2 * MAX_SIGMA**2 and math.isfinite(length)):
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
            apart = (mean[k] - own) ** 2 - noise[k] / max(frames[k] / CORRELATION_FRAMES, 1.0)
            length_variance[s, k] = max(apart, 0.0) + max(variance[k] - noise[k] - 2.0 * square, 0.0)


@njit(cache=True)
def _apart(positions, a, b):
    square = 0.0
    for axis in range(3):
        square += (positions[a, axis] - positions[b, axis]) ** 2
    return math.sqrt(square)
