"""Skeletons from a ROS 2 topic, and the pose of a moving sensor from TF."""

from __future__ import annotations

import dataclasses
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np
from rosbags.serde import SerdeError

from steadypose.msgs.types import Pose, PoseRaw
from steadypose.nodes.checks.problem import Problem, error, warning
from steadypose.nodes.graph.clock import POLL_S, Clock
from steadypose.nodes.ros2 import check_ros, connect
from steadypose.nodes.ros2.definitions import Connection, deserialise, stamp_ns
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sources.adapters import from_azure_kinect, from_pose_array
from steadypose.nodes.sources.source import LiveSource, SourceContext
from steadypose.prior.arrays import Floats
from steadypose.prior.body.layouts import SKELETONS, layout_names
from steadypose.prior.settings import nearest

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

CACHE_NS = 10_000_000_000  # time for which transforms are kept, nanoseconds; the same as in tf2
_IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])
Moment = tuple[int, Floats, Floats]
"""Stamp in nanoseconds, translation (3,) metres and quaternion (4,) xyzw, from the child's frame to the parent's."""
_stamp = itemgetter(0)


class TransformError(LookupError):
    """A transform that is not known, or not yet. The text says which, and why."""


class TransformBuffer:
    """The transforms received on ``/tf`` and ``/tf_static``."""

    def __init__(self) -> None:
        self._parents: dict[str, str] = {}
        self._moments: dict[str, list[Moment]] = {}
        """transforms by child frame, ordered by stamp"""
        self._static: set[str] = set()

    def add(self, message: Any, *, static: bool) -> None:
        """Add a ``tf2_msgs/TFMessage``. Invalid transforms are ignored."""
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
                moments.clear()  # static transforms have no history; or the clock was set back, as by a restarted bag
            at_index = bisect_left(moments, moment[0], key=_stamp)
            if at_index == len(moments) or moments[at_index][0] != moment[0]:  # the first of a stamp counts, as in tf2
                moments.insert(at_index, moment)
            del moments[: bisect_left(moments, moments[-1][0] - CACHE_NS, key=_stamp)]

    def lookup(self, target: str, source: str, at_ns: int) -> tuple[Floats, Floats]:
        """The pose of the frame ``source`` in the frame ``target`` at a time: (3,) metres, and (4,) xyzw.

        Raises TransformError if the frames are not connected, or no transform is known at that time.
        """
        up, down = self._path(source), self._path(target)
        shared = next((frame for frame in up if frame in down), None)
        if shared is None:
            known = ", ".join(sorted({*self._parents, *self._parents.values()})) or "none"
            raise TransformError(f"no path from {source!r} to {target!r} in TF: expected one tree; frames: {known}")
        place, turned = self._chain(up[: up.index(shared)], at_ns)
        other, back = self._chain(down[: down.index(shared)], at_ns)
        inverse = back.inv()
        return inverse.apply(place - other), (inverse * turned).as_quat()

    def _path(self, frame: str) -> list[str]:
        """The frames from ``frame`` up to the root of its tree."""
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
            raise TransformError(f"the transform of {frame!r} is needed at a time {off:.3f} s {early} received on /tf")
        after = bisect_left(moments, at_ns, key=_stamp)
        b = moments[after]
        if b[0] == at_ns:
            return b[1], _rotation(b[2])
        a = moments[after - 1]
        share = (at_ns - a[0]) / (b[0] - a[0])
        start = _rotation(a[2])
        return a[1] + share * (b[1] - a[1]), start * (start.inv() * _rotation(b[2])) ** share


def _rotation(quaternion: Floats) -> Rotation:
    from scipy.spatial.transform import Rotation  # imported late (16 MB): every node reads the settings here

    return Rotation.from_quat(quaternion)


TF_MESSAGE = "tf2_msgs/msg/TFMessage"


@dataclass(frozen=True)
class TfSettings:
    """``[input.tf]``: the sensor's pose from TF, also on a moving robot."""

    fixed_frame: str = ""
    """a fixed frame with z up, such as odom or map; empty: TF is not used"""
    sensor_frame: str = ""
    """the frame of the joints; empty: the ``frame_id`` of the source's messages"""
    timeout: float = 0.2
    """longest time a message waits for the transform at its stamp, seconds"""

    def __post_init__(self) -> None:
        if not 0 <= self.timeout <= 5:
            raise LaunchError(f"[input.tf] timeout: expected 0 to 5 seconds, got {self.timeout:g}")


