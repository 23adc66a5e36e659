"""Candidates for the position of an occluded joint, the features that weigh them, and `OcclusionNet` without torch.

There are four candidates:

- coasting: the smoother's extrapolation, which suits a standing foot;
- completed: the completion network's estimate from the rest of the body, which suits a swinging arm;
- held in the body frame: the last offset from the nearest observed joint, turned with the trunk, for a resting arm;
- bridged: the joint's own observations before and after, if it is observed again within the delay
  (`clean.occluded.bridge`).

The network of `training.recipes.occlusion` weighs them from `FEATURES` numbers that are invariant to the body's
position and heading.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Bools, Floats, Floats32
from steadypose.prior.body.skeleton import BONES_BETWEEN, MIRROR, PARENT, REST_POSITIONS, J, limbs
from steadypose.prior.compiled import njit
from steadypose.prior.models.weights import Arrays, load_weights
from steadypose.prior.timing.rate import FPS

CANDIDATES = 4  # number of candidates in the order above; for a joint that is not observed again, the last is coasting
FEATURES = 25  # number of features of an occluded joint
MIN_DISTANCE = 1e-3  # offset added to distances before their logarithm is taken, metres
MIN_SIGMA = 1e-4  # offset added to standard deviations before their logarithm is taken, metres
MIN_SPEED = 0.02  # offset added to speeds before their logarithm is taken, m/s
MIN_HEIGHT = 0.01  # offset added to heights above the lowest joint before their logarithm is taken, metres
FADING = 0.4  # weight of the newest speed in its running mean

AVERAGING = 0.1
"""Weight of the newest completion in the running mean of the position of a joint that was never observed. For legs, it
reduces the acceleration error from 17 to 2 mm/frame², with the same position error (validation)."""

STANDING_SHARE = 0.5
"""Share of a standing adult in the position of a joint that was never observed. The mean is more accurate than either
(validation: legs 221 mm completed, 221 mm standing, 209 mm their mean; an arm 204, 224, 193 mm)."""

NEAR = 1e-3
"""Weight of distance relative to the number of bones in the nearest joint, bones per metre; it only breaks ties."""

_MIRROR, _PARENT = np.asarray(MIRROR), np.maximum(PARENT, 0)
_TRUNK = np.array([[J[f"{side}_{part}"] for side in ("left", "right")] for part in ("hip", "shoulder")])


def _standing() -> Floats:
    """(22, 3) metres, a generic adult who stands with the arms down."""
    pose = np.array(REST_POSITIONS)
    for shoulder, *arm in limbs(("shoulder", "elbow", "wrist")):
        pose[arm] = pose[shoulder] - np.outer(np.linalg.norm(pose[arm] - pose[shoulder], axis=1), (0.0, 0.0, 1.0))
    return pose


STANDING: Floats = _standing()


class Past(NamedTuple):
    """State of S bodies."""

    poses: Floats
    """(S, 22, 22, 3) metres, for each joint the whole pose, as held, when it was last observed; the last frame's pose
    for a joint never observed; NaN before the first frame"""
    place: Floats  # (S, 22, 3) metres, the joints of the last frame; NaN before
    speed: Floats  # (S, 22) m/s, running mean of each joint's speed
    speed_observed: Floats  # (S, 22) m/s, its value when the joint was last observed


def new_past(slots: int) -> Past:
    """Create the state of bodies before their first observation."""
    past = Past(np.empty((slots, 22, 22, 3)), np.empty((slots, 22, 3)), np.empty((slots, 22)), np.empty((slots, 22)))
    forget(past, np.ones(slots, dtype=bool))
    return past


def forget(past: Past, slot: Bools) -> None:
    """Reset these slots (S,)."""
    past.poses[slot] = past.place[slot] = np.nan
    past.speed[slot] = past.speed_observed[slot] = 0.0


@njit(cache=True)
def observe(past, slots, positions, sigma, unobserved_s, held):
    """Update the state with a frame of B bodies, and write their poses with occluded joints held in the body frame.

    Args:
        past: a `Past`.
        slots: (B,) slots of the bodies.
        positions: (B, 22, 3) metres, from the smoother; NaN for joints never observed.
        sigma: (B, 22) metres along an axis, their standard deviations.
        unobserved_s: (B, 22) seconds since each joint was last observed; 0 for an observed joint.
        held: (B, 22, 3) metres, written; NaN for joints never observed.
    """
    joints = positions.shape[1]
    observed = np.empty(joints, dtype=np.bool_)
    for row, slot in enumerate(slots):
        for joint in range(joints):
            observed[joint] = unobserved_s[row, joint] == 0.0 and math.isfinite(
                positions[row, joint, 0] + sigma[row, joint]
            )
            moved = 0.0
            for axis in range(3):
                moved += (positions[row, joint, axis] - past.place[slot, joint, axis]) ** 2
                past.place[slot, joint, axis] = held[row, joint, axis] = positions[row, joint, axis]
            moved = math.sqrt(moved) * FPS if math.isfinite(moved) else 0.0
            past.speed[slot, joint] += FADING * (moved - past.speed[slot, joint])
            if observed[joint]:
                past.speed_observed[slot, joint] = past.speed[slot, joint]
        for joint in range(joints):
            if not observed[joint]:
                _hold_in_body_frame(joint, past.poses[slot, joint], positions[row], observed, held[row])
        _keep(past.poses[slot], observed, held[row])


@njit(cache=True)
def average(past, slots, never, completed, held):
    """Update the running mean of the completed positions of joints that were never observed, relative to the others.

    Args:
        past: a `Past`, in which the poses of these joints are those of the frame before.
        slots: (B,) slots of the bodies.
        never: (B, 22) which joints were never observed.
        completed: (B, 22, 3) metres, the completion.
        held: (B, 22, 3) metres, written by `observe`; for these joints, overwritten by the mean.
    """
    for row, slot in enumerate(slots):
        for joint in range(never.shape[1]):
            if never[row, joint]:
                for axis in range(3):
                    before, now = held[row, joint, axis], completed[row, joint, axis]
                    step = now - before
                    held[row, joint, axis] = before + AVERAGING * step if math.isfinite(step) else now
        _keep(past.poses[slot], never[row], held[row])


@njit(cache=True)
def _keep(poses, which, held):
    """Store the pose ``held`` (22, 3) as the latest pose of the joints ``which`` (22,)."""
    for joint in range(len(which)):
        if which[joint]:
            for other in range(len(which)):
                for axis in range(3):
                    poses[joint, other, axis] = held[other, axis]


@njit(cache=True)
def stand(never, positions, unobserved_s, placed):
    """Move joints that were never observed towards their positions in a standing adult, in place.

    Args:
        never: (B, 22) which joints were never observed.
        positions: (B, 22, 3) metres, from the smoother.
        unobserved_s: (B, 22) seconds since each joint was last observed; 0 for an observed joint.
        placed: (B, 22, 3) metres, mean completed positions of these joints, changed; other joints do not change.
    """
    joints = never.shape[1]
    observed, standing = np.empty(joints, dtype=np.bool_), np.empty((joints, 3))
    for row in range(len(never)):
        for joint in range(joints):
            observed[joint] = unobserved_s[row, joint] == 0.0 and math.isfinite(positions[row, joint, 0])
        for joint in range(joints):
            if never[row, joint] and observed.any():
                _hold_in_body_frame(joint, STANDING, positions[row], observed, standing)
                for axis in range(3):
                    placed[row, joint, axis] += STANDING_SHARE * (standing[joint, axis] - placed[row, joint, axis])


@njit(cache=True)
def _hold_in_body_frame(joint, then, positions, observed, held):
    """Write a joint at its offset from the nearest observed joint in the pose ``then`` (22, 3), turned with the
    trunk."""
    nearest, least = -1, np.inf
    for other in range(len(observed)):
        if observed[other]:
            square = 0.0
            for axis in range(3):
                square += (then[joint, axis] - then[other, axis]) ** 2
            apart = BONES_BETWEEN[joint, other] + NEAR * math.sqrt(square)
            if apart < least:  # never, where `then` is NaN
                nearest, least = other, apart
    if nearest < 0:
        for axis in range(3):
            held[joint, axis] = then[joint, axis]
        return
    angle = turned(then, positions, observed)
    cosine, sine = math.cos(angle), math.sin(angle)
    x, y = then[joint, 0] - then[nearest, 0], then[joint, 1] - then[nearest, 1]
    held[joint, 0] = positions[nearest, 0] + cosine * x - sine * y
    held[joint, 1] = positions[nearest, 1] + sine * x + cosine * y
    held[joint, 2] = positions[nearest, 2] + then[joint, 2] - then[nearest, 2]


@njit(cache=True)
def turned(then, now, observed):
    """Angle about z from pose ``then`` to ``now`` (22, 3), radians, from the observed hips and shoulders."""
    a, b = np.zeros(2), np.zeros(2)
    for part in range(len(_TRUNK)):
        left, right = _TRUNK[part]
        if observed[left] and observed[right] and math.isfinite(then[left, 0] + then[right, 0]):
            for axis in range(2):
                a[axis] += then[left, axis] - then[right, axis]
                b[axis] += now[left, axis] - now[right, axis]
    cross, dot = a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1]
    return math.atan2(cross, dot)


@njit(cache=True)
def describe(past, slot, joint, candidates, sigmas, sigma, unobserved_s, observed_later, features):
    """Write the features (`FEATURES`,) of an occluded joint. Call it after `observe` with the same frame.

    Args:
        past: a `Past`.
        slot: slot of the body.
        joint: index of the joint.
        candidates: (4, 3) metres, in the order of `CANDIDATES`.
        sigmas: (2,) metres, standard deviations of the completed and the bridged position.
        sigma: (22,) metres, standard deviations of the smoother.
        unobserved_s: (22,) seconds since each joint was last observed.
        observed_later: whether the joint is observed again within the delay.
        features: (`FEATURES`,) float32, written.
    """
    place, then = past.place[slot], past.poses[slot, joint]
    joints = len(place)
    speed, noise, count, lowest = 0.0, 0.0, 0, np.inf
    known = np.empty(joints, dtype=np.bool_)
    for other in range(joints):
        known[other] = math.isfinite(place[other, 0])
        if unobserved_s[other] == 0.0 and math.isfinite(sigma[other]):
            speed += past.speed[slot, other]
            noise += sigma[other]
            count += 1
        if then[other, 2] < lowest:
            lowest = then[other, 2]
    speed, noise = speed / max(count, 1), noise / max(count, 1)
    features[0] = math.log(unobserved_s[joint] * FPS)
    features[1] = 1.0 if observed_later else 0.0
    features[2] = math.log(sigma[joint] + MIN_SIGMA)
    features[3] = _log_apart(then[0], place[0])
    features[4] = abs(turned(then, place, known))
    features[5] = math.log(speed + MIN_SPEED)
    features[6] = math.log(past.speed_observed[slot, joint] + MIN_SPEED)
    features[7] = 1.0 - count / joints
    features[8] = 1.0 if unobserved_s[_PARENT[joint]] > 0.0 else 0.0
    features[9] = 1.0 if unobserved_s[_MIRROR[joint]] > 0.0 else 0.0
    features[10] = math.log(noise + MIN_SIGMA)
    features[11] = math.log(max(then[joint, 2] - lowest, 0.0) + MIN_HEIGHT)
    features[12] = 0.0 if not math.isfinite(then[0, 2] + place[0, 2]) else place[0, 2] - then[0, 2]
    at = 13
    for k in range(len(sigmas)):
        features[at] = math.log(sigmas[k] + MIN_SIGMA)
        at += 1
    for candidate in range(CANDIDATES):
        features[at] = _log_apart(candidates[candidate], then[joint])
        at += 1
        for other in range(candidate):
            features[at] = _log_apart(candidates[candidate], candidates[other])
            at += 1


@njit(cache=True)
def _log_apart(a, b):
    """Logarithm of the distance between two positions (3,); 0 where one is NaN."""
    square = (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2
    return math.log(math.sqrt(square) + MIN_DISTANCE) if math.isfinite(square) else 0.0


MIN_LOG_SIGMA, MAX_LOG_SIGMA = -3.0, 7.0
"""Range of the natural logarithm of the network's standard deviation, which is in millimetres."""

