from itertools import pairwise

import cv2
import numpy as np
import pytest
from tests.helpers.bodies import fk

from steadypose.benchmarks.depth_camera import Stereo, corrupt, render, room
from steadypose.prior.body.layouts import COCO17
from steadypose.prior.body.skeleton import REST_OFFSETS
from steadypose.prior.camera.depth_lifting import MIN_CONFIDENCE, lift

CAMERA = Stereo()
K = {name: index for index, name in enumerate(COCO17.joints)}
WALL = 4500
BODY = 3000
# A person who faces the camera, metres right and down of the middle of the hips.
FIGURE = {
    "shoulder": (0.18, -0.51), "elbow": (0.30, -0.25), "wrist": (0.35, 0.0), "hip": (0.088, 0.0),
    "knee": (0.10, 0.41), "ankle": (0.10, 0.70), "ear": (0.07, -0.70), "eye": (0.03, -0.72),
}  # fmt: skip


def keypoints(distance: float = BODY / 1000) -> np.ndarray:
    """(17, 2) pixels of the figure; its left is on the image's right."""
    points = np.zeros((17, 3))
    points[:, 2] = distance
    points[K["nose"], :2] = 0.0, -0.70
    for joint, (right, down) in FIGURE.items():
        points[K[f"left_{joint}"], :2] = right, down
        points[K[f"right_{joint}"], :2] = -right, down
    return CAMERA.project(points)


def flat_person(pixels: np.ndarray) -> np.ndarray:
    """(H, W) millimetres: limbs and trunk cut from card, in front of a wall."""
    depth = np.full((CAMERA.height, CAMERA.width), WALL, np.uint16)
    whole = np.rint(pixels).astype(int)
    trunk = whole[[K["left_shoulder"], K["right_hip"]]]
    (x0, y0), (x1, y1) = trunk.min(axis=0) - 6, trunk.max(axis=0) + [6, 10]
    depth[y0 : y1 + 1, x0 : x1 + 1] = BODY
    for side in ("left", "right"):
        for chain in (("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle"), ("ear", "eye")):
            for start, end in pairwise(chain):
                a, b = whole[K[f"{side}_{start}"]].tolist(), whole[K[f"{side}_{end}"]].tolist()
                cv2.line(depth, a, b, BODY, thickness=13)
    return depth


def lifted(depth: np.ndarray, pixels: np.ndarray, confidence: np.ndarray | None = None) -> np.ndarray:
    confidence = np.full(17, 0.9) if confidence is None else confidence
    positions, _ = lift(pixels[None], confidence[None], depth, CAMERA.intrinsics)
    return positions[0]


def test_joints_lie_behind_the_skin_on_their_rays() -> None:
    pixels = keypoints()
    positions = lifted(flat_person(pixels), pixels)
    np.testing.assert_allclose(CAMERA.project(positions.astype(float)), pixels, atol=0.01)
    depth = positions[:, 2]
    for joint, thickness in {"wrist": 0.04, "elbow": 0.045, "knee": 0.065, "shoulder": 0.07, "hip": 0.12}.items():
        for side in ("left", "right"):
            assert depth[K[f"{side}_{joint}"]] == pytest.approx(BODY / 1000 + thickness, abs=0.01), (side, joint)


@pytest.mark.parametrize("joint", ["left_wrist", "right_elbow", "left_ankle"])
def test_a_key_point_at_the_edge_of_a_limb_does_not_fall_on_the_wall(joint: str) -> None:
    pixels = keypoints()
    depth = flat_person(pixels)
    while depth[tuple(np.rint(pixels[K[joint]]).astype(int)[::-1])] == BODY:
        pixels[K[joint], 0] += 0.5 if joint.startswith("left") else -0.5
    assert lifted(depth, pixels)[K[joint], 2] < BODY / 1000 + 0.06


def test_a_key_point_beside_the_body_is_unobserved() -> None:
    pixels = keypoints()
    depth = flat_person(pixels)
    pixels[K["left_wrist"], 0] += 30
    positions = lifted(depth, pixels)
    assert np.isnan(positions[K["left_wrist"]]).all()
    assert np.isfinite(np.delete(positions, K["left_wrist"], axis=0)).all()


def test_a_joint_in_a_hole_is_unobserved_and_the_chain_goes_on() -> None:
    pixels = keypoints()
    depth = flat_person(pixels)
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width]
    cx, cy = pixels[K["right_elbow"]]
    depth[np.hypot(x - cx, y - cy) <= 12] = 0
    positions = lifted(depth, pixels)
    assert np.isnan(positions[K["right_elbow"]]).all()
    assert positions[K["right_wrist"], 2] == pytest.approx(BODY / 1000 + 0.04, abs=0.01)


