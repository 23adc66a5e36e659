"""``pose/world`` and ``diagnostics`` as ROS 2 topics."""

# pyright: reportMissingImports=false
# an optional extra, which need not be installed

from __future__ import annotations

from collections.abc import Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, Pose, PoseArray, Quaternion, Vector3
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from rclpy.time import Time
from sensor_msgs.msg import JointState as JointAngles
from std_msgs.msg import ColorRGBA, Header, String
from visualization_msgs.msg import Marker, MarkerArray

from steadypose.msgs.types import Diagnostics, JointState, PoseWorld, Tracking, WorldBody
from steadypose.nodes.sinks.ros2.dds import DdsOutput, body_transforms
from steadypose.nodes.sinks.ros2.rep155 import Links, body_name, frames, joint_angles, joint_rotations, measures, urdf
from steadypose.prior.body.kinematics import quaternions
from steadypose.prior.body.skeleton import PARENTS, J

if TYPE_CHECKING:
    from typing_extensions import Self

MARKERS = "steadypose/markers"
POSES = "steadypose/poses"
DIAGNOSTICS = "diagnostics"
BODIES = "humans/bodies"
DEPTH = 10
"""messages held for a subscriber that is late"""
MARKER_LIFE_S = 0.5
JOINT_SIZE, BONE_WIDTH, TEXT_SIZE = 0.05, 0.02, 0.12
"""metres"""
GROWN = 0.02
"""metres: where a link has become so much longer or shorter, the body's URDF is published again"""
COLOURS: Mapping[int, ColorRGBA] = {
    JointState.UNKNOWN: ColorRGBA(r=0.5, g=0.5, b=0.5, a=0.5),
    JointState.SEEN: ColorRGBA(r=0.2, g=0.8, b=0.3, a=1.0),
    JointState.REFINED: ColorRGBA(r=0.2, g=0.6, b=0.9, a=1.0),
    JointState.IMPUTED: ColorRGBA(r=1.0, g=0.6, b=0.1, a=1.0),
}


class _Body:
    """The topics of one body, ``/humans/bodies/<id>/…``, there as long as the body is."""

    def __init__(self, node: Any, name: str) -> None:
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.angles = node.create_publisher(JointAngles, f"{BODIES}/{name}/joint_states", DEPTH)
        self.urdf = node.create_publisher(String, f"{BODIES}/{name}/urdf", latched)
        self.measured: dict[str, np.ndarray] = {}


class RosOutput:
    """A ROS 2 node that publishes. A context manager.

    Of each ``pose/world`` message: markers for RViz, the poses of all joints, transforms, and per REP-155 the list of
    bodies, and of each body its joint angles and URDF. A body that is lost is not published.
    """

    def __init__(self) -> None:
        self._context = rclpy.Context()
        # Ctrl-C is this node's business, not rclpy's
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self._node: Any = rclpy.create_node(
            "steadypose", context=self._context, start_parameter_services=False, enable_rosout=False
        )
        self._markers = self._node.create_publisher(MarkerArray, MARKERS, DEPTH)
        self._poses = self._node.create_publisher(PoseArray, POSES, DEPTH)
        self._diagnostics = self._node.create_publisher(DiagnosticArray, DIAGNOSTICS, DEPTH)
        self._dds = DdsOutput(self._context.get_domain_id())
        self._bodies: dict[str, _Body] = {}

    def publish_bodies(self, world: PoseWorld) -> int:
        """Publish a message; returns how many of its bodies could not be, for want of a finite pose."""
        followed = [body for body in world.bodies if body.tracking != Tracking.LOST]
        tracked = {body_name(body.id): body for body in followed if _is_finite(body)}
        header = Header(stamp=Time(nanoseconds=world.stamp_ns).to_msg(), frame_id=world.frame_id)
        for gone in self._bodies.keys() - tracked.keys():
            body = self._bodies.pop(gone)
            self._node.destroy_publisher(body.angles)
            self._node.destroy_publisher(body.urdf)
        self._dds.publish_tracked(world.stamp_ns, world.frame_id, list(tracked))
        self._markers.publish(MarkerArray(markers=[m for name, b in tracked.items() for m in _marks(header, name, b)]))
        self._poses.publish(PoseArray(header=header, poses=[p for b in tracked.values() for p in _joint_poses(b)]))
        transforms = []
        for name, body in tracked.items():
            links = frames(body)
            transforms += body_transforms(world.stamp_ns, world.frame_id, name, links)
            self._publish_body(header, name, links, measures(body))
        if transforms:
            self._dds.publish_transforms(transforms)
        return len(followed) - len(tracked)

    def _publish_body(self, header: Header, name: str, links: Links, measured: dict[str, np.ndarray]) -> None:
        if name not in self._bodies:
            self._bodies[name] = _Body(self._node, name)
        topics = self._bodies[name]
        if not topics.measured or max(np.abs(measured[k] - v).max() for k, v in topics.measured.items()) > GROWN:
            topics.measured = measured
            topics.urdf.publish(String(data=urdf(name, measured)))
        angles = joint_angles(links)
        names = [f"{joint}_{name}" for joint in angles]
        topics.angles.publish(JointAngles(header=header, name=names, position=list(angles.values())))

    def publish_diagnostics(self, diagnostics: Diagnostics) -> None:
        status = DiagnosticStatus(
            level=bytes([diagnostics.level]),
            name=f"steadypose: {diagnostics.node}",
            message=diagnostics.message,
            hardware_id=diagnostics.node,
            values=[KeyValue(key=key, value=value) for key, value in diagnostics.values.items()],
        )
        header = Header(stamp=Time(nanoseconds=diagnostics.stamp_ns).to_msg())
        self._diagnostics.publish(DiagnosticArray(header=header, status=[status]))

    def close(self) -> None:
        self._dds.close()
        self._node.destroy_node()
        self._context.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