class TfSource(LiveSource):
    """A live source whose messages get their sensor pose from TF at their stamp.

    A message whose transform does not arrive in time is dropped and counted.
    """

    def __init__(
        self, source: LiveSource, settings: TfSettings, clock: Clock, join: Callable[[str], Connection] = connect
    ) -> None:
        super().__init__()
        check_ros()
        self.refused = source.refused
        self._source, self._settings, self._clock, self._join = source, settings, clock, join
        self._buffer = TransformBuffer()
        self._waiting: deque[tuple[int, PoseRaw]] = deque()
        self._trouble = ""

    def frames(self) -> Generator[PoseRaw | None, None, None]:
        connection = self._join("steadypose_tf")
        try:
            for topic, static in (("tf", False), ("tf_static", True)):
                heard = partial(self._heard, static=static)
                connection.subscribe(topic, TF_MESSAGE, heard, latched=static, depth=100)
            with closing(self._source.frames()) as frames:
                for frame in frames:
                    if frame:
                        self._waiting.append((self._clock.monotonic_ns(), frame))
                    connection.spin(0.0)
                    yield from self._ready()
                    yield None
        finally:
            connection.close()

    def _heard(self, cdr: bytes, *, static: bool) -> None:
        self._buffer.add(deserialise(cdr, TF_MESSAGE), static=static)

    def _ready(self) -> Generator[PoseRaw, None, None]:
        """The waiting messages whose transform is known, oldest first."""
        while self._waiting:
            came_ns, frame = self._waiting[0]
            sensor = self._settings.sensor_frame or frame.frame_id
            try:
                place, turned = self._buffer.lookup(self._settings.fixed_frame, sensor, frame.stamp_ns)
            except TransformError as trouble:
                if self._clock.monotonic_ns() - came_ns < self._settings.timeout * 1e9:
                    return
                self._trouble = str(trouble)
                self.refused["without a transform"] += 1
            else:
                self._trouble = ""
                yield dataclasses.replace(frame, sensor_pose=Pose(place, turned), calibrated=True)
            self._waiting.popleft()

    def problems(self) -> list[Problem]:
        found = self._source.problems()
        if self._trouble:
            text = (
                f"{self._trouble}; expected the sensor's frame in {self._settings.fixed_frame!r} at each stamp: is the "
                "robot's TF published, in this ROS_DOMAIN_ID, with clocks that agree? [input.tf] names the frames"
            )
            found.append(error("tf", text))
        return found

    def status(self) -> dict[str, str]:
        return self._source.status()


TYPES = {"MarkerArray": "visualization_msgs/msg/MarkerArray", "PoseArray": "geometry_msgs/msg/PoseArray"}


@dataclass(frozen=True)
class Ros2Settings:
    """``[input.ros2]``: a ROS 2 topic with skeletons."""

    topic: str = "/body_tracking_data"
    type: str = "MarkerArray"
    """MarkerArray, as published by the Azure Kinect's driver; or PoseArray, the joints of one body after another"""
    skeleton: str = "smpl22"
    """name of a PoseArray's joint layout"""
    up: str = "z"
    """the axis of a PoseArray's frame that points up: z, y or -y"""

    def __post_init__(self) -> None:
        if self.type not in TYPES:
            raise LaunchError(f"[input.ros2] type: expected MarkerArray or PoseArray, got {self.type!r}")
        if self.up not in ("z", "y", "-y"):
            raise LaunchError(f"[input.ros2] up: expected z, y or -y, got {self.up!r}")


class Ros2Source(LiveSource):
    """Skeletons from a topic of ``MarkerArray`` or ``PoseArray``. Raises LaunchError if the skeleton is unknown."""

    def __init__(self, settings: Ros2Settings, context: SourceContext) -> None:
        super().__init__()
        check_ros()
        if (name := settings.skeleton) not in SKELETONS:
            got = f"{name!r}{nearest(name, SKELETONS)}"
            raise LaunchError(f"[input.ros2] skeleton: expected one of {layout_names()}, got {got}")
        self._settings = settings
        self._queue: deque[PoseRaw] = deque()
        self._received = 0
        self._wrong = ""

    def frames(self) -> Generator[PoseRaw | None, None, None]:
        connection = connect("steadypose_input")
        try:
            connection.subscribe(self._settings.topic.lstrip("/"), TYPES[self._settings.type], self._on_message)
            while True:
                connection.spin(POLL_S)
                yield self._queue.popleft() if self._queue else None
                while self._queue:
                    yield self._queue.popleft()
        finally:
            connection.close()

    def _on_message(self, cdr: bytes) -> None:
        self._received += 1
        try:
            message = deserialise(cdr, TYPES[self._settings.type])
            if self._settings.type == "MarkerArray":
                raw = from_azure_kinect(message, source=self._settings.topic)
            else:
                skeleton = SKELETONS[self._settings.skeleton]
                raw = from_pose_array(message, skeleton, self._settings.up, source=self._settings.topic)
        except (SerdeError, ValueError) as error:
            self.refused[f"not a {self._settings.type} of skeletons"] += 1
            self._wrong = str(error)
            return
        self._wrong = ""
        if raw:
            self._queue.append(raw)

    def problems(self) -> list[Problem]:
        if self._wrong:
            return [warning("ros_message", f"{self._settings.topic}: {self._wrong}")]
        if not self._received:
            expected = f"expected a {TYPES[self._settings.type]}"
            remedy = "check `ros2 topic list -t`, and that ROS_DOMAIN_ID is the same there and here"
            return [warning("ros_silent", f"no message on {self._settings.topic} yet: {expected}; {remedy}")]
        return []

    def status(self) -> dict[str, str]:
        return {"camera": f"{self._settings.topic}, {self._received} messages"}
