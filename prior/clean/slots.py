"""Assignment of bodies to slots: a new body takes a free slot, one not observed for a while leaves it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterable
from typing import Generic, TypeVar

import numpy as np

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.skeleton import finite_joints
from steadypose.prior.clean.adapt import BodyJoints

MIN_JOINTS = 6
"""Least number of visible canonical joints of a new body."""


Key = TypeVar("Key", bound=Hashable)


class Slots(Generic[Key]):
    """The bodies tracked at once.

    Args:
        count: of slots.
        timeout_s: seconds without an observation after which a body is dropped.
        counters: gets ``body_too_little_seen``, ``too_many_bodies`` and ``body_for_load``.

    Attributes:
        keys: (S,) key of each slot's body; None of a free slot.
        present: (S,) which slots hold a body that has been observed at a grid time.
        left_out: bodies of the newest message for which there is no time.
    """

    def __init__(self, count: int, timeout_s: float, counters: Counter[str]) -> None:
        self._timeout_ns, self._counters = timeout_s * 1e9, counters
        self.keys: list[Key | None] = [None] * count
        self._most = count
        self.left_out = 0
        self._distance = np.full(count, np.inf)
        self.present = np.zeros(count, dtype=bool)
        self._last_observed_ns = np.zeros(count, dtype=np.int64)  # 0: not on the grid yet

    def crowded_out(self, most: int, bodies: Iterable[tuple[Key | None, BodyJoints]], sensor: Floats) -> Bools:
        """The slots (S,) of bodies beyond the ``most`` that there is time for: those that were observed farthest away.

        Args:
            most: bodies, from now on.
            bodies: of the newest message, as of `arrange`.
            sensor: (3,) metres, where it stands.
        """
        self._most = most
        out = np.zeros(len(self.keys), dtype=bool)
        if most < len(self.keys):
            for key, joints in bodies:
                if key is not None and key in self.keys:
                    self._distance[self.keys.index(key)] = _distance(joints.positions, sensor)
            taken = [slot for slot, key in enumerate(self.keys) if key is not None]
            out[sorted(taken, key=self._distance.__getitem__)[most:]] = True
        return out

    @property
    def taken(self) -> int:
        """How many slots hold a body."""
        return sum(key is not None for key in self.keys)

    def excuse(self, stamp_ns: int) -> None:
        """Messages were skipped until now: no body counts as unobserved in that time."""
        self._last_observed_ns[self._last_observed_ns > 0] = stamp_ns

    def arrange(self, bodies: Iterable[tuple[Key | None, BodyJoints]]) -> BodyJoints:
        """Sort bodies into slots by key (None: a body without one, which is left out): joints and confidence by
        slot."""
        positions, confidence = np.full((len(self.keys), 22, 3), np.nan), np.zeros((len(self.keys), 22))
        self.left_out = 0
        for key, joints in bodies:
            if key is None:
                continue
            slot = self._slot(key, int(np.isfinite(joints.positions[:, 0]).sum()))
            if slot is not None:
                positions[slot], confidence[slot] = joints
        return BodyJoints(positions, confidence)

    def advance(self, stamp_ns: int, positions: Floats) -> Bools:
        """Advance to a grid time, with its joints (S, 22, 3); returns the slots (S,) whose bodies have timed out."""
        taken = np.array([key is not None for key in self.keys])
        observed = np.asarray(finite_joints(positions).any(axis=1))
        self.present = self.present & taken | observed
        new = self._last_observed_ns == 0
        self._last_observed_ns = np.where(observed | new, stamp_ns, self._last_observed_ns)
        return taken & (stamp_ns - self._last_observed_ns > self._timeout_ns)

    def free(self, slot: Bools) -> None:
        """Free these slots (S,)."""
        self.present = self.present & ~slot
        for k in np.flatnonzero(slot):
            self.keys[k] = None

    def _slot(self, key: Key, joints_observed: int) -> int | None:
        """The slot of a body; a free one if it is new and enough of it is visible."""
        if key in self.keys:
            return self.keys.index(key)
        if joints_observed < MIN_JOINTS:
            self._counters["body_too_little_seen"] += 1
            return None
        if None not in self.keys:
            self._counters["too_many_bodies"] += 1
            return None
        if self.taken >= self._most:
            self._counters["body_for_load"] += 1
            self.left_out += 1
            return None
        slot = self.keys.index(None)
        self.keys[slot] = key
        self._last_observed_ns[slot] = 0
        self._distance[slot] = np.inf
        return slot


def _distance(positions: Floats, sensor: Floats) -> float:
    """Metres from a sensor to the mean of the joints (22, 3) that it observes."""
    observed = positions[finite_joints(positions)]
    return float(np.linalg.norm(observed.mean(axis=0) - sensor)) if len(observed) else np.inf
