"""The fuse stage: combines smoothed joints, the prior's estimates of hidden joints, and the person's bone lengths."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.types import JointState
from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.inverse_kinematics import RIGID, fit_lengths, place_joints, solve_pose
from steadypose.prior.body.skeleton import BONES_BETWEEN, JOINTS, PARENT, J
from steadypose.prior.clean.bones import SensorBias
from steadypose.prior.clean.frame import Estimate, Imputed, Person
from steadypose.prior.clean.history import BRIEF_S
from steadypose.prior.clean.occluded import OccludedJoints, Track
from steadypose.prior.clean.settings import FuseSettings
from steadypose.prior.compiled import njit
from steadypose.prior.timing.kalman import Smoothed

MAX_SIGMA = 0.25
"""Largest standard deviation along an axis at which a completed joint counts as known, metres. How long it has been
hidden does not matter."""

DERIVED_SIGMA = 0.025
"""Standard deviation along an axis of a joint that the sensor lacks and that its neighbours determine, metres. For
example, hips and shoulders determine the spine (validation: 0.019 to 0.028 for spine joints, 0.016 to 0.023 for
collars)."""

_NEAR = 1 / (1 + BONES_BETWEEN) ** 2
"""(22, 22) weight of one joint's error in the correction of another, from the number of bones between them."""

_CHEST, _PAIRS = J["spine3"], ((J["left_hip"], J["right_hip"]), (J["left_collar"], J["right_collar"]))
_TRUNK = np.isin(JOINTS, ("pelvis", "spine1", "spine2", "spine3", "neck", "left_collar", "right_collar"))

_MIN_VARIANCE = 1e-10  # least variance of a position, m²: a hundredth of a millimetre squared


class Precision(NamedTuple):
    """Inverse variances of each joint's position along an axis, 1/m^2, (S, 22)."""

    smoother: Floats  # precision of the smoother
    prior: Floats  # precision of the prior


class Fuse:
    """Fuses observed joints with the prior's estimates of the hidden ones.

    An observed joint keeps its smoothed and denoised position. A hidden joint gets the weighted mean of several
    candidates (`OccludedJoints`). A joint without a completion, and a joint of the trunk that the sensor lacks between
    observed ones, follows from the observed joints by the decoded rotations. Bone lengths are constrained as far as
    they are known.

    Attributes:
        occluded: estimates the hidden joints; None if fusion is off.
    """

    def __init__(self, settings: FuseSettings, slots: int) -> None:
        self._settings = settings
        self.occluded = OccludedJoints(settings.weights, slots) if settings.enabled else None

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        if self.occluded:
            self.occluded.forget(slot)

    def fuse(
        self,
        smoothed: Smoothed,
        person: Person,
        bias: SensorBias,
        rotations: Floats,
        imputed: Imputed | None,
        unobserved_s: Floats,
        observed_later: Bools,
        present: Bools,
        track: Track,
    ) -> Estimate:
        """Return the estimate of one frame. Call it with frames in order.

        Args:
            smoothed: the joints, smoothed and denoised.
            person: the bodies' bones.
            bias: the sensor's, estimated so far.
            rotations: (S, 22, 3, 3) local, for joints that are not observed.
            imputed: (S, 22, 3) and (S, 22), the frame completed by HG-VAE; None if no body is completed.
            unobserved_s: (S, 22) seconds since each joint was last observed, at this frame.
            observed_later: (S, 22) whether each joint was observed in a later frame within the delay.
            present: (S,) which slots hold a body.
            track: the observations before and after this frame.
        """
        s = self._settings
        slots, count = np.flatnonzero(present), len(present)
        offsets, decoded, bias_sigma = person.offsets[slots], rotations[slots], bias.bias_sigma[slots]
        positions, deviation, unobserved = smoothed.positions[slots], smoothed.sigma[slots], unobserved_s[slots]
        subtree_s = _unobserved_of_subtree(unobserved)
        precision = Precision(*_weigh(deviation, subtree_s, bias_sigma, s.prior_sigma, s.prior_drift, s.fade))
        known = subtree_s <= s.fade
        body, fitted = place_joints(decoded, offsets), decoded
        precise = _align(body, positions, precision)
        if self.occluded:
            # hidden joints follow from the observed ones by the prior's rotations
            placed = solve_pose(precise, offsets, decoded)[1]
            body = np.where(np.isfinite(precise[:, :1, :1]), placed, body)
            completed_sigma = None
            if imputed is not None:
                hidden = _completable(unobserved, imputed.positions[slots])
                _complete(body, imputed.positions[slots], positions, unobserved, hidden, precision.smoother)
                completed_sigma = np.where(hidden, imputed.sigma[slots], np.inf)
            occluded = self.occluded.update(
                slots, positions, deviation, unobserved, observed_later[slots], body, completed_sigma, offsets, track
            )
            if occluded is not None:
                row, joint = occluded.joints.T
                body[row, joint] = occluded.positions
                precision.smoother[row, joint], precision.prior[row, joint] = 0.0, 1.0 / np.square(occluded.sigma)
                known[row, joint] |= occluded.sigma <= MAX_SIGMA
            # if no joint of a frame was observed, the smoother is more accurate than the prior
            here = (unobserved <= unobserved.min(axis=1, keepdims=True)) & np.isfinite(deviation)
            variance = _merge(body, positions, here, precision)
            length_variance = bias.length_variance[slots] + _rigid_variance(person.length_variance[slots])
            # Joints between two observations close in time do not move either. Constraining a joint to its bones for a
            # frame or two would make it flicker.
            stays = here | (observed_later[slots] & (unobserved < BRIEF_S))
            body = fit_lengths(body, offsets, np.where(stays, _MIN_VARIANCE, variance), length_variance)
            fitted = solve_pose(body, offsets, decoded)[0]
        placed = np.isfinite(deviation).any(axis=1)
        derived = np.isinf(unobserved) & _determined(unobserved)
        state, sigma = _states(unobserved, known), _output_sigma(unobserved, deviation, precision, derived)
        return Estimate(
            stamp_s=smoothed.stamp_s,
            positions=_scatter(count, slots[placed], body[placed], np.nan),
            rotations=_scatter(count, slots[placed], fitted[placed], np.nan),
            offsets=_scatter(count, slots[placed], offsets[placed], np.nan),
            sigma=_scatter(count, slots[placed], sigma[placed], np.inf),
            state=_scatter(count, slots[placed], state[placed], JointState.UNKNOWN).astype(np.uint8),
        )