def test_what_the_detector_doubts_or_places_outside_is_unobserved() -> None:
    pixels = keypoints()
    depth = flat_person(pixels)
    confidence = np.full(17, 0.9)
    confidence[K["left_knee"]] = MIN_CONFIDENCE - 0.01
    confidence[K["right_knee"]] = np.nan
    pixels[K["left_ankle"]] = np.nan
    pixels[K["right_ankle"]] = 1e9, -1e9
    positions, sure = lift(pixels[None], confidence[None], depth, CAMERA.intrinsics)
    gone = [K[f"{side}_{joint}"] for side in ("left", "right") for joint in ("knee", "ankle")]
    assert np.isnan(positions[0, gone]).all()
    assert (sure[0, gone] == 0).all()
    assert (np.delete(sure[0], gone) == np.float32(0.9)).all()


@pytest.mark.parametrize(("shapes", "expected"), [
    (((17, 2), (17,), (4, 4), (3, 3)), r"\(B, 17, 2\)"),
    (((1, 17, 2), (17,), (4, 4), (3, 3)), r"\(B, 17, 2\)"),
    (((1, 17, 2), (1, 17), (4, 4, 1), (3, 3)), r"\(H, W\)"),
    (((1, 17, 2), (1, 17), (4, 4), (4,)), r"\(3, 3\)"),
    (((1, 17, 2), (1, 17), (0, 4), (3, 3)), r"of a pixel or more, .* got \(0, 4\)"),
])  # fmt: skip
def test_shapes_that_do_not_fit_say_so(shapes: tuple[tuple[int, ...], ...], expected: str) -> None:
    keypoints, confidence, depth, intrinsics = (np.ones(shape) for shape in shapes)
    with pytest.raises(ValueError, match=expected):
        lift(keypoints, confidence, depth, intrinsics)


@pytest.mark.filterwarnings("error")
def test_whatever_a_broken_detector_or_camera_says_is_lifted_or_not_given() -> None:
    rng = np.random.default_rng(0)

    def wild(*shape: int) -> np.ndarray:
        return rng.choice([np.nan, np.inf, -np.inf, 1e30, -1.0, 0.0, 0.5, 3.0, 200.0], shape)

    for depth in (wild(4, 6), wild(400, 640), rng.integers(0, 65536, (400, 640)).astype(np.uint16), np.ones((1, 1))):
        positions, confidence = lift(wild(3, 17, 2), wild(3, 17), depth, CAMERA.intrinsics)
        given = np.isfinite(positions).all(axis=-1)
        assert ((confidence >= 0) & (confidence <= 1)).all()
        np.testing.assert_array_equal(confidence > 0, given)


def standing(yaw: float) -> np.ndarray:
    """(22, 3) metres, optical frame: a person 3 m away with arms down, turned by ``yaw`` from facing the camera."""
    offsets = REST_OFFSETS.copy()
    for left, right in ((18, 19), (20, 21)):
        offsets[left] = 0.03, 0.01, -0.26
        offsets[right] = 0.03, -0.01, -0.26
    forward, left, up = fk(np.tile(np.eye(3), (22, 1, 1)), offsets).T
    c, s = np.cos(yaw), np.sin(yaw)
    # facing the camera, forward is -z and the left side is on the right of the image
    return np.stack([c * left - s * forward, -up, 3.0 - (c * forward + s * left)], axis=-1)


@pytest.mark.parametrize("degrees", [0, 40, 75, 90, -75, 180])
def test_the_root_holds_however_the_body_is_turned(degrees: int) -> None:
    joints = standing(np.radians(degrees))
    clean = render([(joints, REST_OFFSETS)], CAMERA, room(CAMERA, 1.2, 5.0))
    depth = corrupt(clean, CAMERA, np.random.default_rng(degrees % 360))
    weights = COCO17.to_canonical
    truth = np.full((17, 3), np.nan)
    for canonical, row in enumerate(weights):
        if (row > 0).sum() == 1:
            truth[row > 0] = joints[canonical]
    known = np.isfinite(truth[:, 0])
    near = truth[:, 2] < 3.0 + 0.05
    confidence = np.where(known, np.where(near, 0.9, 0.7), 0.0)
    positions = lifted(
        depth, np.where(known[:, None], CAMERA.project(np.where(known[:, None], truth, 1.0)), 0), confidence
    )
    hips = [K["left_hip"], K["right_hip"]]
    # seen from the side, an arm hangs before the hips
    side = abs(np.cos(np.radians(degrees))) < 0.5
    assert np.linalg.norm(positions[hips].mean(axis=0) - truth[hips].mean(axis=0)) < (0.08 if side else 0.04)
    np.testing.assert_allclose(positions[hips], truth[hips], atol=0.09 if side else 0.05)
    error = np.linalg.norm(positions - truth, axis=-1)
    assert np.nanmax(error[near & known]) < 0.12
