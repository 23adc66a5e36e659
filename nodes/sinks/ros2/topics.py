"""The topics of the bridge: each message of steadypose as the ROS messages that it becomes."""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol

import numpy as np

from steadypose.msgs.codec import encode
from steadypose.msgs.types import Diagnostics, Message, Pose, PoseClean, PoseEvents, PoseRaw, PoseWorld, WorldBody
from steadypose.nodes.ros2.definitions import new, serialise
from steadypose.nodes.sinks.ros2 import messages
from steadypose.nodes.sinks.ros2.rep155 import frames, joint_angles, measures, urdf
from steadypose.nodes.sinks.ros2.settings import Ros2BridgeSettings
from steadypose.prior.body.kinematics import rotation_matrix
from steadypose.prior.models.posture.root import RootCovariance

MARKERS, POSES, BODIES = "steadypose/markers", "steadypose/poses", "humans/bodies"
GROWN = 0.02
"""metres: where a link has become so much longer or shorter, the body's URDF is published again"""
OF_BODY = {
    "joint_states": "sensor_msgs/msg/JointState",
    "odom": "nav_msgs/msg/Odometry",
    "urdf": "std_msgs/msg/String",
}


class Output(Protocol):
    """Where serialised messages go."""

    def send(self, topic: str, kind: str, cdr: bytes, *, latched: bool = False) -> None: ...

    def drop(self, topic: str) -> None: ...


class BodyTopics:
    """Sends what steadypose says as ROS messages.

    Args:
        output: where to.
        settings: of the bridge.
    """

    def __init__(self, output: Output, settings: Ros2BridgeSettings) -> None:
        self._output, self._settings = output, settings
        self._root_covariance = RootCovariance()
        self._measured: dict[str, dict[str, np.ndarray]] = {}
        self._still: dict[str, Pose] = {}
        self._moving: set[str] = set()

    def send(self, message: Message) -> int:
        """Send a message; returns how many of its bodies could not be, for want of a finite pose."""
        if isinstance(message, Diagnostics):
            self._send("diagnostics", "diagnostic_msgs/msg/DiagnosticArray", messages.diagnostic_array(message))
        elif isinstance(message, PoseRaw):
            self._output.send("steadypose/pose_raw", "steadypose_msgs/msg/PoseRaw", encode(message))
        elif isinstance(message, PoseClean):
            self._output.send("steadypose/pose_clean", "steadypose_msgs/msg/PoseClean", encode(message))
            self._send_sensor(message)
        elif isinstance(message, PoseEvents):
            events = dataclasses.replace(message, frame_id=self._settings.world_frame)
            self._output.send("steadypose/pose_events", "steadypose_msgs/msg/PoseEvents", encode(events))
        elif isinstance(message, PoseWorld):
            return self._send_world(dataclasses.replace(message, frame_id=self._settings.world_frame))
        return 0

    def send_clock(self, stamp_ns: int) -> None:
        """The time of a replay."""
        self._send("clock", "rosgraph_msgs/msg/Clock", messages.clock(max(stamp_ns, 0)))

    def _send_world(self, world: PoseWorld) -> int:
        self._output.send("steadypose/pose_world", "steadypose_msgs/msg/PoseWorld", encode(world))
        bodies, refused = messages.names_of(world)
        for gone in self._measured.keys() - bodies.keys():
            del self._measured[gone]
            for topic in OF_BODY:
                self._output.drop(f"{BODIES}/{gone}/{topic}")
        self._send(f"{BODIES}/tracked", "hri_msgs/msg/IdsList", messages.ids_list(world, list(bodies)))
        self._send(MARKERS, "visualization_msgs/msg/MarkerArray", messages.marker_array(world, bodies))
        self._send(POSES, "geometry_msgs/msg/PoseArray", messages.pose_array(world, bodies))
        transforms: list[Any] = []
        for name, body in bodies.items():
            links = frames(body)
            transforms += messages.body_transforms(world, name, links)
            state = messages.joint_state(world, name, joint_angles(links))
            self._send_of(name, "joint_states", state)
            self._send_of(name, "odom", messages.odometry(world, name, body, self._turn_covariance(body)))
            self._send_urdf(name, measures(body))
        if transforms:
            self._send("tf", "tf2_msgs/msg/TFMessage", messages.tf_message(transforms))
        return refused

    def _turn_covariance(self, body: WorldBody) -> np.ndarray:
        """(3, 3) rad², of the root's orientation."""
        positions, sigma = body.positions.astype(np.float64), body.sigma.astype(np.float64)
        return self._root_covariance(positions[None], sigma[None], rotation_matrix(body.root_orientation)[None])[0]

    def _send_urdf(self, name: str, measured: dict[str, np.ndarray]) -> None:
        last = self._measured.get(name)
        if last is None or max(np.abs(measured[link] - at).max() for link, at in last.items()) > GROWN:
            self._measured[name] = measured
            self._send_of(name, "urdf", new("std_msgs/msg/String", data=urdf(name, measured)), latched=True)

    def _send_sensor(self, clean: PoseClean) -> None:
        """A sensor that stands still goes to /tf_static when it is first heard of, one that moves to /tf with each
        message. Who listens late gets the last message of /tf_static alone: each has all sensors that stand still."""
        frame, pose, world = clean.frame_id, clean.sensor_pose, self._settings.world_frame
        if not self._settings.sensor_tf or not clean.calibrated or frame in ("", world):
            return

        def transform(frame: str, pose: Pose) -> Any:
            return messages.transform(clean.stamp_ns, world, frame, pose.position, pose.orientation)

        if frame not in self._moving:
            last = self._still.get(frame)
            if last == pose:
                return
            if last is None:
                self._still[frame] = pose
            else:
                self._moving.add(frame)
                del self._still[frame]
            still = messages.tf_message([transform(*sensor) for sensor in self._still.items()])
            self._send("tf_static", "tf2_msgs/msg/TFMessage", still, latched=True)
        if frame in self._moving:
            self._send("tf", "tf2_msgs/msg/TFMessage", messages.tf_message([transform(frame, pose)]))

    def _send(self, topic: str, kind: str, message: Any, *, latched: bool = False) -> None:
        self._output.send(topic, kind, serialise(message, kind), latched=latched)

    def _send_of(self, name: str, topic: str, message: Any, *, latched: bool = False) -> None:
        self._send(f"{BODIES}/{name}/{topic}", OF_BODY[topic], message, latched=latched)