def _rigid_variance(length_variance: Floats) -> Floats:
    """(B, R) variance of each `RIGID` segment, from that of bones (B, 22); two bones add their variances."""
    end, start = RIGID.T
    across = np.where(PARENT[end] == start, 0.0, length_variance[:, start])
    return length_variance[:, end] + across


def _scatter(slots: int, rows: NDArray[np.intp], values: NDArray[Any], fill: float) -> NDArray[Any]:
    full = np.full((slots, *values.shape[1:]), fill)
    full[rows] = values
    return full


def _states(unobserved_s: Floats, known: Bools) -> NDArray[np.uint8]:
    hidden = np.where(known, JointState.IMPUTED, JointState.UNKNOWN)
    return np.where(unobserved_s == 0.0, JointState.REFINED, hidden).astype(np.uint8)


# ---------------------------------------------------------------------------------------------------------------
# Compiled loops over S bodies. `positions` (S, 22, 3) are the smoother's, NaN where it has none. `body` (S, 22, 3) are
# the prior's positions. `unobserved_s` (S, 22) are the seconds since each joint was last observed.


@njit(cache=True)
def _unobserved_of_subtree(unobserved_s):
    """(S, 22) seconds since a joint or any of its descendants was observed, as these determine it too."""
    least = unobserved_s.copy()
    for row in range(len(least)):
        for joint in range(least.shape[1] - 1, 0, -1):
            above = PARENT[joint]
            least[row, above] = min(least[row, above], least[row, joint])
    return least


@njit(cache=True)
def _inverse(variance):
    """Invert a variance, which settings may make 0 for the sensor or the prior; at least `_MIN_VARIANCE` counts."""
    return 1.0 / max(variance, _MIN_VARIANCE)


@njit(cache=True)
def _weigh(deviation, subtree_s, bias_sigma, prior_sigma, prior_drift, fade):
    """Return the parts of `Precision`: of the smoother, from ``deviation`` (S, 22), and of the prior."""
    smoother, prior = np.empty_like(deviation), np.empty_like(deviation)
    for row in range(len(deviation)):
        for joint in range(deviation.shape[1]):
            drift = prior_drift * min(subtree_s[row, joint], fade)
            smoother[row, joint] = _inverse(deviation[row, joint] ** 2 + bias_sigma[row] ** 2)
            prior[row, joint] = _inverse(prior_sigma**2 + drift**2)
    return smoother, prior


@njit(cache=True)
def _align(body, positions, precision):
    """Translate each body, in place, to the weighted least squares fit to all observed joints, not only to the pelvis.

    Returns:
        (S, 22, 3) the joints for which the smoother is more precise than the prior; NaN for the others.
    """
    precise = np.full_like(positions, np.nan)
    for row in range(len(body)):
        total, off = 0.0, np.zeros(3)
        for joint in range(body.shape[1]):
            by_smoother = precision.smoother[row, joint]
            share = by_smoother / (by_smoother + precision.prior[row, joint])
            if by_smoother > 0.0:
                total += share
                for axis in range(3):
                    off[axis] += share * (positions[row, joint, axis] - body[row, joint, axis])
                    if share > 0.5:
                        precise[row, joint, axis] = positions[row, joint, axis]
        for joint in range(body.shape[1]):
            for axis in range(3):
                body[row, joint, axis] += off[axis] / max(total, 1e-12)
    return precise