SIGMA_SCALE = 1.1
"""Factor on the network's standard deviation, which is calibrated for training people. On validation people, the
error-to-sigma ratio is 1.0 to 1.3 over occlusions of 0.2 s to 4 s."""


class Occluded(NamedTuple):
    """N occluded joints of several bodies."""

    body: NDArray[np.intp]  # (N,) row of the body
    joint: NDArray[np.intp]  # (N,) index of the joint
    candidates: Floats  # (N, 4, 3) metres, in the order of `CANDIDATES`
    features: Floats32  # (N, `FEATURES`) float32


class Weighed(NamedTuple):
    """Estimates of N occluded joints."""

    positions: Floats  # (N, 3) metres, in the frame of the candidates
    sigma: Floats  # (N,) metres, standard deviation along an axis


class LiveOcclusion:
    """A trained `OcclusionNet`."""

    def __init__(self, weights: Arrays) -> None:
        per_deviation = (1.0 / weights["deviation"]).astype(np.float32)
        read = weights["read.weight"] * per_deviation
        self._layers = (
            np.ascontiguousarray(read.T),
            weights["joint"] + (weights["read.bias"] - read @ weights["mean"]),
            np.ascontiguousarray(weights["think.weight"].T), weights["think.bias"],
            np.ascontiguousarray(weights["write.weight"].T), weights["write.bias"],
        )  # fmt: skip

    @classmethod
    def load(cls, weights: str) -> LiveOcclusion:
        """Load the weights of this name; raises like `load_weights`."""
        return cls(load_weights(weights, "occlusion")[0])

    def __call__(self, rows: Occluded) -> Weighed:
        """Return the weighted mean of each joint's candidates, and its standard deviation."""
        weighed = Weighed(np.empty((len(rows.joint), 3)), np.empty(len(rows.joint)))
        _weigh(rows.features, rows.joint, rows.candidates, *self._layers, weighed.positions, weighed.sigma)
        return weighed


