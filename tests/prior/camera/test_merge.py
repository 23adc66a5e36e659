"""Several cameras as one, and what can go wrong with them."""

import dataclasses

import numpy as np
import pytest
from tests.helpers.bodies import waving

from steadypose.msgs.types import Pose, PoseRaw, RawBody
from steadypose.prior.camera.multi_view import DEPTH_ERROR_RATIO, PERIOD_NS, CameraBody, Merge, merge_joints

BODY = waving(60)


def seen(
    camera: str, stamp_ns: int, *bodies: np.ndarray, eye: tuple[float, float, float] = (0, 0, 1), **more: object
) -> PoseRaw:
    """What a camera at ``eye`` that looks along the world's axes sees."""
    place = np.array(eye, np.float64)
    raws = [RawBody(k, body - place, np.ones(22)) for k, body in enumerate(bodies)]
    message = PoseRaw(stamp_ns, "camera", camera, "smpl22", Pose(place, np.array([0, 0, 0, 1.0])), True, raws)
    return dataclasses.replace(message, **more)


def play(messages: list[PoseRaw]) -> tuple[list[PoseRaw], Merge]:
    merge = Merge()
    return [merged for m in sorted(messages, key=lambda m: m.stamp_ns) for merged in merge.update(m)], merge


def test_bodies_are_interpolated_to_the_moment() -> None:
    """Somebody who slides along at 1 m/s, filmed by two cameras out of step, in different orders."""
    messages = []
    for k in range(30):
        for camera, offset_ns, flip in (("a", 3_000_000, 1), ("b", 19_000_000, -1)):
            stamp = k * 35_000_000 + offset_ns
            bodies = [BODY[0] + [stamp * 1e-9, 0.0, 0.0], BODY[0] + [0.0, 1.5 + stamp * 1e-9, 0.0]][::flip]
            messages.append(seen(camera, stamp, *bodies))
    merged, _ = play(messages)
    assert len(merged) > 25
    for m in merged[1:]:
        x = sorted(float(body.positions[0, 0] - BODY[0, 0, 0]) for body in m.bodies)
        assert x == pytest.approx([0.0, m.stamp_ns * 1e-9], abs=1e-5)


def test_a_camera_errs_along_its_line_of_sight() -> None:
    """Two cameras at right angles: each is believed across its own line of sight."""
    truth = np.tile([2.0, 2.0, 1.0], (22, 1))
    along_x = CameraBody(truth + [0.1, 0.0, 0.0], np.ones(22), np.array([0.0, 2.0, 1.0]))
    along_y = CameraBody(truth + [0.0, 0.1, 0.0], np.ones(22), np.array([2.0, 0.0, 1.0]))
    joints, confidence = merge_joints([along_x, along_y])
    share = DEPTH_ERROR_RATIO**-2 / (1 + DEPTH_ERROR_RATIO**-2)
    assert joints - truth == pytest.approx(np.tile([0.1 * share, 0.1 * share, 0.0], (22, 1)), abs=1e-3)
    assert (confidence == 1.0).all()


def test_confidence_and_distance_weigh_and_what_is_apart_is_not_averaged() -> None:
    place = np.tile([3.0, 0.0, 1.0], (22, 1))
    eyes = np.array([0.0, 0.0, 1.0]), np.array([6.0, 0.0, 1.0])
    sure = CameraBody(place, np.full(22, 0.9), eyes[0])
    unsure = CameraBody(place + [0.0, 0.1, 0.0], np.full(22, 0.3), eyes[1])
    joints, confidence = merge_joints([sure, unsure])
    assert joints[0, 1] == pytest.approx(0.1 * 0.3**2 / (0.9**2 + 0.3**2), rel=1e-2)
    assert confidence[0] == pytest.approx(1.0 - 0.1 * 0.7)
    near = dataclasses.replace(unsure, confidence=sure.confidence, eye=np.array([4.5, 0.0, 1.0]))
    assert merge_joints([sure, near])[0][0, 1] == pytest.approx(0.1 * 4 / 5, rel=1e-2), "at half the distance"
    far = dataclasses.replace(unsure, joints=place + [0.0, 0.5, 0.0])
    joints, confidence = merge_joints([sure, far])
    assert joints == pytest.approx(place)
    assert confidence == pytest.approx(np.full(22, 0.9))
    blind = dataclasses.replace(unsure, joints=np.full((22, 3), np.nan), confidence=np.zeros(22))
    assert merge_joints([sure, blind])[0] == pytest.approx(place)
    assert np.isnan(merge_joints([blind, blind])[0]).all()


def test_two_people_stay_two_and_each_is_one() -> None:
    near = [BODY[0], BODY[0] + [0.6, 0.0, 0.0]]
    rng = np.random.default_rng(0)
    messages = []
    for k in range(10):
        noisy = [body + rng.normal(0.0, 0.03, (22, 3)) for body in near]
        messages += [seen("a", k * PERIOD_NS, *noisy), seen("b", k * PERIOD_NS + 1, *noisy[::-1], eye=(4, 0, 1))]
    merged, _ = play(messages)
    assert [len(m.bodies) for m in merged[2:]] == [2] * len(merged[2:])


def test_a_camera_that_goes_is_waited_for_a_moment_only() -> None:
    messages = [seen("a", k * PERIOD_NS, BODY[k]) for k in range(40)]
    messages += [seen("b", k * PERIOD_NS + 1000, BODY[k]) for k in range(20)]
    merged, _ = play(messages)
    assert [m.stamp_ns for m in merged][-1] == 39 * PERIOD_NS
    assert len(merged) >= 39


def test_what_cannot_be_used_is_counted_by_camera() -> None:
    good = [seen("a", k * PERIOD_NS, BODY[k]) for k in range(5)]
    bad = [
        seen("b", 1, BODY[0], calibrated=False), seen("b", 2, BODY[0], skeleton="octopus"),
        seen("b", 3, BODY[0], sensor_pose=Pose(np.zeros(3), np.zeros(4))),
        seen("b", 4, skeleton="coco17", bodies=[RawBody(0, BODY[0], np.ones(22))]), seen("a", 4 * PERIOD_NS, BODY[0]),
        seen("c", 5 * PERIOD_NS, np.full((22, 3), np.inf), np.full((22, 3), 1e30), *[BODY[0]] * 200),
    ]  # fmt: skip
    merged, merge = play([*good, *bad])
    assert merged
    assert {cause: n for cause, n in merge.counters.items() if n} == {
        "not calibrated, b": 2, "unknown skeleton, b": 1, "wrong joint count, b": 1, "late or repeated, a": 1,
    }  # fmt: skip


def test_cameras_whose_clocks_were_set_back_start_anew() -> None:
    merge = Merge()
    ahead = 3_600_000_000_000
    for k in range(5):
        merge.update(seen("a", ahead + k * PERIOD_NS, BODY[k]))
    merged = [m for k in range(60) for m in merge.update(seen("a", k * PERIOD_NS, BODY[k % 60]))]
    assert merged[-1].stamp_ns == 59 * PERIOD_NS
