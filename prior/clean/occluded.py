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
"""Times hidden at which the completion's deviation begins to be added to a joint's, and from which all of it is,
seconds. The network is trained on 3 s. For joints hidden for 4 to 10 s its error-to-sigma ratio is 1.3 to 1.6, and with
this correction 0.9 to 1.1 (validation)."""

_LEGS, _UNSEEN_LEG = limbs(("knee", "ankle", "foot")), 1.4
_ARMS, _UNSEEN_ARM = limbs(("shoulder", "elbow", "wrist")), 1.6
_WAIST, _UNSEEN_WAIST = [*HIPS, J["spine1"], J["spine2"]], 2.0
"""Parts of the body, and factors on the completion's deviation for hips and lower spine, and for the joints below a
leg's hip and an arm's shoulder, if no joint of that part was ever observed. Without them, the error-to-sigma ratio on
validation people is 1.7 to 2.2 for hips and lower spine, 1.4 for legs, 1.46 for elbows and 1.73 for wrists."""

_OF_ARMS = np.isin(np.arange(22), np.ravel(_ARMS))

POSTURE_SHARE = 0.5
"""Share of the Gaussian of postures in the position of a joint of an arm that was never observed; half of the rest is
the averaged completion's, half a standing adult's (validation: 130 mm, 166 without the Gaussian). For legs, whose bones
are unknown too, the Gaussian brings nothing."""

DENSITIES = np.array([0.05, 0.3, 1.8, 10.0, 60.0])
"""Spectral densities of the acceleration noise of the filters that bridge a gap, m²/s³."""

BEFORE = 14  # largest number of frames before the gap that are used
MIN_NOISE = 1e-3  # least standard deviation of the measurements along an axis, metres
FIRST_SPEED = 3.0  # standard deviation of the velocity along an axis before it is measured, m/s


class Placed(NamedTuple):
    """N occluded joints."""

    joints: NDArray[np.intp]
    """(N, 2) row of the body, and index of the joint"""
    positions: Floats
    """(N, 3) metres"""
    sigma: Floats
    """(N,) metres, standard deviation along an axis"""


class Track(NamedTuple):
    """The last frames of S bodies, for joints that are observed again within the delay."""

    positions: Floats
    """(T, S, 22, 3) metres, observations; NaN where unobserved"""
    at: int
    """index of the frame to be estimated"""
    noise: Floats
    """(S,) metres along an axis, standard deviation of the observations"""


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
        seen: Floats,
        sigma: Floats,
        unseen_s: Floats,
        seen_later: Bools,
        completed: Floats,
        completed_sigma: Floats | None,
        offsets: Floats,
        track: Track,
    ) -> Placed | None:
        """Estimate the occluded joints of B bodies; None if no joint is completed.

        A joint is occluded if another joint of its body was observed more recently. A frame without any observation
        therefore occludes no joint. A joint that was never observed is placed halfway between two positions: the
        running mean of its completions, moved along with the body, and its position in a standing adult. An arm is
        halfway from there to its expectation in the Gaussian of postures.

        Args:
            slots: (B,) slots of the bodies.
            seen: (B, 22, 3) metres, from the smoother; NaN for joints never observed.
            sigma: (B, 22) metres along an axis, from the smoother; inf for joints never observed.
            unseen_s: (B, 22) seconds since each joint was last observed.
            seen_later: (B, 22) whether each joint is observed again within the delay.
            completed: (B, 22, 3) metres, from the completion network.
            completed_sigma: (B, 22) metres along an axis, inf for joints that are not completed; None if no body is.
            offsets: (B, 22, 3) metres, the people's bones.
            track: the observations of all slots.
        """
        held = np.empty_like(seen)
        observe(self._past, slots, seen, sigma, unseen_s, held)
        if completed_sigma is None:
            return None
        known = np.isfinite(completed_sigma + completed[..., 0])
        if not known.any():
            return None
        never = known & np.isinf(unseen_s)
        occluded = (
            known & (unseen_s > unseen_s.min(axis=1, keepdims=True)) & np.isfinite(unseen_s + sigma + held[..., 0])
        )
        average(self._past, slots, never, completed, held)
        placed = held.copy()
        stand(never, seen, unseen_s, placed)
        self._place_arms(never, held, completed, sigma, unseen_s, offsets, placed)
        bridged, bridged_sigma = seen.copy(), sigma.copy()
        _bridge(slots, occluded & seen_later, *track, bridged, bridged_sigma)
        candidates, sigmas = (seen, completed, held, bridged), (completed_sigma, bridged_sigma)
        weighed = self._weigh(slots, occluded, candidates, sigmas, sigma, unseen_s, seen_later)
        share = np.clip((unseen_s[occluded] - FORGETTING_S[0]) / (FORGETTING_S[1] - FORGETTING_S[0]), 0.0, 1.0)
        forgotten = np.hypot(weighed.sigma, share * completed_sigma[occluded])
        between = _of_bridged(forgotten, occluded, seen_later, bridged_sigma, np.where(unseen_s == 0.0, sigma, np.nan))
        return Placed(
            np.concatenate([np.argwhere(occluded), np.argwhere(never)]),
            np.concatenate([weighed.positions, placed[never]]),
            np.concatenate([between, (_of_unseen_parts(never) * completed_sigma)[never]]),
        )

    def _place_arms(
        self,
        never: Bools,
        held: Floats,
        completed: Floats,
        sigma: Floats,
        unseen_s: Floats,
        offsets: Floats,
        placed: Floats,
    ) -> None:
        """Move joints of arms that were ``never`` (B, 22) observed, ``placed`` (B, 22, 3), towards their expectation
        given the observed joints, in the Gaussian of postures."""
        arms = never & _OF_ARMS
        rows = np.flatnonzero(arms.any(axis=1))
        if len(rows):
            known = np.where(unseen_s[rows] == 0.0, sigma[rows], np.inf)
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
        unseen_s: Floats,
        seen_later: Bools,
    ) -> Weighed:
        # contiguous, because numba compiles a loop for each memory layout
        body, joint = (np.ascontiguousarray(index) for index in np.nonzero(occluded))
        if not len(body):
            return Weighed(np.empty((0, 3)), np.empty(0))
        chosen = np.stack([positions[body, joint] for positions in candidates], axis=1)
        deviations = np.stack([each[body, joint] for each in sigmas], axis=1)
        features = np.empty((len(body), FEATURES), dtype=np.float32)
        _describe(self._past, slots, body, joint, chosen, deviations, sigma, unseen_s, seen_later, features)
        return self.weigher(Occluded(body, joint, chosen, features))


