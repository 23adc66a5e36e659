"""Fusion: the observation smoothed, the prior's opinion, this person's bones, and how sure the result is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msgs.types import JointState
from prior.filters import Smoothed
from prior.pose_solver import fit_pose, place_joints, solve_pose
from prior.skeletons import JOINTS, PARENTS
from prior.window import FPS, Estimate, Ring, Window


@dataclass(frozen=True)
class FuseSettings:
    """How much to believe whom. Lengths are standard deviations along one axis.

    Attributes:
        enabled: whether to; off, the body stands as the refinement model decoded it, where its pelvis was seen.
        prior_sigma: metres, of a joint placed by the refinement model, when its body is well seen.
        prior_drift: m/s, how fast that grows for a joint that is not seen.
        fade: seconds after which a joint not seen is unknown.
    """

    enabled: bool = True
    prior_sigma: float = 0.1
    prior_drift: float = 0.25
    fade: float = 3.0


_MOST_MOBILE = 3.0
"""Times the variance of the best-known joint, at most, by which the fit to the bones lets a joint yield: one that
yields without resistance no longer says where it was, and the fit needs many more sweeps."""

_COASTING = 4.0
"""Times: the standard deviation of a smoother that coasts, beside what is imputed. It holds that a joint goes on as it
went, which people need not: limbs hidden for half a second are 4 % nearer to the truth so than if it is believed, and
off by what is said."""


def _bones_between() -> NDArray[np.int64]:
    """(22, 22) bones on the way from one joint to another."""
    between = np.full((len(PARENTS), len(PARENTS)), -1)
    for joint, parent in enumerate(PARENTS):
        between[joint, :joint] = between[:joint, joint] = between[parent, :joint] + 1
        between[joint, joint] = 0
    return between


_NEAR = 1 / (1 + _bones_between()) ** 2
"""(22, 22) how much one joint's error tells of another's"""


class Fuse:
    """Joins a fixed-lag smoother of what was seen with the rotations that the prior decoded for the rest.

    The prior's body is solved from the joints well seen; others are where HG-VAE completes the body or, without it,
    hang from those seen in the rotations decoded. Each joint
    is the mean of smoother and body, weighted by their precisions: one well seen stays near the observation, one
    hidden follows the prior as the smoother's uncertainty grows. Of the poses on the person's bones, the one nearest
    to that mean is the answer: lengths are constant, and positions and rotations agree.
    """

    def __init__(self, settings: FuseSettings, bias_sigma: float, delay_frames: int, slots: int) -> None:
        self._settings, self._bias_sigma = settings, bias_sigma
        self.delay_frames = delay_frames
        self._unseen_s = Ring(delay_frames + 1, (slots, len(JOINTS)), fill=np.inf)

    def reset(self, slot: NDArray[np.bool_]) -> None:
        """Forget the bodies in these slots."""
        self._unseen_s.clear(slot)

    def update(self, window: Window) -> Window:
        """Write the estimate of the frame ``delay_frames`` before the newest, once there is one."""
        positions = window.positions.newest
        self._unseen_s.push(np.where(np.isfinite(positions[..., 0]), 0.0, self._unseen_s.newest + 1 / FPS))
        window.out = None if window.smoothed is None else self.estimate(window, window.smoothed, self.delay_frames)
        return window

    def estimate(self, window: Window, smoothed: Smoothed, back: int) -> Estimate:
        """The estimate of the frame ``back`` before the newest, from what the smoother made of it."""
        s = self._settings
        slots = np.flatnonzero(window.present)
        offsets, decoded = window.offsets[slots], window.decoded[-1 - back][slots]
        unseen_s = self._unseen_s.all[-1 - back][slots]
        held_s = _least_below(unseen_s)
        seen_weight = 1 / (smoothed.sigma[slots] ** 2 + self._bias_sigma**2)
        imputed = window.imputed
        prior_weight = 1 / (s.prior_sigma**2 + (s.prior_drift * np.minimum(held_s, s.fade)) ** 2)
        known = seen_weight > 0
        observed = np.where(known[..., None], smoothed.positions[slots], 0.0)
        share = (seen_weight / (seen_weight + prior_weight))[..., None]
        body = place_joints(decoded, offsets)
        # The pelvis goes where it brings the body nearest to all joints seen, not only to itself.
        body += _weighted_mean(observed - body, share)
        rotations = decoded
        if s.enabled:
            # What is not seen hangs from what is, in the prior's rotations.
            well = share > 0.5
            hung = solve_pose(np.where(well, observed, np.nan), offsets, decoded)[1]
            body = np.where(well[:, :1], hung, body)
            if imputed is not None:
                completed, sigma = imputed.positions[-1 - back][slots], imputed.sigma[-1 - back][slots]
                # A joint that the sensor does not have hangs: what is imputed of it shakes the joints seen beside it.
                # Of a frame that was lost whole, the smoother knows more.
                hidden = unseen_s > unseen_s.min(axis=1, keepdims=True)
                filled = np.isfinite(completed[..., 0]) & hidden & np.isfinite(unseen_s)
                beside = _beside_seen(completed, observed, np.where(unseen_s > 0, 0.0, seen_weight))
                body = np.where(filled[..., None], beside, body)
                prior_weight = np.where(filled, 1 / (sigma**2 + self._bias_sigma**2), prior_weight)
                coasting = 1 / ((_COASTING * smoothed.sigma[slots]) ** 2 + self._bias_sigma**2)
                seen_weight = np.where(filled, coasting, seen_weight)
                share = (seen_weight / (seen_weight + prior_weight))[..., None]
            variance = 1 / (seen_weight + prior_weight)
            mobility = np.minimum(variance, _MOST_MOBILE * variance.min(axis=1, keepdims=True))
            fitted = fit_pose(body + share * (observed - body), offsets, mobility, decoded, window.give[slots])
            rotations, body, offsets = fitted
        placed = known.any(axis=1)
        state = _states(unseen_s, held_s, s.fade)
        # of a joint not seen, smoother and prior know the same past: what one says does not make the other surer
        known_by = np.where(unseen_s > 0, np.maximum(seen_weight, prior_weight), seen_weight + prior_weight)
        sigma = 1 / np.sqrt(known_by)
        return Estimate(
            stamp_s=smoothed.stamp_s,
            positions=_scatter(window.slots, slots[placed], body[placed], np.nan),
            rotations=_scatter(window.slots, slots[placed], rotations[placed], np.nan),
            offsets=_scatter(window.slots, slots[placed], offsets[placed], np.nan),
            sigma=_scatter(window.slots, slots[placed], sigma[placed], np.inf),
            state=_scatter(window.slots, slots[placed], state[placed], JointState.UNKNOWN).astype(np.uint8),
        )


def _beside_seen(
    completed: NDArray[np.float64], observed: NDArray[np.float64], weight: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Joints (S, 22, 3) as the model completes them, each moved as the seen ones near it are off there.

    ``weight`` (S, 22) is how far to believe ``observed`` (S, 22, 3), 0 where a joint was not seen.
    """
    near = _NEAR * weight[:, None]
    off = np.where(weight[..., None] > 0, observed - completed, 0.0)
    return completed + near @ off / np.maximum(near.sum(axis=-1, keepdims=True), 1e-12)


def _weighted_mean(vectors: NDArray[np.float64], weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """(S, 1, 3) mean over the joints of (S, 22, 3) by weights (S, 22, 1)."""
    return (weight * vectors).sum(axis=1, keepdims=True) / np.maximum(weight.sum(axis=1, keepdims=True), 1e-12)


def _scatter(slots: int, rows: NDArray[np.intp], values: NDArray[Any], fill: float) -> NDArray[Any]:
    full = np.full((slots, *values.shape[1:]), fill)
    full[rows] = values
    return full


def _least_below(unseen_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """For how long neither a joint (S, 22) nor any below it was seen: a joint between two seen is held by them."""
    least = unseen_s.copy()
    for joint in range(len(PARENTS) - 1, 0, -1):
        least[:, PARENTS[joint]] = np.minimum(least[:, PARENTS[joint]], least[:, joint])
    return least


def _states(unseen_s: NDArray[np.float64], held_s: NDArray[np.float64], fade: float) -> NDArray[np.uint8]:
    hidden = np.where(held_s <= fade, JointState.IMPUTED, JointState.UNKNOWN)
    return np.where(unseen_s == 0.0, JointState.REFINED, hidden).astype(np.uint8)
