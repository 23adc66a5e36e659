"""Occluded joints: each a weighted mean of four candidates."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.skeleton import limbs
from steadypose.prior.compiled import njit
from steadypose.prior.models.occlusion.bridge import bridge
from steadypose.prior.models.occlusion.candidates import FEATURES, average, describe, forget, new_past, observe, stand
from steadypose.prior.models.occlusion.inference import LiveOcclusion, Occluded, Weighed

Weigher = Callable[[Occluded], Weighed]

FORGETTING_S = 2.0, 10.0
"""Seconds after which what was last seen of a joint begins to count less, and after which its deviation is at least the
completion's: of joints hidden for 4 to 10 s the network, trained on 3 s, states a deviation 1.3 to 1.6 times too small,
and with this one 0.9 to 1.1 (validation)."""

_LEGS, _UNSEEN_LEG = limbs(("knee", "ankle", "foot")), 1.2
"""By how much the completion states too small a deviation of legs of which no joint was ever seen (validation)."""


class Placed(NamedTuple):
    """N occluded joints.

    Attributes:
        joints: (N, 2) row of the body, and the joint.
        positions: (N, 3) metres.
        sigma: (N,) metres, standard deviation along an axis.
    """

    joints: NDArray[np.intp]
    positions: Floats
    sigma: Floats


class Track(NamedTuple):
    """The last frames of S bodies, for joints seen again within the delay.

    Attributes:
        positions: (T, S, 22, 3) metres, as observed; NaN where they were not.
        at: index of the frame to be answered.
        noise: (S,) metres along an axis, of the observations.
    """

    positions: Floats
    at: int
    noise: Floats


class OccludedJoints:
    """Estimates every body's occluded joints. Frames are to be given in order.

    Attributes:
        weigher: of the candidates; training replaces it by one that records them.
    """

    def __init__(self, weights: str, slots: int) -> None:
        self.weigher: Weigher = LiveOcclusion.load(weights)
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
        track: Track,
    ) -> Placed | None:
        """Where B bodies' occluded joints are; None where nothing is completed.

        A joint is occluded if another of its body was seen since: a frame that was lost whole occludes none. One that
        was never seen is where the completion has placed it on average of late, carried along with the body, halfway to
        where a standing adult has it.

        Args:
            slots: (B,) of the bodies.
            seen: (B, 22, 3) metres, of the smoother; NaN of joints never seen.
            sigma: (B, 22) metres along an axis, of the smoother; inf of joints never seen.
            unseen_s: (B, 22) seconds since each was last seen.
            seen_later: (B, 22) whether each is seen again within the delay.
            completed: (B, 22, 3) metres, by the completion network.
            completed_sigma: (B, 22) metres along an axis, inf of joints that are not completed; None without it.
            track: of all slots, as observed.
        """
        held = np.empty_like(seen)
        _observe(self._past, slots, seen, sigma, unseen_s, held)
        if completed_sigma is None:
            return None
        known = np.isfinite(completed_sigma + completed[..., 0])
        never = known & np.isinf(unseen_s)
        occluded = (
            known & (unseen_s > unseen_s.min(axis=1, keepdims=True)) & np.isfinite(unseen_s + sigma + held[..., 0])
        )
        _average(self._past, slots, never, completed, held)
        placed = held.copy()
        _stand(never, seen, unseen_s, placed)
        bridged, bridged_sigma = seen.copy(), sigma.copy()
        _bridge(slots, occluded & seen_later, *track, bridged, bridged_sigma)
        candidates, sigmas = (seen, completed, held, bridged), (completed_sigma, bridged_sigma)
        weighed = self._weigh(slots, occluded, candidates, sigmas, sigma, unseen_s, seen_later)
        share = np.clip((unseen_s[occluded] - FORGETTING_S[0]) / (FORGETTING_S[1] - FORGETTING_S[0]), 0.0, 1.0)
        forgotten = np.hypot(weighed.sigma, share * completed_sigma[occluded])
        return Placed(
            np.concatenate([np.argwhere(occluded), np.argwhere(never)]),
            np.concatenate([weighed.positions, placed[never]]),
            np.concatenate([forgotten, (_of_legs(never) * completed_sigma)[never]]),
        )

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
        # contiguous, as one loop is compiled for each memory layout
        body, joint = (np.ascontiguousarray(index) for index in np.nonzero(occluded))
        if not len(body):
            return Weighed(np.empty((0, 3)), np.empty(0))
        chosen = np.stack([positions[body, joint] for positions in candidates], axis=1)
        stated = np.stack([each[body, joint] for each in sigmas], axis=1)
        features = np.empty((len(body), FEATURES), dtype=np.float32)
        _describe(self._past, slots, body, joint, chosen, stated, sigma, unseen_s, seen_later, features)
        return self.weigher(Occluded(body, joint, chosen, features))


def _of_legs(never: Bools) -> Floats:
    """(B, 22) `_UNSEEN_LEG` at the joints of legs that were never seen, by ``never`` (B, 22) of each joint; else 1."""
    factors = np.ones(never.shape)
    for leg in _LEGS:
        factors[:, leg] = np.where(never[:, leg].all(axis=1), _UNSEEN_LEG, 1.0)[:, None]
    return factors


@njit(cache=True)
def _observe(past, slots, seen, sigma, unseen_s, held):
    for row, slot in enumerate(slots):
        observe(past, slot, seen[row], sigma[row], unseen_s[row], held[row])


@njit(cache=True)
def _average(past, slots, never, completed, held):
    for row, slot in enumerate(slots):
        average(past, slot, never[row], completed[row], held[row])


@njit(cache=True)
def _stand(never, seen, unseen_s, placed):
    for row in range(len(never)):
        stand(never[row], seen[row], unseen_s[row], placed[row])


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
