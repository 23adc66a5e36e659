from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steadypose.benchmarks.systems.simulated import FEET, Track, hold_last, measure, read_tracks, sigma_ratio, smooth
from steadypose.msgs.topics import POSE_RAW, POSE_TRUTH
from steadypose.msgs.types import Message, Pose, PoseRaw, PoseWorld, RawBody, Tracking, WorldBody
from steadypose.prior.body.layouts import CANONICAL
from steadypose.prior.body.skeleton import PARENTS, REST_OFFSETS, J

PERIOD_NS = 33_333_333


def standing(frames: int) -> np.ndarray:
    """(T, 22, 3) a body without pose that sways, 1 m up."""
    sway = 0.05 * np.sin(np.arange(frames) / 9.0)
    body = REST_OFFSETS + [0.0, 0.0, 1.0]
    for joint, parent in enumerate(PARENTS[1:], start=1):
        body[joint] = body[parent] + REST_OFFSETS[joint]
    return body + sway[:, None, None] * np.array([0.0, 1.0, 0.0])


def track(seen: np.ndarray, truth: np.ndarray, gap_at: int | None = None) -> Track:
    stamps = np.arange(len(truth)) * PERIOD_NS
    if gap_at is not None:
        stamps[gap_at:] += 2_000_000_000
    contact = np.ones((len(truth), len(FEET)), dtype=bool)
    return Track(0, stamps, seen, truth, contact, CANONICAL.observable, True)


def test_seen_and_hidden_joints_are_told_apart() -> None:
    truth = standing(20)
    seen = truth + [0.0, 0.0, 0.01]
    wrist = J["left_wrist"]
    seen[5:10, wrist] = np.nan
    answer = np.where(np.isnan(seen), truth + [0.1, 0.0, 0.0], seen)
    figures = measure([track(seen, truth)], [answer])
    assert figures["seen_mm"] == pytest.approx(10.0)
    assert figures["hidden_mm"] == pytest.approx(100.0)
    assert figures["all_mm"] == pytest.approx((10 * (440 - 5) + 100 * 5) / 440, abs=1e-3)
    assert figures["root_mm"] == pytest.approx(0.0, abs=1e-3)
    assert figures["hidden_answered_percent"] == 100.0
    answer[5:10, wrist] = np.nan
    assert measure([track(seen, truth)], [answer])["hidden_answered_percent"] == 0.0


def test_the_truth_has_no_error_but_its_own_skate() -> None:
    truth = standing(20)
    figures = measure([track(truth, truth)], [truth])
    assert figures["all_mm"] == figures["acceleration_mm"] == figures["root_mm"] == 0.0
    speed = np.abs(np.diff(truth[:, 0, 1])).mean() / (PERIOD_NS * 1e-9)
    assert figures["skate_mm_s"] == pytest.approx(1000 * speed, rel=1e-3)
    assert np.isnan(figures["hidden_mm"])


def test_a_held_joint_stays_and_does_not_outlast_an_absence() -> None:
    truth = standing(10)
    seen = truth.copy()
    seen[3:7, 4] = np.nan
    held = hold_last(track(seen, truth, gap_at=5))
    np.testing.assert_array_equal(held[3:5, 4], truth[[2, 2], 4])
    assert np.isnan(held[5:7, 4]).all()
    np.testing.assert_array_equal(held[7:], truth[7:])


def test_the_smoother_answers_every_frame_of_every_visit() -> None:
    truth = standing(30)
    answer = smooth(track(truth, truth, gap_at=2), delay=4, density=1.0)
    assert answer.shape == truth.shape
    assert np.abs(answer - truth).max() < 0.01


def test_stated_sigma_against_error_found() -> None:
    rng = np.random.default_rng(0)
    truth = standing(400)
    answer = truth + rng.normal(0, 0.02, truth.shape)
    seen = truth.copy()
    seen[:, 4] = np.nan
    stated = np.full(truth.shape[:2], 0.02)
    stated[:, 4] = 0.01
    ratio = sigma_ratio([track(seen, truth)], [answer], [stated])
    assert ratio["seen"] == pytest.approx(1.0, rel=0.03)
    assert ratio["hidden"] == pytest.approx(2.0, rel=0.1)


def test_tracks_of_a_recording_lie_in_the_world_at_the_sensors_stamps() -> None:
    truth = standing(20)
    sensor = Pose(np.array([0.5, -2.0, 1.2]), Rotation.from_euler("xz", [-1.5, 0.3]).as_quat())
    back = Rotation.from_quat(sensor.orientation).inv().as_matrix()
    messages: list[tuple[str, Message]] = []
    for i, body in enumerate(truth):
        stamp = i * PERIOD_NS
        world = WorldBody(
            id=7,
            root_position=body[0],
            root_orientation=np.array([0.0, 0.0, 0.0, 1.0]),
            root_velocity=np.zeros(3),
            covariance=np.zeros((6, 6)),
            positions=body,
            rotations=np.tile([0.0, 0.0, 0.0, 1.0], (22, 1)),
            state=np.ones(22),
            sigma=np.zeros(22),
            contacts=np.array([0, 0, 1, 1, 1, 0, 0, 0]),
            tracking=Tracking.OK,
        )
        other = replace(world, id=8, positions=body + [1.0, 0.0, 0.0])
        messages.append((POSE_TRUTH, PoseWorld(stamp, "world", "sim", np.array([0.0, 0, 1, 0]), [other, world])))
        late = PERIOD_NS // 2
        half = (body + truth[min(i + 1, 19)]) / 2
        seen = RawBody(3, (half - sensor.position) @ back.T, np.ones(22))
        messages.append((POSE_RAW, PoseRaw(stamp + late, "camera", "sim", "smpl22", sensor, True, [seen])))
    (found,) = read_tracks(messages)
    # The last sighting is after the last truth.
    assert len(found.stamps_ns) == 19
    np.testing.assert_allclose(found.seen, found.truth, atol=1e-6)
    assert found.contact[:, [FEET.index(f) for f in ("left_ankle", "right_ankle", "left_foot")]].all()
    assert not found.contact[:, FEET.index("right_foot")].any()


def test_an_uncalibrated_camera_is_forgiven_its_place_but_not_its_noise() -> None:
    truth = standing(40)
    noisy = truth + np.random.default_rng(1).normal(0, 0.01, truth.shape)
    turn = Rotation.from_euler("z", 0.7).as_matrix()
    away = track(noisy @ turn.T + 3.0, truth)
    assert measure([away], [away.seen])["all_mm"] > 1000
    lost = replace(away, calibrated=False)
    assert measure([lost], [lost.seen])["all_mm"] == pytest.approx(16.0, abs=1.0)