@njit(cache=True)
def _determined(unobserved_s):
    """(S, 22) which joints of the trunk lie between joints that the sensor has, and follow from them.

    A sensor that has only joints above the chest, or of one side, determines none, because the trunk could turn. Limbs
    bend, so their joints do not follow from their neighbours.
    """
    determined = np.zeros(unobserved_s.shape, dtype=np.bool_)
    below = np.empty(unobserved_s.shape[1], dtype=np.int64)
    for row in range(len(unobserved_s)):
        total = 0
        below[:] = 0
        for joint in range(len(below) - 1, -1, -1):
            known = unobserved_s[row, joint] < np.inf
            below[joint] += known
            total += known
            if joint > 0:
                below[PARENT[joint]] += below[joint]
        both = False
        for left, right in _PAIRS:
            both |= below[left] > 0 and below[right] > 0
        if not both or below[_CHEST] == total:
            continue
        for joint in range(len(below)):
            sides = 1 if below[joint] < total else 0
            for other in range(1, len(below)):
                sides += PARENT[other] == joint and below[other] > 0
            determined[row, joint] = _TRUNK[joint] and sides >= 2
    return determined


@njit(cache=True)
def _completable(unobserved_s, completed):
    """(S, 22) which joints are hidden and get a completion.

    Two groups are excluded. Joints of the trunk that the sensor lacks may follow from those that it has. In frames
    without any observation, the smoother is more accurate.
    """
    hidden, determined = np.zeros(unobserved_s.shape, dtype=np.bool_), _determined(unobserved_s)
    for row in range(len(unobserved_s)):
        newest = unobserved_s[row].min()
        for joint in range(unobserved_s.shape[1]):
            unobserved = unobserved_s[row, joint]
            if unobserved > newest and not math.isnan(completed[row, joint, 0]):
                hidden[row, joint] = unobserved < np.inf or not determined[row, joint]
    return hidden


@njit(cache=True)
def _complete(body, completed, positions, unobserved_s, hidden, precision):
    """Set ``hidden`` joints (S, 22) to HG-VAE's completion, corrected by its mean error at nearby observed joints."""
    joints = body.shape[1]
    for row in range(len(body)):
        for joint in range(joints):
            if not hidden[row, joint]:
                continue
            total, off = 0.0, np.zeros(3)
            for other in range(joints):
                if unobserved_s[row, other] > 0.0:
                    continue
                weight = _NEAR[joint, other] * precision[row, other]
                total += weight
                for axis in range(3):
                    off[axis] += weight * (positions[row, other, axis] - completed[row, other, axis])
            for axis in range(3):
                body[row, joint, axis] = completed[row, joint, axis] + off[axis] / max(total, 1e-12)


@njit(cache=True)
def _merge(body, positions, here, precision):
    """Merge the smoother's positions into the body, in place, and return the variance (S, 22) of the weighted mean.

    Joints ``here`` (S, 22) get the smoother's position, the others the weighted mean of smoother and body.
    """
    variance = 1.0 / (precision.smoother + precision.prior)
    for row in range(len(body)):
        for joint in range(body.shape[1]):
            if precision.smoother[row, joint] > 0.0:
                share = 1.0 if here[row, joint] else precision.smoother[row, joint] * variance[row, joint]
                for axis in range(3):
                    body[row, joint, axis] += share * (positions[row, joint, axis] - body[row, joint, axis])
    return variance


@njit(cache=True)
def _output_sigma(unobserved_s, deviation, precision, derived):
    """(S, 22) standard deviations of the output.

    For a hidden joint, the errors of smoother and prior are dependent, as both use the same past. The smaller deviation
    of the two is used. Joints ``derived`` (S, 22) have `DERIVED_SIGMA`, and a share of the variances of joints that the
    sensor has but that are hidden.
    """
    sigma = np.empty_like(unobserved_s)
    joints = sigma.shape[1]
    for row in range(len(sigma)):
        for joint in range(joints):
            if unobserved_s[row, joint] == 0.0 and np.isfinite(deviation[row, joint]):
                sigma[row, joint] = deviation[row, joint]
            else:
                sigma[row, joint] = 1.0 / math.sqrt(max(precision.smoother[row, joint], precision.prior[row, joint]))
        for joint in range(joints):
            if not derived[row, joint]:
                continue
            total = hidden = 0.0
            for other in range(joints):
                if unobserved_s[row, other] < np.inf:
                    total += _NEAR[joint, other]
                    if unobserved_s[row, other] > 0.0:
                        hidden += _NEAR[joint, other] * sigma[row, other] ** 2
            sigma[row, joint] = math.sqrt(DERIVED_SIGMA**2 + hidden / total)
    return sigma
