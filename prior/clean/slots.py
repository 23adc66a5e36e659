"""Which slot holds whose body: who comes in takes a free one, who is not seen for a while leaves it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterable
from typing import Generic, TypeVar

import numpy as np

from steadypose.prior.body.skeleton import finite_joints
from steadypose.prior.clean.adapt import Sighting
from steadypose.prior.clean.frame import Bools, Floats

MIN_JOINTS = 6
"""Canonical joints that must be seen for a body to be taken up."""


Key = TypeVar("Key", bound=Hashable)


class Slots(Generic[Key]):
    """The bodies followed at once.

    Args:
        count: at most so many.
        timeout_s: seconds without a sighting after which a body is dropped.
        counters: gets ``body_too_little_seen`` and ``too_many_bodies``.

    Attributes:
        keys: (S,) what each slot's body is called; None of a free slot.
        present: (S,) which slots hold a body that has been on the grid.
    """

    def __init__(self, count: int, timeout_s: float, counters: Counter[str]) -> None:
        self._timeout_ns, self._counters = timeout_s * 1e9, counters
        self.keys: list[Key | None] = [None] * count
        self.present = np.zeros(count, dtype=bool)
        self._last_seen_ns = np.zeros(count, dtype=np.int64)  # 0: not on the grid yet

    def arrange(self, sightings: Iterable[tuple[Key | None, Sighting]]) -> Sighting:
        """Joints (S, 22, 3) and confidence (S, 22) by slot, of bodies by key; None is a body that nobody follows."""
        positions, confidence = np.full((len(self.keys), 22, 3), np.nan), np.zeros((len(self.keys), 22))
        for key, seen in sightings:
            if key is None:
                continue
            slot = self._slot(key, int(np.isfinite(seen.positions[:, 0]).sum()))
            if slot is not None:
                positions[slot], confidence[slot] = seen
        return Sighting(positions, confidence)

    def advance(self, stamp_ns: int, positions: Floats) -> Bools:
        """Go on to this time of the grid, with these joints (S, 22, 3); give the slots whose bodies have timed out."""
        taken = np.array([key is not None for key in self.keys])
        seen = np.asarray(finite_joints(positions).any(axis=1))
        self.present = self.present & taken | seen
        new = self._last_seen_ns == 0
        self._last_seen_ns = np.where(seen | new, stamp_ns, self._last_seen_ns)
        return taken & (stamp_ns - self._last_seen_ns > self._timeout_ns)

    def free(self, slot: Bools) -> None:
        """Let these slots (S,) be taken by others."""
        self.present = self.present & ~slot
        for k in np.flatnonzero(slot):
            self.keys[k] = None

    def _slot(self, key: Key, joints_seen: int) -> int | None:
        """The slot of a body, a free one if it is new and enough of it is seen."""
        if key in self.keys:
            return self.keys.index(key)
        if joints_seen < MIN_JOINTS:
            self._counters["body_too_little_seen"] += 1
            return None
        if None not in self.keys:
            self._counters["too_many_bodies"] += 1
            return None
        slot = self.keys.index(None)
        self.keys[slot] = key
        self._last_seen_ns[slot] = 0
        return slot
