"""Converts ``pose/world`` and ``diagnostics`` to ROS 2 messages of standard types, and assigns their topics."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from steadypose.msgs.codec import encode, wire_type
from steadypose.msgs.types import (
    Diagnostics,
    JointState,
    Message,
    Pose,
    PoseClean,
    PoseEvents,
    PoseRaw,
    PoseWorld,
    Tracking,
    WorldBody,
)
from steadypose.nodes.ros2.definitions import header, new, serialise
from steadypose.nodes.sinks.drawing import ALL_BONES
from steadypose.nodes.sinks.ros2.rep155 import Links, body_name, frames, joint_angles, joint_rotations, measures, urdf
from steadypose.prior.body.kinematics import rotation_matrix
from steadypose.prior.body.skeleton import J
from steadypose.prior.models.pelvis import RootCovariance

MARKER_LIFE_S = 0.5
JOINT_SIZE, BONE_WIDTH, TEXT_SIZE = 0.05, 0.02, 0.12  # sizes of markers, metres
SPHERE_LIST, LINE_LIST, TEXT_VIEW_FACING, ARROW = 7, 5, 9, 0  # marker types of ``visualization_msgs/Marker``
UNKNOWN_VARIANCE = 1e6  # variance of unobserved components of an odometry, m², rad², m²/s² or rad²/s²


def _colour(r: float, g: float, b: float, a: float = 1.0) -> Any:
    return new("std_msgs/msg/ColorRGBA", r=r, g=g, b=b, a=a)


COLOURS: Mapping[int, Any] = {
    JointState.UNKNOWN: _colour(0.5, 0.5, 0.5, 0.5),
    JointState.SEEN: _colour(0.2, 0.8, 0.3),
    JointState.REFINED: _colour(0.2, 0.6, 0.9),
    JointState.IMPUTED: _colour(1.0, 0.6, 0.1),
}


def pose_array(world: PoseWorld, bodies: Mapping[str, WorldBody]) -> Any:
    """``geometry_msgs/PoseArray`` with the 22 joints of one body after another."""
    poses = []
    for body in bodies.values():
        turns = Rotation.from_matrix(joint_rotations(body)).as_quat()
        poses += [_pose(place, turn) for place, turn in zip(body.positions, turns, strict=True)]
    return new("geometry_msgs/msg/PoseArray", header=header(world.stamp_ns, world.frame_id), poses=poses)


def marker_array(world: PoseWorld, bodies: Mapping[str, WorldBody]) -> Any:
    """``visualization_msgs/MarkerArray`` with joints coloured by state, bones, velocity and name of each body."""
    where = header(world.stamp_ns, world.frame_id)
    markers = [mark for name, body in bodies.items() for mark in _marks(where, name, body)]
    return new("visualization_msgs/msg/MarkerArray", markers=markers)


def odometry(world: PoseWorld, name: str, body: WorldBody, turn_covariance: np.ndarray) -> Any:
    """``nav_msgs/Odometry`` of a body's root: pose in the world, velocity in its own frame, both with covariance.

    ``turn_covariance`` is (3, 3), of the root's orientation about the world's axes, rad². Angular velocity is not
    estimated; its variance is `UNKNOWN_VARIANCE`.
    """
    turned = Rotation.from_quat(body.root_orientation).as_matrix()
    pose_covariance, twist_covariance = np.eye(6) * UNKNOWN_VARIANCE, np.eye(6) * UNKNOWN_VARIANCE
    pose_covariance[:3, :3], pose_covariance[3:, 3:] = body.covariance[:3, :3], turn_covariance
    twist_covariance[:3, :3] = turned.T @ body.covariance[3:, 3:] @ turned
    pose = _pose(body.root_position, body.root_orientation)
    twist = new("geometry_msgs/msg/Twist", linear=_geometry("Vector3", turned.T @ body.root_velocity))
    return new(
        "nav_msgs/msg/Odometry",
        header=header(world.stamp_ns, world.frame_id),
        child_frame_id=f"body_{name}",
        pose=new("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=pose_covariance.ravel()),
        twist=new("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=twist_covariance.ravel()),
    )


def body_transforms(world: PoseWorld, name: str, links: Links) -> list[Any]:
    """Transforms of one body's links: ``body`` relative to the world, all others relative to ``body`` (REP-155)."""
    root, heading = links["body"]
    origins = np.stack([origin for origin, _ in links.values()])
    turns = np.stack([turn for _, turn in links.values()])
    others = np.array([link != "body" for link in links])
    origins[others] = (origins[others] - root) @ heading
    turns[others] = heading.T @ turns[others]
    quaternions = Rotation.from_matrix(turns).as_quat()
    parents = [world.frame_id if link == "body" else f"body_{name}" for link in links]
    return [
        transform(world.stamp_ns, parent, f"{link}_{name}", origin, quaternion)
        for parent, link, origin, quaternion in zip(parents, links, origins, quaternions, strict=True)
    ]