def _is_finite(body: WorldBody) -> bool:
    return bool(np.isfinite(body.positions).all() and (np.abs(np.linalg.norm(body.rotations, axis=1) - 1) < 0.1).all())


def _joint_poses(body: WorldBody) -> list[Pose]:
    """The 22 canonical joints in the world."""
    turns = quaternions(joint_rotations(body)).tolist()
    return [
        Pose(position=point, orientation=Quaternion(x=x, y=y, z=z, w=w))
        for point, (x, y, z, w) in zip(_points(body), turns, strict=True)
    ]


def _points(body: WorldBody) -> list[Point]:
    return [Point(x=x, y=y, z=z) for x, y, z in body.positions.astype(np.float64).tolist()]


def _marks(header: Header, name: str, body: WorldBody) -> list[Marker]:
    """Joints, coloured by where they come from, the bones between them, and the body's name above its head."""
    points, colours = _points(body), [COLOURS[int(state)] for state in body.state]

    def mark(kind: int, part: str, scale: Vector3, **more: Any) -> Marker:
        return Marker(
            header=header,
            ns=f"{name}/{part}",
            type=kind,
            pose=Pose(orientation=Quaternion(w=1.0)),
            scale=scale,
            lifetime=Duration(seconds=MARKER_LIFE_S).to_msg(),
            **more,
        )

    ends = [joint for child, parent in enumerate(PARENTS) if parent >= 0 for joint in (parent, child)]
    text = mark(
        Marker.TEXT_VIEW_FACING,
        "name",
        Vector3(z=TEXT_SIZE),
        text=name if body.tracking == Tracking.OK else f"{name}, {body.tracking.name.lower()}",
        color=ColorRGBA(r=1.0, g=1.0, b=1.0, a=1.0),
    )
    x, y, z = body.positions[J["head"]].astype(np.float64).tolist()
    text.pose.position = Point(x=x, y=y, z=z + 3 * TEXT_SIZE)
    size = Vector3(x=JOINT_SIZE, y=JOINT_SIZE, z=JOINT_SIZE)
    return [
        mark(Marker.SPHERE_LIST, "joints", size, points=points, colors=colours),
        mark(
            Marker.LINE_LIST,
            "bones",
            Vector3(x=BONE_WIDTH),
            points=[points[joint] for joint in ends],
            # a bone has the colour of its far end
            colors=[colours[child] for child in ends[1::2] for _ in range(2)],
        ),
        text,
    ]
