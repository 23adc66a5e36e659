"""Adapters that convert the output of other trackers to ``pose/raw``, one function ``from_...`` for each.

They do not import the trackers' packages: any object with the right attributes works. Each function documents which
axis of its frame points up. For a calibrated camera, set ``sensor_pose`` and ``calibrated`` of the result.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.types import Pose, PoseRaw, RawBody
from steadypose.nodes.ros2.definitions import stamp_ns as stamp_of
from steadypose.prior.arrays import Floats
from steadypose.prior.body.layouts import AZURE_KINECT32, BLAZEPOSE33, COCO17, ZED38, Skeleton
from steadypose.prior.body.skeleton import finite_joints

ZED_BODY_38 = 2  # value of ``body_format`` in ZED's ROS message for the skeleton of 38 key points
AZURE_IDS = 100  # factor of the body in the driver's marker ids: id = body · 100 + joint
MIN_POINTS = 6  # smallest number of image landmarks that determine a body's position


def from_mediapipe(
    result: Any, stamp_ns: int, image_size: tuple[int, int], intrinsics: Floats, source: str = "mediapipe"
) -> PoseRaw:
    """Convert the result of MediaPipe's pose landmarker, a ``PoseLandmarkerResult``.

    World landmarks are relative to the middle of the hips. The body is placed so that they project onto the image's
    landmarks.

    Args:
        result: its ``pose_world_landmarks`` and ``pose_landmarks`` are read.
        stamp_ns: capture time, nanoseconds.
        image_size: width and height in pixels.
        intrinsics: (3, 3) of the camera. For an uncalibrated camera, a guess (`pinhole`) affects only the distance.
        source: the camera's name.

    Returns:
        Bodies in the optical frame (x right, y down, z forward) of a camera assumed to be level, without those of which
        too few landmarks are observed.
    """
    bodies = []
    for number, (world, image) in enumerate(zip(result.pose_world_landmarks, result.pose_landmarks, strict=True)):
        joints = _table(BLAZEPOSE33, [(p.x, p.y, p.z) for p in world], "pose_world_landmarks")
        pixels = np.array([(p.x, p.y) for p in image], np.float64) * image_size
        confidence = np.array([p.visibility for p in world], np.float64)
        place = _placed(joints, pixels, confidence, np.asarray(intrinsics, np.float64))
        if place is not None:
            bodies.append(RawBody(number, joints + place, np.clip(confidence, 0.0, 1.0)))
    return _message(stamp_ns, "camera_optical_frame", source, BLAZEPOSE33, "-y", bodies)


def from_zed(message: Any, source: str = "zed") -> PoseRaw:
    """Convert ``ObjectsStamped`` of the ZED ROS 2 wrapper (``body_trk/skeletons``), in its frame, whose z points up.

    Set ``body_format: BODY_38`` in the wrapper's configuration: other skeletons raise ValueError.
    """
    bodies = []
    for person in message.objects:
        if not person.skeleton_available:
            continue
        if person.body_format != ZED_BODY_38:
            got = f"got {person.body_format}; set body_tracking.body_format to BODY_38"
            raise ValueError(f"ZED body_format: expected {ZED_BODY_38} (38 key points), {got}")
        points = [point.kp for point in person.skeleton_3d.keypoints][: len(ZED38.joints)]
        joints = _table(ZED38, points, "skeleton_3d.keypoints")
        # ZED gives one confidence per body, 1 to 99
        confidence = finite_joints(joints) * np.clip(person.confidence / 100, 0.0, 1.0)
        bodies.append(RawBody(person.label_id, joints, confidence))
    return _message(stamp_of(message.header), message.header.frame_id, source, ZED38, "z", bodies)


def from_azure_kinect(markers: Any, source: str = "azure_kinect") -> PoseRaw | None:
    """Convert ``MarkerArray`` of the Azure Kinect ROS driver (``body_tracking_data``), in the depth camera's optical
    frame.

    Returns None for an array without markers, because it has no stamp either.
    """
    found: dict[int, Floats] = {}
    for marker in markers.markers:
        body, joint = divmod(marker.id, AZURE_IDS)
        if joint >= len(AZURE_KINECT32.joints):
            raise ValueError(f"Azure Kinect marker id: expected body * 100 + joint, got {marker.id}")
        at = marker.pose.position
        found.setdefault(body, np.full((len(AZURE_KINECT32.joints), 3), np.nan))[joint] = at.x, at.y, at.z
    if not found:
        return None
    bodies = [RawBody(id, joints, finite_joints(joints)) for id, joints in found.items()]
    header = markers.markers[0].header
    return _message(stamp_of(header), header.frame_id, source, AZURE_KINECT32, "-y", bodies)


def from_pose_array(poses: Any, skeleton: Skeleton, up: str, source: str = "pose_array") -> PoseRaw:
    """Convert ``geometry_msgs/PoseArray`` with the joints of one body after another, NaN where a joint is missing.

    Args:
        poses: the message, such as the bridge's own ``steadypose/poses``. Only positions are read.
        skeleton: its joint layout.
        up: the axis of its frame that points up: ``z``, ``y`` or ``-y``.
        source: the tracker's name.

    Raises:
        ValueError: the number of poses is not a multiple of the layout's joints.
    """
    joints = len(skeleton.joints)
    points = np.array([(p.position.x, p.position.y, p.position.z) for p in poses.poses], np.float64).reshape(-1, 3)
    if len(points) % joints:
        raise ValueError(f"PoseArray: expected a multiple of the {joints} joints of {skeleton.name}, got {len(points)}")
    bodies = [RawBody(id, body, finite_joints(body)) for id, body in enumerate(points.reshape(-1, joints, 3))]
    return _message(stamp_of(poses.header), poses.header.frame_id, source, skeleton, up, bodies)


def from_coco(
    detections: Sequence[Mapping[str, Any]],
    depth: NDArray[Any],
    intrinsics: Floats,
    stamp_ns: int,
    source: str = "coco",
) -> PoseRaw:
    """Convert COCO key points and a depth image of the same time.

    Args:
        detections: each with ``keypoints``, 17 times x, y in pixels of the depth image and a confidence from 0 to 1.
        depth: (H, W) metres if floating, millimetres if integer, aligned to the image of the key points.
        intrinsics: (3, 3) of that image, which must be undistorted.
        stamp_ns: capture time, nanoseconds.
        source: the camera's name.

    Returns:
        Bodies in the optical frame of a camera assumed to be level.
    """
    from steadypose.prior.camera.depth_lifting import lift  # imported late, because importing it compiles a loop

    joints = len(COCO17.joints)
    points = np.array([detection["keypoints"] for detection in detections], np.float64)
    if points.size != len(detections) * joints * 3:
        raise ValueError(f"keypoints: expected {joints} times x, y, confidence, got an array of shape {points.shape}")
    points = points.reshape(len(detections), joints, 3)
    lifted = zip(*lift(points[..., :2], points[..., 2], depth, intrinsics), strict=True)
    bodies = [RawBody(number, *body) for number, body in enumerate(lifted)]
    return _message(stamp_ns, "camera_optical_frame", source, COCO17, "-y", bodies)


def pinhole(image_size: tuple[int, int], field_of_view: float) -> Floats:
    """(3, 3) intrinsics of a camera of which only the horizontal field of view is known, radians."""
    width, height = image_size
    focal = width / 2 / math.tan(field_of_view / 2)
    return np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])


def _placed(joints: Floats, pixels: Floats, confidence: Floats, intrinsics: Floats) -> Floats | None:
    """(3,) translation t of joints (J, 3) that projects them onto pixels (J, 2), by linear least squares.

    A joint at p + t projects to (u, v, 1) · depth: x + tx = u (z + tz), y + ty = v (z + tz). None if undetermined.
    """
    seen = (confidence > 0.5) & finite_joints(joints) & finite_joints(pixels)
    if seen.sum() < MIN_POINTS:
        return None
    rays = np.concatenate([pixels[seen], np.ones((int(seen.sum()), 1))], axis=1) @ np.linalg.inv(intrinsics).T
    x, y, z = joints[seen].T
    u, v = rays[:, 0], rays[:, 1]
    one, none = np.ones_like(u), np.zeros_like(u)
    equations = np.concatenate([np.stack([one, none, -u], axis=1), np.stack([none, one, -v], axis=1)])
    place, *_ = np.linalg.lstsq(equations, np.concatenate([u * z - x, v * z - y]), rcond=None)
    return np.asarray(place, np.float64) if place[2] > 0 else None


def _table(skeleton: Skeleton, points: Sequence[Any], name: str) -> Floats:
    """(J, 3) array of points, checked against the skeleton's number of joints."""
    table = np.array(points, np.float64)
    if table.shape != (len(skeleton.joints), 3):
        raise ValueError(f"{name}: expected {len(skeleton.joints)} points of 3 numbers, got shape {table.shape}")
    return table


def _message(stamp_ns: int, frame_id: str, source: str, skeleton: Skeleton, up: str, bodies: list[RawBody]) -> PoseRaw:
    return PoseRaw(stamp_ns, frame_id, source, skeleton.name, Pose.from_up(up), False, bodies)
