"""Assigns bodies to slots. A new body takes a free slot; a body that is not observed for a while leaves it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterable, Sequence
from typing import Generic, TypeVar

import numpy as np

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.skeleton import finite_joints
from steadypose.prior.clean.adapt import BodyJoints

MIN_JOINTS = 6  # least number of observed canonical joints of a new body
ABSENT_NS = 200_000_000
"""Time without an observation after which a body makes way for a new one if no slot is free, nanoseconds. A detector
misses people for less, and a client's frame may come that late."""


Key = TypeVar("Key", bound=Hashable)


class Slots(Generic[Key]):
    """The bodies tracked at once.

    Args:
        count: number of slots.
        timeout_s: seconds without an observation after which a body is dropped.
        counters: counts ``body_too_little_seen``, ``too_many_bodies`` and ``body_for_load``.

    Attributes:
        keys: (S,) key of each slot's body; None for a free slot.
        present: (S,) which slots hold a body that has been observed at a grid time.
        left_out: number of bodies in the newest message that are not processed for lack of time.
    """

    def __init__(self, count: int, timeout_s: float, counters: Counter[str]) -> None:
        self._timeout_ns, self._counters = timeout_s * 1e9, counters
        self.keys: list[Key | None] = [None] * count
        self._most = count
        self.left_out = 0
        self._distance = np.full(count, np.inf)
        self.present = np.zeros(count, dtype=bool)
        self._now_ns = 0  # on the grid
        self._last_observed_ns = np.zeros(count, dtype=np.int64)  # 0: not on the grid yet

    def crowded_out(self, most: int, bodies: Iterable[tuple[Key | None, BodyJoints]], sensor: Floats) -> Bools:
        """Return the slots (S,) of those bodies, farthest from the sensor (3,), beyond the ``most`` for which there is
        time from now on."""
        self._most = most
        out = np.zeros(len(self.keys), dtype=bool)
        if most < len(self.keys):
            for key, joints in bodies:
                if key is not None and key in self.keys:
                    self._distance[self.keys.index(key)] = _distance(joints.positions, sensor)
            taken = [slot for slot, key in enumerate(self.keys) if key is not None]
            out[sorted(taken, key=self._distance.__getitem__)[most:]] = True
        return out

    def making_way(self, bodies: Sequence[tuple[Key | None, BodyJoints]]) -> Bools:
        """Return the slots (S,) of absent bodies that new ones need, those that are absent the longest."""
        out = np.zeros(len(self.keys), dtype=bool)
        new = [key for key, joints in bodies if key not in (None, *self.keys) and _observed(joints) >= MIN_JOINTS]
        if lacking := max(len(new) - self.keys.count(None), 0):
            absent_ns = np.where(self._last_observed_ns > 0, self._now_ns - self._last_observed_ns, 0)
            keys = {key for key, _ in bodies}
            here = np.array([key in keys for key in self.keys])
            longest = np.argsort(np.where(here, 0, -absent_ns), kind="stable")[:lacking]
            out[longest] = ~here[longest] & (absent_ns[longest] > ABSENT_NS)
        return out

    @property
    def taken(self) -> int:
        """Number of slots that hold a body."""
        return sum(key is not None for key in self.keys)

    def excuse(self, stamp_ns: int) -> None:
        """Note that messages until ``stamp_ns`` were skipped, so that no body counts as unobserved in that time."""
        self._last_observed_ns[self._last_observed_ns > 0] = stamp_ns

    def arrange(self, bodies: Iterable[tuple[Key | None, BodyJoints]]) -> BodyJoints:
        """Sort bodies into slots by key and return joints and confidence by slot. Bodies without a key are left out."""
        positions, confidence = np.full((len(self.keys), 22, 3), np.nan), np.zeros((len(self.keys), 22))
        self.left_out = 0
        for key, joints in bodies:
            if key is None:
                continue
            slot = self._slot(key, _observed(joints))
            if slot is not None:
                positions[slot], confidence[slot] = joints
        return BodyJoints(positions, confidence)

    def advance(self, stamp_ns: int, positions: Floats) -> Bools:
        """Advance to a grid time with its joints (S, 22, 3); return the slots (S,) whose bodies have timed out."""
        self._now_ns = stamp_ns
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
        """Return the slot of a body. A new body takes a free slot if enough of its joints are observed."""
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


def _observed(joints: BodyJoints) -> int:
    """Return the number of a body's observed joints."""
    return int(np.isfinite(joints.positions[:, 0]).sum())


def _distance(positions: Floats, sensor: Floats) -> float:
    """Return the metres from a sensor to the mean of the observed joints (22, 3)."""
    observed = positions[finite_joints(positions)]
    return float(np.linalg.norm(observed.mean(axis=0) - sensor)) if len(observed) else np.inf
