"""Occluded joints: each a weighted mean of the smoother's, the completion network's and the held position."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit
from numpy.typing import NDArray

from steadypose.prior.clean.frame import Bools, Floats
from steadypose.prior.models.occlusion.candidates import FEATURES, average, describe, forget, new_past, observe
from steadypose.prior.models.occlusion.inference import LiveOcclusion, Occluded, Weighed

Weigher = Callable[[Occluded], Weighed]


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
    ) -> tuple[Occluded, Weighed] | None:
        """The occluded joints of B bodies, and their estimates; None if there are none.

        A joint is occluded if another of its body was seen since: a frame that was lost whole occludes none. One that
        was never seen is where the completion has placed it on average of late, carried along with the body.

        Args:
            slots: (B,) of the bodies.
            seen: (B, 22, 3) metres, of the smoother; NaN of joints never seen.
            sigma: (B, 22) metres along an axis, of the smoother; inf of joints never seen.
            unseen_s: (B, 22) seconds since each was last seen.
            seen_later: (B, 22) whether each is seen again within the delay.
            completed: (B, 22, 3) metres, by the completion network.
            completed_sigma: (B, 22) metres along an axis, inf of joints that are not completed; None without it.
        """
        held = np.empty_like(seen)
        _observe(self._past, slots, seen, sigma, unseen_s, held)
        if completed_sigma is None:
            return None
        known = np.isfinite(completed_sigma + completed[..., 0])
        never = known & np.isinf(unseen_s)
        if never.any():
            _average(self._past, slots, never, completed, held)
            seen, completed = (np.where(never[..., None], held, positions) for positions in (seen, completed))
        occluded = known & (unseen_s > unseen_s.min(axis=1, keepdims=True)) & np.isfinite(held[..., 0])
        # contiguous, as one loop is compiled for each memory layout
        body, joint = (np.ascontiguousarray(index) for index in np.nonzero(occluded))
        if not len(body):
            return None
        candidates = np.stack([positions[body, joint] for positions in (seen, completed, held)], axis=1)
        features = np.empty((len(body), FEATURES), dtype=np.float32)
        _describe(self._past, slots, body, joint, candidates, sigma, completed_sigma, unseen_s, seen_later, features)
        rows = Occluded(body, joint, candidates, features)
        return rows, self.weigher(rows)


@njit(cache=True)
def _observe(past, slots, seen, sigma, unseen_s, held):
    for row, slot in enumerate(slots):
        observe(past, slot, seen[row], sigma[row], unseen_s[row], held[row])


@njit(cache=True)
def _average(past, slots, never, completed, held):
    for row, slot in enumerate(slots):
        average(past, slot, never[row], completed[row], held[row])


@njit(cache=True)
def _describe(past, slots, body, joint, candidates, sigma, completed_sigma, unseen_s, seen_later, features):
    for row in range(len(body)):
        b, j = body[row], joint[row]
        describe(
            past,
            slots[b],
            j,
            candidates[row],
            sigma[b],
            completed_sigma[b, j],
            unseen_s[b],
            seen_later[b, j],
            features[row],
        )
