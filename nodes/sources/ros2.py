"""Skeletons from a ROS 2 topic, in place of a camera: ``[input] source = "ros2"``."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator
from dataclasses import dataclass

from rosbags.serde import SerdeError

from steadypose.msgs.types import PoseRaw
from steadypose.nodes.checks.problem import Problem, warning
from steadypose.nodes.graph.clock import POLL_S
from steadypose.nodes.graph.settings import LaunchError
from steadypose.nodes.ros2.connect import check_ros, connect
from steadypose.nodes.ros2.definitions import deserialise
from steadypose.nodes.sources.adapters import from_azure_kinect, from_pose_array
from steadypose.nodes.sources.source import LiveSource, SourceContext
from steadypose.prior.body.layouts import SKELETONS
from steadypose.prior.settings import nearest

TYPES = {"MarkerArray": "visualization_msgs/msg/MarkerArray", "PoseArray": "geometry_msgs/msg/PoseArray"}


@dataclass(frozen=True)
class Ros2Settings:
    """``[input.ros2]``: a ROS 2 topic with skeletons."""

    topic: str = "/body_tracking_data"
    type: str = "MarkerArray"
    """MarkerArray, as of the Azure Kinect's driver; or PoseArray, the joints of one body after the other"""
    skeleton: str = "smpl22"
    """of a PoseArray: the joints and their order"""
    up: str = "z"
    """of a PoseArray: the axis of its frame that points up: z, y or -y"""

    def __post_init__(self) -> None:
        if self.type not in ("MarkerArray", "PoseArray"):
            raise LaunchError(f"[input.ros2] type: expected MarkerArray or PoseArray, got {self.type!r}")
        if self.up not in ("z", "y", "-y"):
            raise LaunchError(f"[input.ros2] up: expected z, y or -y, got {self.up!r}")


class Ros2Source(LiveSource):
    """A subscription to ``MarkerArray`` or ``PoseArray``.

    Raises:
        LaunchError: there is no such skeleton.
    """

    def __init__(self, settings: Ros2Settings, context: SourceContext) -> None:
        super().__init__()
        check_ros()
        if settings.skeleton not in SKELETONS:
            raise LaunchError(
                f"[input.ros2] skeleton: expected one of {', '.join(SKELETONS)}, got {settings.skeleton!r}"
                f"{nearest(settings.skeleton, SKELETONS)}"
            )
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
            return [
                warning(
                    "ros_silent",
                    f"nothing has come on {self._settings.topic}: expected a {TYPES[self._settings.type]}; see `ros2 "
                    "topic list -t`, and that ROS_DOMAIN_ID is the same there and here",
                )
            ]
        return []

    def status(self) -> dict[str, str]:
        return {"camera": f"{self._settings.topic}, {self._received} messages"}
