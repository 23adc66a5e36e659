"""Estimates from bone lengths: the person's bones, and the sensor's bias.

Bones are measured in the first ten seconds, with human proportions as the prior.

No filter averages out the sensor's bias, but it changes the lengths of bones. The observed length of a rigid segment
varies with the noise after smoothing, whose variance the smoother gives, and with the bias. The rest of the length's
variance, halved because a bone has two ends, is the bias's variance. If the mean length differs from the person's bone,
or one segment varies by more than the others, the sensor's definition of a joint differs from the skeleton's. The
length of that segment is then uncertain. The estimates weigh measured bones against human proportions
(`prior.body.bone_lengths`) and determine how tightly bones constrain hidden joints. Observed joints are not constrained
here; the posture stage counts lengths as one observation among many.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.bone_lengths import estimate_bones
from steadypose.prior.body.inverse_kinematics import RIGID
from steadypose.prior.body.skeleton import PARENT, REST_OFFSETS
from steadypose.prior.body.vectors import apart
from steadypose.prior.clean.frame import Person
from steadypose.prior.clean.settings import PersonSettings
from steadypose.prior.compiled import median, njit
from steadypose.prior.timing.kalman import Smoothed
from steadypose.prior.timing.rate import FPS

MEMORY = round(3.0 * FPS)
"""Length of the running moments, and most frames that a mean counts for, frames. It is long compared with an error's
correlation time of half a second, and short compared with a change of sensor."""

PRIOR_FRAMES = round(0.5 * FPS)  # weight of the expected bias as the prior, frames

JITTER_RATIO = 4.0
"""Upper bound of the expected bias, as a multiple of the jitter, so that a noise-free sensor has none. For a Kinect v2,
bones give a bias of 5.5 mm and third differences a jitter of 0.7 mm (medians of UI-PRMD, s01 to s06). The gate's
estimate of the jitter is larger, because it includes part of the body's motion."""

MIN_FRAMES = 3  # number of frames after which a length's mean and variance are used
UNKNOWN_VARIANCE = 1e-4  # length variance of a segment observed for at most `MIN_FRAMES` frames, m²: (1 cm)²
CORRELATION_FRAMES = 5.0  # correlation time of the noise after smoothing, frames

OWN_LENGTH, GENERIC_LENGTH = 0.015, 0.025
"""Standard deviation of a sensor's bone length about the person's, and about a generic adult's until the person has
been measured, metres. A sensor's joints are not exactly the skeleton's."""

MAX_SIGMA = 0.05  # largest standard deviation along an axis of a joint that counts for lengths, metres

_BONE = np.array([k for k, (end, start) in enumerate(RIGID) if start == PARENT[end]])

_MIN_JOINTS = 8  # least number of joints with a standard deviation below MAX_SIGMA in a sampled frame
_GROWTH = 1.5  # growth of the number of samples after which the estimate is renewed, factor
_SLOTS_PER_RENEWAL = 8  # number of slots for each renewal allowed in one frame
_APPROACH = 0.1  # share of the way to a renewed estimate per frame; a jump of the bones would shake the whole limb
_MIN_SAMPLES = 4  # least number of samples for the bones to count as measured