@njit(cache=True)
def _weigh(features, joint, candidates, read, of_joint, think, think_bias, write, write_bias, positions, sigma):
    hidden, zero = read.shape[1], np.float32(0)
    first, second, out = np.empty(hidden, np.float32), np.empty(hidden, np.float32), np.empty(CANDIDATES + 1)
    for row in range(len(features)):
        for h in range(hidden):
            first[h], second[h] = of_joint[joint[row], h], think_bias[h]
        for k in range(len(read)):
            for h in range(hidden):
                first[h] += features[row, k] * read[k, h]
        for k in range(hidden):
            first[k] = max(first[k], zero)
            for h in range(hidden):
                second[h] += first[k] * think[k, h]
        for c in range(CANDIDATES + 1):
            out[c] = write_bias[c]
        for k in range(hidden):
            added = max(second[k], zero) + first[k]
            for c in range(CANDIDATES + 1):
                out[c] += added * write[k, c]
        most, total = out[:CANDIDATES].max(), 0.0
        for c in range(CANDIDATES):
            out[c] = np.exp(out[c] - most)
            total += out[c]
        for axis in range(3):
            positions[row, axis] = 0.0
            for c in range(CANDIDATES):
                positions[row, axis] += out[c] / total * candidates[row, c, axis]
        sigma[row] = SIGMA_SCALE * 1e-3 * np.exp(min(max(out[CANDIDATES], MIN_LOG_SIGMA), MAX_LOG_SIGMA))