def transform(stamp_ns: int, parent: str, child: str, place: np.ndarray, quaternion: np.ndarray) -> Any:
    """``geometry_msgs/TransformStamped``."""
    translation, rotation = _geometry("Vector3", place), _geometry("Quaternion", quaternion)
    moved = new("geometry_msgs/msg/Transform", translation=translation, rotation=rotation)
    stamped = header(stamp_ns, parent)
    return new("geometry_msgs/msg/TransformStamped", header=stamped, child_frame_id=child, transform=moved)


def tf_message(transforms: list[Any]) -> Any:
    return new("tf2_msgs/msg/TFMessage", transforms=transforms)


def diagnostic_array(diagnostics: Diagnostics) -> Any:
    """``diagnostic_msgs/DiagnosticArray`` of one status."""
    status = new(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=int(diagnostics.level),
        name=f"steadypose: {diagnostics.node}",
        message=diagnostics.message,
        hardware_id=diagnostics.node,
        values=[new("diagnostic_msgs/msg/KeyValue", key=key, value=value) for key, value in diagnostics.values.items()],
    )
    return new("diagnostic_msgs/msg/DiagnosticArray", header=header(diagnostics.stamp_ns, ""), status=[status])


def _geometry(kind: str, values: Iterable[float]) -> Any:
    """A message of geometry_msgs with the fields x, y, z and, of a quaternion, w."""
    return new(f"geometry_msgs/msg/{kind}", **dict(zip("xyzw", map(float, values), strict=False)))


def _pose(place: np.ndarray, quaternion: np.ndarray) -> Any:
    position, orientation = _geometry("Point", place), _geometry("Quaternion", quaternion)
    return new("geometry_msgs/msg/Pose", position=position, orientation=orientation)


def _marks(where: Any, name: str, body: WorldBody) -> list[Any]:
    points = [_geometry("Point", place) for place in body.positions]
    colours = [COLOURS[int(state)] for state in body.state]
    life = new("builtin_interfaces/msg/Duration", nanosec=round(MARKER_LIFE_S * 1e9))

    def mark(kind: int, part: str, scale: tuple[float, float, float], **more: Any) -> Any:
        return new(
            "visualization_msgs/msg/Marker",
            header=where,
            ns=f"{name}/{part}",
            type=kind,
            scale=_geometry("Vector3", scale),
            lifetime=life,
            **{"pose": _pose(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))} | more,
        )

    above = body.positions[J["head"]] + [0.0, 0.0, 3 * TEXT_SIZE]
    arrow = [_geometry("Point", end) for end in (body.root_position, body.root_position + body.root_velocity)]
    return [
        mark(SPHERE_LIST, "joints", (JOINT_SIZE, JOINT_SIZE, JOINT_SIZE), points=points, colors=colours),
        mark(
            LINE_LIST, "bones", (BONE_WIDTH, 0.0, 0.0), points=[points[joint] for joint in ALL_BONES.ravel()],
            colors=[colours[child] for child in ALL_BONES[:, 1].repeat(2)],
        ),
        mark(ARROW, "velocity", (BONE_WIDTH, 2 * BONE_WIDTH, 0.0), points=arrow, color=_colour(1.0, 1.0, 1.0, 0.8)),
        mark(
            TEXT_VIEW_FACING, "name", (0.0, 0.0, TEXT_SIZE), color=_colour(1.0, 1.0, 1.0),
            text=name if body.tracking == Tracking.OK else f"{name}, {body.tracking.name.lower()}",
            pose=_pose(above, np.array([0.0, 0.0, 0.0, 1.0])),
        ),
    ]  # fmt: skip


def names_of(world: PoseWorld, source: str) -> tuple[dict[str, WorldBody], int]:
    """A message's publishable bodies by ROS name, and the number of tracked bodies that are not finite. ``source`` is
    a part of the names, unless empty."""
    followed = [body for body in world.bodies if body.tracking != Tracking.LOST]
    finite = [
        body
        for body in followed
        if np.isfinite(body.positions).all() and (abs(np.linalg.norm(body.rotations, axis=1) - 1) < 0.1).all()
    ]
    return {body_name(body.id, source): body for body in finite}, len(followed) - len(finite)


MARKERS, POSES, BODIES = "steadypose/markers", "steadypose/poses", "humans/bodies"
OWN_TOPICS = {PoseRaw: "pose_raw", PoseClean: "pose_clean", PoseWorld: "pose_world", PoseEvents: "pose_events"}
GROWN = 0.02  # change of a link's mean length at which the body's URDF is published again, metres
MEAN_OF = 300
"""Number of frames over which links' lengths are averaged. Single frames' lengths differ by centimetres."""
OF_BODY = ("joint_states", "odom", "urdf")  # topics of each body


class Output(Protocol):
    """The receiver of serialised messages."""

    def send(self, topic: str, kind: str, cdr: bytes, *, latched: bool = False) -> None: ...

    def drop(self, topic: str) -> None: ...


