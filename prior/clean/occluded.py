"""Occluded joints: each is estimated as a weighted mean of four candidates (`prior.models.occlusion`).

One candidate bridges a gap that ends within the delay, from the joint's own observations on both sides. A bank of
constant-velocity Kalman filters estimates it. Each filter has the position at the time in question as a further state
(fixed-point smoothing), and the estimates are weighted by the filters' likelihoods. Other joints are not used: over
0.2 s, this is more accurate than an estimate from the body.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.skeleton import HIPS, J, limbs
from steadypose.prior.compiled import median, njit
from steadypose.prior.models.occlusion import (
    FEATURES,
    LiveOcclusion,
    Occluded,
    Weighed,
    average,
    describe,
    forget,
    new_past,
    observe,
    stand,
)
from steadypose.prior.models.posture import LivePosture
from steadypose.prior.timing.rate import FPS

Weigher = Callable[[Occluded], Weighed]

FORGETTING_S = 2.0, 10.0
"""Seconds hidden after which the completion's standard deviation begins to be added to a joint's, and after which all
of it is added. The network is trained on gaps of 3 s. For joints hidden for 4 to 10 s, its error-to-sigma ratio is 1.3
to 1.6, and with this correction 0.9 to 1.1 (validation)."""

_LEGS, _UNOBSERVED_LEG = limbs(("knee", "ankle", "foot")), 1.4
_ARMS, _UNOBSERVED_ARM = limbs(("shoulder", "elbow", "wrist")), 1.6
_WAIST, _UNOBSERVED_WAIST = [*HIPS, J["spine1"], J["spine2"]], 2.0
"""Parts of the body, and factors on the completion's standard deviation for a part of which no joint was ever observed:
hips and lower spine, a leg below the hip, an arm below the shoulder. Without these factors, the error-to-sigma ratio on
validation people is 1.7 to 2.2 for hips and lower spine, 1.4 for legs, 1.46 for elbows and 1.73 for wrists."""

_OF_ARMS = np.isin(np.arange(22), np.ravel(_ARMS))

POSTURE_SHARE = 0.5
"""Share of the Gaussian of postures in the position of an arm's joint that was never observed. Half of the rest is the
averaged completion's, half a standing adult's (validation: 130 mm, 166 without the Gaussian). It does not improve legs,
whose bones are unknown too."""

DENSITIES = np.array([0.05, 0.3, 1.8, 10.0, 60.0])
"""Spectral densities of the acceleration noise of the filters that bridge a gap, m²/s³."""

BEFORE = 14  # largest number of frames before the gap that are used
MIN_NOISE = 1e-3  # least standard deviation of the measurements along an axis, metres
FIRST_SPEED = 3.0  # standard deviation of the velocity along an axis before it is measured, m/s


class Placed(NamedTuple):
    """N occluded joints."""

    joints: NDArray[np.intp]  # (N, 2) row of the body, and index of the joint
    positions: Floats  # (N, 3) metres
    sigma: Floats  # (N,) metres, standard deviation along an axis


class Track(NamedTuple):
    """The last frames of S bodies, for joints that are observed again within the delay."""

    positions: Floats  # (T, S, 22, 3) metres, observations; NaN where unobserved
    at: int  # index of the frame to be estimated
    noise: Floats  # (S,) metres along an axis, standard deviation of the observations


class OccludedJoints:
    """Estimates every body's occluded joints. Frames must come in order.

    Attributes:
        weigher: weighs the candidates; training replaces it with one that records them.
    """

    def __init__(self, weights: str, slots: int) -> None:
        self.weigher: Weigher = LiveOcclusion.load(weights)
        self._posture = LivePosture.load("default")
        self._past = new_past(slots)

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        forget(self._past, slot)

    def update(
        self,
        slots: NDArray[np.intp],
        positions: Floats,
        sigma: Floats,
        unobserved_s: Floats,
        observed_later: Bools,
        completed: Floats,
        completed_sigma: Floats | None,
        offsets: Floats,
        track: Track,
    ) -> Placed | None:
        """Estimate the occluded joints of B bodies; None if no joint is completed.

        A joint is occluded if another joint of its body was observed more recently. A frame without any observation
        therefore occludes no joint. A joint that was never observed gets the mean of two positions: the running mean of
        its completions, moved along with the body, and its position in a standing adult. An arm is then moved halfway
        to its expectation under the Gaussian of postures.

        Args:
            slots: (B,) slots of the bodies.
            positions: (B, 22, 3) metres, from the smoother; NaN for joints never observed.
            sigma: (B, 22) metres along an axis, from the smoother; inf for joints never observed.
            unobserved_s: (B, 22) seconds since each joint was last observed.
            observed_later: (B, 22) whether each joint is observed again within the delay.
            completed: (B, 22, 3) metres, from the completion network.
            completed_sigma: (B, 22) metres along an axis, inf for joints that are not completed; None if no body is.
            offsets: (B, 22, 3) metres, the people's bones.
            track: the observations of all slots.
        """
        held = np.empty_like(positions)
        observe(self._past, slots, positions, sigma, unobserved_s, held)
        if completed_sigma is None:
            return None
        known = np.isfinite(completed_sigma + completed[..., 0])
        if not known.any():
            return None
        never = known & np.isinf(unobserved_s)
        occluded = (
            known
            & (unobserved_s > unobserved_s.min(axis=1, keepdims=True))
            & np.isfinite(unobserved_s + sigma + held[..., 0])
        )
        average(self._past, slots, never, completed, held)
        placed = held.copy()
        stand(never, positions, unobserved_s, placed)
        self._place_arms(never, held, completed, sigma, unobserved_s, offsets, placed)
        bridged, bridged_sigma = positions.copy(), sigma.copy()
        _bridge(slots, occluded & observed_later, *track, bridged, bridged_sigma)
        candidates, sigmas = (positions, completed, held, bridged), (completed_sigma, bridged_sigma)
        weighed = self._weigh(slots, occluded, candidates, sigmas, sigma, unobserved_s, observed_later)
        share = np.interp(unobserved_s[occluded], FORGETTING_S, (0.0, 1.0))
        deviation = np.hypot(weighed.sigma, share * completed_sigma[occluded])
        observed_sigma = np.where(unobserved_s == 0.0, sigma, np.nan)
        deviation = _limited_by_bridge(deviation, occluded, observed_later, bridged_sigma, observed_sigma)
        return Placed(
            np.concatenate([np.argwhere(occluded), np.argwhere(never)]),
            np.concatenate([weighed.positions, placed[never]]),
            np.concatenate([deviation, (_unobserved_part_factors(never) * completed_sigma)[never]]),
        )

    def _place_arms(
        self,
        never: Bools,
        held: Floats,
        completed: Floats,
        sigma: Floats,
        unobserved_s: Floats,
        offsets: Floats,
        placed: Floats,
    ) -> None:
        """Move the arms' joints that were ``never`` (B, 22) observed in ``placed`` (B, 22, 3), in place, towards their
        expectation under the Gaussian of postures, given the observed joints."""
        arms = never & _OF_ARMS
        rows = np.flatnonzero(arms.any(axis=1))
        if len(rows):
            known = np.where(unobserved_s[rows] == 0.0, sigma[rows], np.inf)
            positions = np.where(np.isfinite(held[rows]), held[rows], completed[rows])
            expected = self._posture(positions, known, np.linalg.norm(offsets[rows], axis=-1)).positions
            placed[rows] += np.where(arms[rows], POSTURE_SHARE, 0.0)[..., None] * (expected - placed[rows])

    def _weigh(
        self,
        slots: NDArray[np.intp],
        occluded: Bools,
        candidates: tuple[Floats, ...],
        sigmas: tuple[Floats, ...],
        sigma: Floats,
        unobserved_s: Floats,
        observed_later: Bools,
    ) -> Weighed:
        # contiguous, because numba compiles a loop for every memory layout
        body, joint = (np.ascontiguousarray(index) for index in np.nonzero(occluded))
        if not len(body):
            return Weighed(np.empty((0, 3)), np.empty(0))
        chosen = np.stack([positions[body, joint] for positions in candidates], axis=1)
        deviations = np.stack([each[body, joint] for each in sigmas], axis=1)
        features = np.empty((len(body), FEATURES), dtype=np.float32)
        _describe(self._past, slots, body, joint, chosen, deviations, sigma, unobserved_s, observed_later, features)
        return self.weigher(Occluded(body, joint, chosen, features))


def _limited_by_bridge(
    sigma: Floats, occluded: Bools, observed_later: Bools, bridged: Floats, observed: Floats
) -> Floats:
    """Limit the standard deviations (N,) of ``occluded`` (B, 22) joints that are observed again within the delay.

    For these joints, the network's deviation ``sigma`` (N,) is twice the error. That of the filters, ``bridged`` (B,
    22), is more accurate, but omits time-correlated errors. These add as much as they do to the deviations of the
    body's ``observed`` joints (B, 22), which are NaN for other joints: their median is the lower bound.
    """
    limited = sigma.copy()
    for k, (row, joint) in enumerate(np.argwhere(occluded)):
        others = observed[row][np.isfinite(observed[row])]
        if observed_later[row, joint] and len(others):
            limited[k] = np.fmin(sigma[k], max(bridged[row, joint], median(others)))
    return limited


def _unobserved_part_factors(never: Bools) -> Floats:
    """(B, 22) factors on the deviations of joints in parts whose joints were all ``never`` (B, 22) observed; 1 for
    others."""
    factors = np.ones(never.shape)
    factors[:, _WAIST] = np.where(never[:, _WAIST].all(axis=1), _UNOBSERVED_WAIST, 1.0)[:, None]
    for leg in _LEGS:
        factors[:, leg] = np.where(never[:, leg].all(axis=1), _UNOBSERVED_LEG, 1.0)[:, None]
    for _, *arm in _ARMS:
        factors[:, arm] = np.where(never[:, arm].all(axis=1), _UNOBSERVED_ARM, 1.0)[:, None]
    return factors


@njit(cache=True)
def _bridge(slots, bridgeable, positions, at, noise, bridged, sigma):
    place = np.empty(3)
    for row, slot in enumerate(slots):
        for joint in range(bridgeable.shape[1]):
            if not bridgeable[row, joint]:
                continue
            deviation = bridge(positions[:, slot, joint], at, noise[slot], place)
            if np.isfinite(deviation):
                sigma[row, joint] = deviation
                for axis in range(3):
                    bridged[row, joint, axis] = place[axis]


@njit(cache=True)
def _describe(past, slots, body, joint, candidates, sigmas, sigma, unobserved_s, observed_later, features):
    for row in range(len(body)):
        b, j = body[row], joint[row]
        describe(past, slots[b], j, candidates[row], sigmas[row], sigma[b], unobserved_s[b], observed_later[b, j],
                 features[row])  # fmt: skip


@njit(cache=True)
def bridge(track, at, noise, place):
    """Estimate a joint's position in the frame ``at`` from its observations (T, 3) before and after, NaN where
    unobserved, of this noise; returns its deviation. All in metres, along an axis.

    ``place`` (3,) is written; NaN if there is no observation before ``at``.
    """
    last = at
    while last >= 0 and math.isnan(track[last, 0]):
        last -= 1
    if last < 0:
        for axis in range(3):
            place[axis] = np.nan
        return np.inf
    count, square = len(DENSITIES), max(noise, MIN_NOISE) ** 2
    places, variances, likelihoods = np.empty((count, 3)), np.empty(count), np.empty(count)
    for k in range(count):
        likelihoods[k], variances[k] = _fixed_point(
            track, max(last - BEFORE + 1, 0), at, DENSITIES[k], square, places[k]
        )
    most, total, variance = likelihoods.max(), 0.0, 0.0
    for k in range(count):
        likelihoods[k] = math.exp(likelihoods[k] - most)
        total += likelihoods[k]
    for axis in range(3):
        place[axis] = 0.0
        for k in range(count):
            place[axis] += likelihoods[k] / total * places[k, axis]
    for k in range(count):
        apart = 0.0
        for axis in range(3):
            apart += (places[k, axis] - place[axis]) ** 2
        variance += likelihoods[k] / total * (variances[k] + apart / 3.0)
    return math.sqrt(variance)


@njit(cache=True)
def _fixed_point(track, first, at, density, square, place):
    """Run one filter and write ``place`` (3,); returns the log-likelihood from frame ``first`` on, and the variance."""
    dt, likelihood, begun = 1.0 / FPS, 0.0, False
    mean, gain = np.zeros((3, 3)), np.zeros(3)  # position, velocity, position in question
    p = np.zeros((3, 3))
    for t in range(first, len(track)):
        observed = not math.isnan(track[t, 0])
        if not begun:
            if observed:
                begun = True
                p[0, 0], p[1, 1] = square, FIRST_SPEED**2
                for axis in range(3):
                    mean[0, axis] = track[t, axis]
        else:
            for axis in range(3):
                mean[0, axis] += dt * mean[1, axis]
            p[0, 0] += 2.0 * dt * p[0, 1] + dt * dt * p[1, 1] + density * dt**3 / 3.0
            p[0, 1] += dt * p[1, 1] + density * dt**2 / 2.0
            p[0, 2] += dt * p[1, 2]
            p[1, 1] += density * dt
            p[1, 0], p[2, 0] = p[0, 1], p[0, 2]
            if observed:
                innovation = p[0, 0] + square
                for k in range(3):
                    gain[k] = p[k, 0] / innovation
                for axis in range(3):
                    off = track[t, axis] - mean[0, axis]
                    likelihood -= 0.5 * off * off / innovation
                    for k in range(3):
                        mean[k, axis] += gain[k] * off
                likelihood -= 1.5 * math.log(innovation)
                row = p[0].copy()
                for k in range(3):
                    for m in range(3):
                        p[k, m] -= gain[k] * row[m]
        if t == at:
            for axis in range(3):
                mean[2, axis] = mean[0, axis]
            p[2, 0] = p[0, 2] = p[2, 2] = p[0, 0]
            p[2, 1] = p[1, 2] = p[0, 1]
    for axis in range(3):
        place[axis] = mean[2, axis]
    return likelihood, p[2, 2]
