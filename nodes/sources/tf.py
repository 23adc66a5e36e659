"""The pose of a live source's sensor, looked up in ROS 2's TF by the stamp of each message: ``[input.tf]``."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass

from steadypose.msgs.types import Pose, PoseRaw
from steadypose.nodes.checks.problem import Problem, error
from steadypose.nodes.graph.clock import Clock
from steadypose.nodes.graph.settings import LaunchError
from steadypose.nodes.ros2.connect import check_ros, connect
from steadypose.nodes.ros2.connection import Connection
from steadypose.nodes.ros2.definitions import deserialise
from steadypose.nodes.ros2.tf import TransformBuffer, TransformError
from steadypose.nodes.sources.source import LiveSource

TF_MESSAGE = "tf2_msgs/msg/TFMessage"


@dataclass(frozen=True)
class TfSettings:
    """``[input.tf]``: the sensor's pose from TF, also of a robot that moves."""

    fixed_frame: str = ""
    """a fixed frame with z up, such as odom or map; empty: TF is not used"""
    sensor_frame: str = ""
    """the frame of the joints; empty: what the source's messages name"""
    timeout: float = 0.2
    """seconds that a message waits for the transform of its stamp"""

    def __post_init__(self) -> None:
        if not 0 <= self.timeout <= 5:
            raise LaunchError(f"[input.tf] timeout: expected 0 to 5 seconds, got {self.timeout:g}")


class TfSource(LiveSource):
    """A live source whose messages get the pose that TF has of their frame at their stamp.

    One that waited in vain is dropped and counted: where it was seen from is not known.
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
            connection.subscribe("tf", TF_MESSAGE, lambda cdr: self._heard(cdr, static=False), depth=100)
            connection.subscribe(
                "tf_static", TF_MESSAGE, lambda cdr: self._heard(cdr, static=True), latched=True, depth=100
            )
            with closing(self._source.frames()) as frames:
                for frame in frames:
                    if frame:
                        self._waiting.append((self._clock.now_ns(), frame))
                    connection.spin(0.0)
                    yield from self._ready()
                    yield None
        finally:
            connection.close()

    def _heard(self, cdr: bytes, *, static: bool) -> None:
        self._buffer.add(deserialise(cdr, TF_MESSAGE), static=static)

    def _ready(self) -> Generator[PoseRaw, None, None]:
        """Those whose transform is known, oldest first."""
        while self._waiting:
            came_ns, frame = self._waiting[0]
            sensor = self._settings.sensor_frame or frame.frame_id
            try:
                place, turned = self._buffer.lookup(self._settings.fixed_frame, sensor, frame.stamp_ns)
            except TransformError as trouble:
                if self._clock.now_ns() - came_ns < self._settings.timeout * 1e9:
                    return
                self._waiting.popleft()
                self._trouble = str(trouble)
                self.refused["without a transform"] += 1
                continue
            self._waiting.popleft()
            self._trouble = ""
            yield dataclasses.replace(frame, sensor_pose=Pose(place, turned), calibrated=True)

    def problems(self) -> list[Problem]:
        found = self._source.problems()
        if self._trouble:
            found.append(
                error(
                    "tf",
                    f"{self._trouble}; expected the sensor's frame in {self._settings.fixed_frame!r} at each stamp: "
                    "is the robot's TF published, in this ROS_DOMAIN_ID, with clocks that agree? [input.tf] names the "
                    "frames",
                )
            )
        return found

    def status(self) -> dict[str, str]:
        return self._source.status()
