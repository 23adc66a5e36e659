"""Occluded joints: where each is, of what the smoother, the completion network and its place beside the body say."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit
from numpy.typing import NDArray

from steadypose.prior.clean.frame import Bools, Floats
from steadypose.prior.models.occlusion.candidates import FEATURES, describe, forget, look, new_past
from steadypose.prior.models.occlusion.inference import LiveOcclusion, Occluded, Weighed

Weigher = Callable[[Occluded], Weighed]


class OccludedJoints:
    """Weighs the accounts of every body's occluded joints. Frames are to be given in order.

    Attributes:
        weigher: who weighs them; training puts one there that remembers what it was asked.
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
        again: Bools,
        completed: Floats,
        completed_sigma: Floats | None,
    ) -> tuple[Occluded, Weighed] | None:
        """Which joints of B bodies are occluded, and where they are; None if there are none.

        Of a frame that was lost whole, and of joints never seen, nothing is said.

        Args:
            slots: (B,) whose.
            seen: (B, 22, 3) metres, of the smoother; NaN of joints never seen.
            sigma: (B, 22) metres, along an axis; inf of those.
            unseen_s: (B, 22) seconds.
            again: (B, 22) whether they are seen again, in a frame that has come already.
            completed: (B, 22, 3) metres, by the completion network.
            completed_sigma: (B, 22) metres; None where nothing is completed.
        """
        held = np.empty_like(seen)
        _look(self._past, slots, seen, sigma, unseen_s, held)
        if completed_sigma is None:
            return None
        occluded = (unseen_s > unseen_s.min(axis=1, keepdims=True)) & np.isfinite(
            unseen_s + sigma + completed_sigma + held[..., 0] + completed[..., 0]
        )
        body, joint = (np.ascontiguousarray(index) for index in np.nonzero(occluded))  # else another loop for many
        if not len(body):
            return None
        candidates = np.stack([account[body, joint] for account in (seen, completed, held)], axis=1)
        features = np.empty((len(body), FEATURES), dtype=np.float32)
        _describe(self._past, slots, body, joint, candidates, sigma, completed_sigma, unseen_s, again, features)
        rows = Occluded(body, joint, candidates, features)
        return rows, self.weigher(rows)


@njit(cache=True)
def _look(past, slots, seen, sigma, unseen_s, held):
    for row, slot in enumerate(slots):
        look(past, slot, seen[row], sigma[row], unseen_s[row], held[row])


@njit(cache=True)
def _describe(past, slots, body, joint, candidates, sigma, completed_sigma, unseen_s, again, features):
    for row in range(len(body)):
        b, j = body[row], joint[row]
        describe(
            past, slots[b], j, candidates[row], sigma[b], completed_sigma[b, j], unseen_s[b], again[b, j], features[row]
        )