class PersonEstimator:
    """Estimates the bones of every body by `estimate_bones`, from frames sampled in its first ten seconds.

    The estimate is renewed whenever the number of samples has grown by half, so that it costs little and settles. The
    bones in use approach it smoothly.

    Attributes:
        current: the bones in use since the last frame.
    """

    def __init__(self, settings: PersonSettings, slots: int) -> None:
        self._settings = settings
        self._samples = np.full((slots, settings.samples, 22, 3), np.nan)
        self._target = np.zeros((slots, 22, 3))
        self._target_variance = np.zeros((slots, 22))
        self._count = np.zeros(slots, dtype=np.int64)
        self._used = np.zeros(slots, dtype=np.int64)
        self._wait = np.zeros(slots, dtype=np.int64)
        self.current = Person.generic(slots)

    def forget(self, slot: Bools) -> None:
        """Forget the people in these slots (S,)."""
        self._samples[slot] = np.nan
        self._count[slot] = self._used[slot] = 0
        self._wait[slot] = 0
        before = self.current
        self.current = Person(
            np.where(slot[:, None, None], REST_OFFSETS, before.offsets),
            np.where(slot[:, None], 0.0, before.length_variance),
            before.measured & ~slot,
        )

    def update(self, smoothed: Smoothed | None, bias_sigma: Floats, present: Bools) -> Person:
        """Sample the newest estimate, if there is one, of the bodies ``present`` (S,) for which a sample is due, and
        renew the bones. ``bias_sigma`` (S,) metres along an axis is the sensor's bias estimated so far."""
        if not self._settings.enabled or smoothed is None:
            return self.current
        # smoothed positions, because noise lengthens bones
        known = smoothed.sigma < MAX_SIGMA
        positions = np.where(known[..., None], smoothed.positions, np.nan)
        enough = known.sum(axis=1) >= _MIN_JOINTS
        self._wait -= 1
        due = present & enough & (self._wait < 0) & (self._count < self._settings.samples)
        for slot in np.flatnonzero(due):
            self._samples[slot, self._count[slot]] = positions[slot]
            self._count[slot] += 1
            self._wait[slot] = self._settings.every - 1
        full = self._count == self._settings.samples
        renew = (self._count >= _GROWTH * self._used) | (full & (self._count > self._used))
        # people who entered together are due in the same frame; after the first estimate, renew only a few per frame
        stale = np.flatnonzero(renew & (self._count > 0) & present & enough)
        first, later = stale[self._used[stale] == 0], stale[self._used[stale] > 0]
        offsets, variance = self.current.offsets.copy(), self.current.length_variance.copy()
        measured = self.current.measured.copy()
        for slot in [*first, *later[: max(1, len(self._count) // _SLOTS_PER_RENEWAL)]]:
            count = self._used[slot] = self._count[slot]
            noise = float(np.median(smoothed.sigma[slot, known[slot]]))
            self._target[slot], self._target_variance[slot] = estimate_bones(
                self._samples[slot, :count], float(bias_sigma[slot]), noise, self._settings.samples
            )
            measured[slot] = count >= _MIN_SAMPLES
            if count == 1:
                offsets[slot], variance[slot] = self._target[slot], self._target_variance[slot]
        begun = self._used > 0
        offsets[begun] += _APPROACH * (self._target[begun] - offsets[begun])
        variance[begun] += _APPROACH * (self._target_variance[begun] - variance[begun])
        self.current = Person(offsets, variance, measured)
        return self.current


class SensorBias(NamedTuple):
    """The sensor's bias, and its effect on lengths."""

    bias_sigma: Floats  # (S,) metres along an axis, estimated from each body
    length_variance: Floats  # (S, R) m², variance of each `RIGID` segment's observed length about the person's bone
    lengths: Floats
    """(S, 22) metres, length of each joint's bone: mean of the lately observed one and the person's, weighted by their
    variances; 0 for the root"""


class BiasEstimator:
    """Keeps running moments of the lengths of the segments of `RIGID`, for each of ``slots`` bodies.

    ``bias_sigma`` is an upper bound of the expected bias, metres along an axis; the attribute (S,) is the latest
    estimate.
    """

    def __init__(self, bias_sigma: float, slots: int) -> None:
        self._expected = bias_sigma
        self.bias_sigma = np.full(slots, bias_sigma)
        self._moments = np.zeros((4, slots, len(RIGID)))  # frames, mean, variance, variance by noise

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        self._moments[:, slot] = 0.0
        self.bias_sigma = np.where(slot, self._expected, self.bias_sigma)

    def update(self, smoothed: Smoothed | None, person: Person, jitter: Floats) -> SensorBias:
        """Update the estimate with a smoothed frame, if there is one, of bodies with these bones and this jitter (S,)
        of the sensor, metres along an axis."""
        expected = np.minimum(self._expected, JITTER_RATIO * jitter)
        bias, variance = expected.copy(), np.full((len(expected), len(RIGID)), UNKNOWN_VARIANCE)
        if smoothed is not None:
            _estimate(smoothed.positions, smoothed.sigma, person.offsets, expected, self._moments, bias, variance)
        self.bias_sigma = bias
        return SensorBias(bias, variance, self._lengths(person))

    def _lengths(self, person: Person) -> Floats:
        lengths, ends = np.linalg.norm(person.offsets, axis=-1), RIGID[_BONE, 0]
        frames, mean, _, noise = self._moments[:, :, _BONE]
        own = person.length_variance[:, ends] + np.where(person.measured, OWN_LENGTH, GENERIC_LENGTH)[:, None] ** 2
        rough = noise / np.maximum(np.minimum(frames, MEMORY) / CORRELATION_FRAMES, 1.0)
        share = np.where(frames > 0, own / (own + rough), 0.0)
        lengths[:, ends] += share * (mean - lengths[:, ends])
        return lengths


@njit(cache=True)
def _estimate(positions, sigma, offsets, expected, moments, bias, length_variance):
    """Write ``bias`` (S,) and ``length_variance`` (S, R), as described in `BiasEstimator.update`."""
    rest, unexplained = np.zeros((22, 3)), np.empty(len(_BONE))
    for s in range(len(positions)):
        for joint in range(1, 22):
            for axis in range(3):
                rest[joint, axis] = rest[PARENT[joint], axis] + offsets[s, joint, axis]
        frames, mean, variance, noise = moments[0, s], moments[1, s], moments[2, s], moments[3, s]
        most = 0.0
        for k in range(len(RIGID)):
            a, b = RIGID[k]
            left = sigma[s, a] ** 2 + sigma[s, b] ** 2
            length = apart(positions[s], a, b)
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
                unexplained[known] = max(variance[k] - noise[k], 0.0)
                known += 1
        excess = 0.5 * median(unexplained[:known]) if known else 0.0
        square = (PRIOR_FRAMES * expected[s] ** 2 + most * excess) / (PRIOR_FRAMES + most)
        bias[s] = math.sqrt(square)
        for k in range(len(RIGID)):
            if frames[k] <= MIN_FRAMES:
                length_variance[s, k] = UNKNOWN_VARIANCE
                continue
            own = apart(rest, RIGID[k, 0], RIGID[k, 1])
            square_off = (mean[k] - own) ** 2 - noise[k] / max(min(frames[k], MEMORY) / CORRELATION_FRAMES, 1.0)
            length_variance[s, k] = max(square_off, 0.0) + max(variance[k] - noise[k] - 2.0 * square, 0.0)
