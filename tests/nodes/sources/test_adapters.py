import re
from pathlib import Path
from types import SimpleNamespace as Made
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.helpers.fake_oak import CAMERA, moment
from tests.helpers.processes import another_python
from tests.helpers.synthetic_poses import sensor_joints, walker

from steadypose.msgs.codec import decode, encode
from steadypose.msgs.topics import POSE_RAW
from steadypose.msgs.transport import Subscriber
from steadypose.msgs.types import PoseRaw
from steadypose.nodes.commands.output import clean_recording
from steadypose.nodes.sources.adapters import from_azure_kinect, from_coco, from_mediapipe, from_zed, pinhole
from steadypose.nodes.sources.recording import CsvSource
from steadypose.prior.body.layouts import AZURE_KINECT32, BLAZEPOSE33, COCO17, SKELETONS, ZED38, Skeleton, to_canonical
from steadypose.prior.body.skeleton import J

STAMP_NS = 1_700_000_000_123_456_789
STAMP = Made(sec=1_700_000_000, nanosec=123_456_789)
HEADER = Made(stamp=STAMP, frame_id="their_frame")
TO_OPTICAL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def standing(skeleton: Skeleton) -> np.ndarray:
    """(J, 3) metres of a person 3 m ahead of a camera at 1.2 m, in its optical frame."""
    joints, _, _ = walker(0.3)
    joints = joints - [*joints[0, :2], 0.0] + [3.0, 0.2, -1.2]
    return sensor_joints(skeleton, joints @ TO_OPTICAL.T)


def upright(frame: PoseRaw) -> None:
    """The head is over the pelvis, and the pelvis over the feet, in the world as the message has it."""
    joints, _ = to_canonical(SKELETONS[frame.skeleton], frame.bodies[0].positions)
    heights = Rotation.from_quat(frame.sensor_pose.orientation).apply(np.nan_to_num(joints))[:, 2]
    assert heights[J["neck"]] > heights[J["pelvis"]] + 0.3 > heights[J["left_ankle"]] + 0.6


def travels(frame: PoseRaw) -> None:
    assert decode(POSE_RAW, encode(frame)) == frame


def landmarker_result(*bodies: np.ndarray) -> Made:
    """As MediaPipe gives it: landmarks about the middle of the hips, and where they lie in an image of 640 x 400."""
    world, image = [], []
    for joints in bodies:
        hips = (joints[23] + joints[24]) / 2
        world.append([Made(x=x, y=y, z=z, visibility=0.9, presence=0.9) for x, y, z in joints - hips])
        pixels = CAMERA.project(joints) / [CAMERA.width, CAMERA.height]
        image.append([Made(x=x, y=y, z=0.0, visibility=0.9, presence=0.9) for x, y in pixels])
    return Made(pose_world_landmarks=world, pose_landmarks=image)


def test_mediapipe_bodies_stand_where_the_image_shows_them() -> None:
    first = standing(BLAZEPOSE33)
    second = first + [0.8, 0.0, 1.0]
    size = (CAMERA.width, CAMERA.height)
    frame = from_mediapipe(landmarker_result(first, second), STAMP_NS, size, CAMERA.intrinsics)
    assert (frame.stamp_ns, frame.skeleton, len(frame.bodies)) == (STAMP_NS, "blazepose33", 2)
    np.testing.assert_allclose(frame.bodies[0].positions, first, atol=1e-4)
    np.testing.assert_allclose(frame.bodies[1].positions, second, atol=1e-4)
    np.testing.assert_allclose(frame.bodies[0].confidence, 0.9)
    upright(frame)
    travels(frame)


def test_a_mediapipe_body_that_is_hardly_seen_is_left_out_and_points_that_are_too_few_say_so() -> None:
    def taken(result: Made) -> PoseRaw:
        return from_mediapipe(result, STAMP_NS, (640, 400), CAMERA.intrinsics)

    result = landmarker_result(standing(BLAZEPOSE33), standing(BLAZEPOSE33) + [1.0, 0.0, 0.0])
    for point in result.pose_world_landmarks[0][3:]:
        point.visibility = 0.1
    assert [body.id for body in taken(result).bodies] == [1]
    assert taken(Made(pose_world_landmarks=[], pose_landmarks=[])).bodies == []
    del result.pose_world_landmarks[1][20:]
    with pytest.raises(ValueError, match=r"pose_world_landmarks: expected 33 points of 3 numbers, got shape \(20, 3\)"):
        taken(result)


def test_a_guessed_camera_has_the_view_it_was_told() -> None:
    intrinsics = pinhole((640, 480), np.radians(60))
    edge = np.linalg.inv(intrinsics) @ [640.0, 240.0, 1.0]
    assert np.degrees(np.arctan2(edge[0], edge[2])) == pytest.approx(30)


def zed_body(joints: np.ndarray, body_format: int = 2, available: bool = True) -> Made:
    points = np.zeros((70, 3), np.float32)
    points[: len(joints)] = joints
    keypoints = [Made(kp=point) for point in points]
    return Made(
        label_id=7, confidence=80.0, skeleton_available=available, body_format=body_format,
        skeleton_3d=Made(keypoints=keypoints),
    )  # fmt: skip