def _of_bridged(stated: Floats, occluded: Bools, seen_later: Bools, bridged: Floats, observed: Floats) -> Floats:
    """Return the deviations (N,) of ``occluded`` (B, 22) joints, less for those that are observed again.

    The network's deviation, ``stated`` (N,), of a joint between two observations is twice its error. The filters'
    deviation, ``bridged`` (B, 22), is nearer, but it omits errors that last. These count as much as in the deviations
    of the body's ``observed`` joints (B, 22), NaN for others.
    """
    deviations = stated.copy()
    for k, (row, joint) in enumerate(np.argwhere(occluded)):
        others = observed[row][np.isfinite(observed[row])]
        if seen_later[row, joint] and len(others):
            deviations[k] = np.fmin(stated[k], max(bridged[row, joint], median(others)))
    return deviations


def _of_unseen_parts(never: Bools) -> Floats:
    """(B, 22) `_UNSEEN_LEG`, `_UNSEEN_ARM` or `_UNSEEN_WAIST` for joints of parts whose joints were all ``never``
    (B, 22) observed, 1 for the others."""
    factors = np.ones(never.shape)
    factors[:, _WAIST] = np.where(never[:, _WAIST].all(axis=1), _UNSEEN_WAIST, 1.0)[:, None]
    for leg in _LEGS:
        factors[:, leg] = np.where(never[:, leg].all(axis=1), _UNSEEN_LEG, 1.0)[:, None]
    for _, *arm in _ARMS:
        factors[:, arm] = np.where(never[:, arm].all(axis=1), _UNSEEN_ARM, 1.0)[:, None]
    return factors


@njit(cache=True)
def _bridge(slots, wanted, positions, at, noise, bridged, sigma):
    place = np.empty(3)
    for row, slot in enumerate(slots):
        for joint in range(wanted.shape[1]):
            if not wanted[row, joint]:
                continue
            deviation = bridge(positions[:, slot, joint], at, noise[slot], place)
            if np.isfinite(deviation):
                sigma[row, joint] = deviation
                for axis in range(3):
                    bridged[row, joint, axis] = place[axis]


@njit(cache=True)
def _describe(past, slots, body, joint, candidates, sigmas, sigma, unseen_s, seen_later, features):
    for row in range(len(body)):
        b, j = body[row], joint[row]
        describe(past, slots[b], j, candidates[row], sigmas[row], sigma[b], unseen_s[b], seen_later[b, j],
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
