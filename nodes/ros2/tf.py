"""A buffer of transforms between frames, as tf2's: looked up by stamp, interpolated, along the tree."""

from __future__ import annotations

from bisect import bisect_left
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from steadypose.nodes.ros2.definitions import stamp_ns
from steadypose.prior.arrays import Floats

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

CACHE_NS = 10_000_000_000
"""for how long transforms are kept, as tf2 does"""
_IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])
Moment = tuple[int, Floats, Floats]
"""stamp, translation (3,) metres and quaternion (4,) xyzw, from the child's frame to the parent's"""
_stamp = itemgetter(0)


class TransformError(LookupError):
    """A transform that is not known, yet or at all. The text says which, and why."""


class TransformBuffer:
    """The transforms received on ``/tf`` and ``/tf_static``."""

    def __init__(self) -> None:
        self._parents: dict[str, str] = {}
        self._moments: dict[str, list[Moment]] = {}
        """by child, in the order of their stamps"""
        self._static: set[str] = set()

    def add(self, message: Any, *, static: bool) -> None:
        """Take a ``tf2_msgs/TFMessage``; transforms that are no pose are ignored."""
        for transform in message.transforms:
            child, parent = transform.child_frame_id.lstrip("/"), transform.header.frame_id.lstrip("/")
            at, turned = transform.transform.translation, transform.transform.rotation
            place = np.array([at.x, at.y, at.z])
            quaternion = np.array([turned.x, turned.y, turned.z, turned.w])
            sound = np.isfinite(place).all() and abs(np.linalg.norm(quaternion) - 1.0) < 0.01
            if not sound or not child or not parent or child == parent:
                continue
            if self._parents.get(child, parent) != parent:
                self._moments.pop(child, None)
            self._parents[child] = parent
            (self._static.add if static else self._static.discard)(child)
            moments = self._moments.setdefault(child, [])
            moment = stamp_ns(transform.header), place, quaternion
            if static or (moments and moment[0] < moments[-1][0] - CACHE_NS):
                moments.clear()  # or the clock was set back, as when a bag begins again
            at_index = bisect_left(moments, moment[0], key=_stamp)
            if at_index == len(moments) or moments[at_index][0] != moment[0]:  # the first of a stamp counts, as in tf2
                moments.insert(at_index, moment)
            del moments[: bisect_left(moments, moments[-1][0] - CACHE_NS, key=_stamp)]

    def lookup(self, target: str, source: str, at_ns: int) -> tuple[Floats, Floats]:
        """The pose of a frame in another at a time.

        Returns:
            position (3,) metres and quaternion (4,) xyzw of ``source`` in ``target``.

        Raises:
            TransformError: the frames are not connected, or not at that time.
        """
        up, down = self._path(source), self._path(target)
        shared = next((frame for frame in up if frame in down), None)
        if shared is None:
            known = ", ".join(sorted({*self._parents, *self._parents.values()})) or "none"
            raise TransformError(
                f"no path from {source!r} to {target!r} in TF: expected one tree; frames heard of: {known}"
            )
        place, turned = self._chain(up[: up.index(shared)], at_ns)
        other, back = self._chain(down[: down.index(shared)], at_ns)
        inverse = back.inv()
        return inverse.apply(place - other), (inverse * turned).as_quat()

    def _path(self, frame: str) -> list[str]:
        """From a frame up to the root of its tree."""
        path = [frame]
        while (parent := self._parents.get(path[-1])) is not None and parent not in path:
            path.append(parent)
        return path

    def _chain(self, frames: list[str], at_ns: int) -> tuple[Floats, Rotation]:
        place, turned = np.zeros(3), _rotation(_IDENTITY)
        for frame in frames:
            step, turn = self._at(frame, at_ns)
            place, turned = step + turn.apply(place), turn * turned
        return place, turned

    def _at(self, frame: str, at_ns: int) -> tuple[Floats, Rotation]:
        moments = self._moments[frame]
        if frame in self._static:
            return moments[-1][1], _rotation(moments[-1][2])
        first, last = moments[0][0], moments[-1][0]
        if not first <= at_ns <= last:
            early = "older than the oldest" if at_ns < first else "newer than the newest"
            off = (first - at_ns if at_ns < first else at_ns - last) / 1e9
            raise TransformError(f"the transform of {frame!r} is wanted for a moment {off:.3f} s {early} heard on /tf")
        after = bisect_left(moments, at_ns, key=_stamp)
        b = moments[after]
        if b[0] == at_ns:
            return b[1], _rotation(b[2])
        a = moments[after - 1]
        share = (at_ns - a[0]) / (b[0] - a[0])
        start = _rotation(a[2])
        return a[1] + share * (b[1] - a[1]), start * (start.inv() * _rotation(b[2])) ** share


def _rotation(quaternion: Floats) -> Rotation:
    from scipy.spatial.transform import Rotation  # 16 MB: not for those nodes that only read a launch file

    return Rotation.from_quat(quaternion)