def test_zed_skeletons_keep_ids_stamp_and_frame() -> None:
    joints = standing(ZED38) @ TO_OPTICAL  # ROS: x forward, y left, z up
    joints[5] = np.nan
    frame = from_zed(Made(header=HEADER, objects=[zed_body(joints), zed_body(joints, available=False)]))
    assert (frame.stamp_ns, frame.frame_id, frame.skeleton) == (STAMP_NS, "their_frame", "zed38")
    (body,) = frame.bodies
    assert body.id == 7
    np.testing.assert_allclose(body.positions, joints, atol=1e-6)
    np.testing.assert_allclose(body.confidence, np.where(np.arange(38) == 5, 0.0, 0.8), atol=1e-6)
    upright(frame)
    travels(frame)
    with pytest.raises(ValueError, match=r"expected 2 \(38 key points\), got 1; set .*BODY_38"):
        from_zed(Made(header=HEADER, objects=[zed_body(np.zeros((34, 3)), body_format=1)]))


def azure_marker(id: int, at: np.ndarray) -> Made:
    return Made(header=HEADER, id=id, pose=Made(position=Made(x=at[0], y=at[1], z=at[2])))


def test_azure_kinect_markers_are_told_apart_by_their_ids() -> None:
    joints = standing(AZURE_KINECT32)
    markers = [azure_marker(300 + i, at) for i, at in enumerate(joints)]
    markers += [azure_marker(500 + i, at + [0.0, 0.0, 1.0]) for i, at in enumerate(joints) if i != 8]
    frame: Any = from_azure_kinect(Made(markers=markers[::-1]))
    bodies = {body.id: body for body in frame.bodies}
    assert sorted(bodies) == [3, 5]
    np.testing.assert_allclose(bodies[3].positions, joints, atol=1e-6)
    assert np.isnan(bodies[5].positions[8]).all()
    assert bodies[5].confidence[8] == 0
    assert (frame.stamp_ns, frame.frame_id) == (STAMP_NS, "their_frame")
    upright(frame)
    travels(frame)
    assert from_azure_kinect(Made(markers=[])) is None
    with pytest.raises(ValueError, match=r"expected body \* 100 \+ joint, got 142"):
        from_azure_kinect(Made(markers=[azure_marker(142, np.zeros(3))]))


def test_coco_detections_are_lifted_by_depth() -> None:
    scene = moment(5, people=2)
    detections = []
    for joints in scene.joints:
        pixels = CAMERA.project(joints)
        detections.append({"keypoints": np.column_stack([pixels, np.full(17, 0.9)]).ravel().tolist(), "score": 0.8})
    frame = from_coco(detections, scene.depth, CAMERA.intrinsics, STAMP_NS)
    assert frame.skeleton == COCO17.name
    for body, joints in zip(frame.bodies, scene.joints, strict=True):
        error = np.linalg.norm(body.positions - joints, axis=-1)[5:]
        assert np.nanmedian(error) < 0.04
        assert Rotation.from_quat(frame.sensor_pose.orientation).apply([0.0, -1.0, 0.0])[2] == pytest.approx(1.0)
    travels(frame)
    assert from_coco([], scene.depth, CAMERA.intrinsics, STAMP_NS).bodies == []
    with pytest.raises(ValueError, match="expected 17 times x, y, confidence"):
        from_coco([{"keypoints": [1.0, 2.0, 1.0]}], scene.depth, CAMERA.intrinsics, STAMP_NS)


DOCS = Path(__file__).parents[3] / "docs"
BLOCKS = dict(re.findall(r"(?ms)^<!-- file: (\S+) -->\n```\w+\n(.*?)^```$", (DOCS / "sources.md").read_text()))
SOON_S = 30.0

# the reader's own detector and depth camera
DETECTOR = """
import time
import numpy as np

scene = np.load("scene.npz")

def detect():
    time.sleep(0.01)
    points = np.column_stack([scene["pixels"], np.full(17, 0.9)])
    return [{"keypoints": points.ravel().tolist()}], scene["depth"], scene["intrinsics"], time.time()
"""


def test_the_publisher_publishes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = moment(3)
    pixels = CAMERA.project(scene.joints[0])
    np.savez(tmp_path / "scene.npz", pixels=pixels, depth=scene.depth, intrinsics=CAMERA.intrinsics)
    (tmp_path / "detector.py").write_text(DETECTOR)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    address = f"ipc://{tmp_path}/steadypose/pose_input"
    with Subscriber(address, POSE_RAW) as subscriber, another_python(BLOCKS["publisher.py"], tmp_path):
        received = subscriber.receive(SOON_S)
    assert received
    frame = received[1]
    assert isinstance(frame, PoseRaw)
    assert frame.source == "my camera"
    error = np.linalg.norm(frame.bodies[0].positions - scene.joints[0], axis=-1)[5:]
    assert np.nanmedian(error) < 0.04
    assert len([line for line in BLOCKS["publisher.py"].splitlines() if line.strip()]) <= 12


def test_the_csv_is_read(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text(BLOCKS["reach.csv"])
    source = CsvSource(tmp_path / "x.csv")
    frames = [message for _, message in source if isinstance(message, PoseRaw)]
    assert not source.refused
    assert [frame.stamp_ns for frame in frames] == [0, 33_000_000, 67_000_000, 100_000_000]
    assert frames[0].skeleton == "coco17"
    np.testing.assert_allclose(frames[0].bodies[0].positions[9], [-0.41, 0.12, 2.80], atol=1e-6)
    assert np.isnan(frames[2].bodies[0].positions[9]).all()
    clean_recording(tmp_path / "x.csv", tmp_path / "x.npz", {"prior": {}, "trajectory": {}})
    with np.load(tmp_path / "x.npz") as cleaned:
        assert np.isfinite(cleaned["positions"]).all(), "a body in every row"