class BodyTopics:
    """Sends steadypose's messages to ROS topics of ``output``, with the frame ``world_frame`` for the world.

    ``sensor_tf`` says whether to send the pose of a calibrated sensor; ``several``, whether there are several sources,
    each with ids of its own: names of bodies then contain the source.
    """

    def __init__(self, output: Output, world_frame: str, *, sensor_tf: bool = True, several: bool = False) -> None:
        self._output, self._world_frame = output, world_frame
        self._sensor_tf, self._several = sensor_tf, several
        self._root_covariance = RootCovariance()
        self._names: dict[str, list[str]] = {}  # of the bodies of each source's newest message
        self._means: dict[str, tuple[int, dict[str, np.ndarray]]] = {}  # number of frames, and mean measures
        self._measured: dict[str, dict[str, np.ndarray]] = {}  # as published
        self._still: dict[str, Pose] = {}
        self._moving: set[str] = set()

    def send(self, message: Message) -> int:
        """Send a message. Returns the number of its bodies that were not sent because their pose is not finite."""
        if isinstance(message, Diagnostics):
            self._send("diagnostics", diagnostic_array(message))
            return 0
        if isinstance(message, PoseEvents | PoseWorld):
            message = dataclasses.replace(message, frame_id=self._world_frame)
        topic = OWN_TOPICS[type(message)]
        self._output.send(f"steadypose/{topic}", wire_type(type(message)), encode(message))
        if isinstance(message, PoseClean):
            self._send_sensor(message)
        return self._send_world(message) if isinstance(message, PoseWorld) else 0

    def send_clock(self, stamp_ns: int) -> None:
        self._send("clock", new("rosgraph_msgs/msg/Clock", clock=header(max(stamp_ns, 0), "").stamp))

    def forget(self, source: str) -> None:
        """Remove the bodies of a source, which has fallen silent."""
        self._drop(self._names.pop(source, ()))

    def _drop(self, names: Iterable[str]) -> None:
        for gone in names:
            self._means.pop(gone, None)
            self._measured.pop(gone, None)
            for topic in OF_BODY:
                self._output.drop(f"{BODIES}/{gone}/{topic}")

    def _send_world(self, world: PoseWorld) -> int:
        where = header(world.stamp_ns, world.frame_id)
        bodies, refused = names_of(world, world.source if self._several else "")
        self._drop(set(self._names.get(world.source, ())) - bodies.keys())
        self._names[world.source] = list(bodies)
        tracked = [name for names in self._names.values() for name in names]
        self._send(f"{BODIES}/tracked", new("hri_msgs/msg/IdsList", header=where, ids=tracked))
        self._send(MARKERS, marker_array(world, bodies))
        self._send(POSES, pose_array(world, bodies))
        transforms: list[Any] = []
        for name, body in bodies.items():
            links = frames(body)
            transforms += body_transforms(world, name, links)
            angles = joint_angles(links)
            joints, position = [f"{joint}_{name}" for joint in angles], np.array(list(angles.values()))
            state = new("sensor_msgs/msg/JointState", header=where, name=joints, position=position)
            self._send(f"{BODIES}/{name}/joint_states", state)
            self._send(f"{BODIES}/{name}/odom", odometry(world, name, body, self._turn_covariance(body)))
            self._send_urdf(name, measures(body))
        if transforms:
            self._send("tf", tf_message(transforms))
        return refused

    def _turn_covariance(self, body: WorldBody) -> np.ndarray:
        """(3, 3) covariance of the root's orientation, rad²."""
        positions, sigma = body.positions.astype(np.float64), body.sigma.astype(np.float64)
        return self._root_covariance(positions[None], sigma[None], rotation_matrix(body.root_orientation)[None])[0]

    def _send_urdf(self, name: str, measured: dict[str, np.ndarray]) -> None:
        frames, mean = self._means.get(name, (0, measured))
        frames = min(frames + 1, MEAN_OF)
        mean = {link: at + (measured[link] - at) / frames for link, at in mean.items()}
        self._means[name] = frames, mean
        last = self._measured.get(name)
        if last is None or max(np.abs(mean[link] - at).max() for link, at in last.items()) > GROWN:
            self._measured[name] = mean
            self._send(f"{BODIES}/{name}/urdf", new("std_msgs/msg/String", data=urdf(name, mean)), latched=True)

    def _send_sensor(self, clean: PoseClean) -> None:
        """Publish a sensor's pose: of a static sensor once on /tf_static, of a moving one on /tf with each message.

        A late subscriber receives only the last message of /tf_static, so each has all static sensors.
        """
        frame, pose, world = clean.frame_id, clean.sensor_pose, self._world_frame
        if not self._sensor_tf or not clean.calibrated or frame in ("", world):
            return

        def placed(frame: str, pose: Pose) -> Any:
            return transform(clean.stamp_ns, world, frame, pose.position, pose.orientation)

        if frame not in self._moving:
            if self._still.get(frame) == pose:
                return
            if frame in self._still:
                self._moving.add(frame)
                del self._still[frame]
            else:
                self._still[frame] = pose
            still = tf_message([placed(*sensor) for sensor in self._still.items()])
            self._send("tf_static", still, latched=True)
        if frame in self._moving:
            self._send("tf", tf_message([placed(frame, pose)]))

    def _send(self, topic: str, message: Any, *, latched: bool = False) -> None:
        self._output.send(topic, message.__msgtype__, serialise(message), latched=latched)
