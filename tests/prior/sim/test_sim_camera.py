import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import rankdata

from steadypose.prior.body.capsules import TOE_HEIGHT, mount, random_offsets, stature
from steadypose.prior.body.kinematics import CONTACT_JOINTS, label_contacts
from steadypose.prior.body.layouts import CANONICAL, SKELETONS, to_canonical
from steadypose.prior.body.skeleton import MIRROR, PARENTS, REST_OFFSETS, J
from steadypose.prior.sim import noise as noise_model
from steadypose.prior.sim.camera import FRAME_ID, Camera, film, segment_gap, sight
from steadypose.prior.sim.gait import RATE, Stand, Turn, Walk, plan
from steadypose.prior.sim.motion import Intent, Motion, perform, two_bone
from steadypose.prior.sim.noise import SWAP_GROUPS, NoiseModel, confidence_of, draw_errors, ray_axes, swapped, travelled
from steadypose.prior.sim.scripts import SCRIPTS

SILENT = replace(
    NoiseModel.load(), offset=np.zeros((22, 3)), bias=np.zeros((22, 3)), fast=np.zeros((22, 3)), jump_rate=np.zeros(22)
)
LEVEL = Camera((0.0, 0.0, 1.2), (3.0, 0.0, 1.2), skeleton="smpl22", drop_rate=0.0)


@cache
def waving() -> Motion:
    (motion,) = SCRIPTS["wave_hidden_arm"](np.random.default_rng(5))
    return motion


def standing(x: float, y: float, seconds: float = 3.0, facing: float = np.pi) -> Motion:
    return perform(Intent(plan((x, y), facing, [Stand(seconds)])), REST_OFFSETS, np.random.default_rng(0))


def filmed(people: list[Motion], camera: Camera = LEVEL, noise: NoiseModel = SILENT, seed: int = 0) -> list:
    return film(people, camera, noise, np.random.default_rng(seed), "test", 0)


def test_a_hand_behind_the_back_is_hidden_and_one_beside_the_head_is_not() -> None:
    before, behind = waving().at(np.array([0.2])), waving().at(np.array([5.0]))
    eye = np.array([0.0, 0.0, 1.4])
    assert sight(before.positions, [before], eye).hidden[0, J["right_wrist"]] < 0.1
    hidden = sight(behind.positions, [behind], eye).hidden[0]
    assert hidden[J["right_wrist"]] > 0.9
    assert hidden[J["left_wrist"]] < 0.1
    assert hidden[J["head"]] < 0.1


def test_a_body_hides_the_one_behind_it_and_not_the_other_way_about() -> None:
    near, far = (standing(x, 0.0).at(np.array([1.0])) for x in (2.0, 3.0))
    eye = np.array([0.0, 0.0, 1.2])
    assert sight(far.positions, [near, far], eye).hidden[0, J["spine2"]] > 0.9
    assert sight(near.positions, [near, far], eye).hidden[0, J["spine2"]] < 0.1


points = st.tuples(*[st.floats(-2, 2)] * 3).map(np.array)


@given(points, points, points, points)
def test_the_gap_between_segments_is_the_least_distance(p: np.ndarray, q: np.ndarray, a: np.ndarray, b: np.ndarray):
    gap, along = segment_gap(p, q, a, b)
    grid = np.linspace(0, 1, 81)
    on_first = p + grid[:, None] * (q - p)
    on_second = a + grid[:, None] * (b - a)
    brute = np.linalg.norm(on_first[:, None] - on_second[None], axis=-1).min()
    coarse = (np.linalg.norm(q - p) + np.linalg.norm(b - a)) / 80
    assert gap <= brute + 1e-5, "of segments that are all but parallel, to the micrometre"
    assert gap >= brute - coarse
    assert 0 <= along <= 1


def test_joints_are_in_the_optical_frame_of_the_pose_that_is_told() -> None:
    camera = replace(LEVEL, position=(0.2, -0.4, 1.7), look_at=(2.5, 0.1, 0.8), roll=0.1)
    motion = standing(2.5, 0.0)
    frames = filmed([motion], camera)
    frame = frames[len(frames) // 2]
    assert frame.frame_id == FRAME_ID
    body = frame.bodies[0].positions.astype(float)
    assert (body[:, 2] > 1.0).all(), "z is forward"
    assert body[J["head"], 1] < body[J["pelvis"], 1], "y is down"
    assert body[J["left_hip"], 0] > body[J["right_hip"], 0], "the left of who faces the camera is on the right"
    world = Rotation.from_quat(frame.sensor_pose.orientation).apply(body) + frame.sensor_pose.position
    truth = motion.at(np.array([frame.stamp_ns / 1e9])).positions[0]
    assert np.nanmedian(np.linalg.norm(world - truth, axis=-1)) < 1e-5


def test_an_uncalibrated_camera_tells_only_which_way_is_up() -> None:
    camera = replace(LEVEL, position=(1.0, 2.0, 1.5), look_at=(2.0, 4.0, 1.0), roll=0.2, calibrated=False)
    pose = camera.estimated_pose()
    np.testing.assert_array_equal(pose.position, np.zeros(3))
    told = Rotation.from_quat(pose.orientation).as_matrix()
    np.testing.assert_allclose(told[2], camera.orientation[2], atol=1e-12)
    assert told[1, 2] == pytest.approx(0.0, abs=1e-12), "it says nothing of its heading"


def test_times_jitter_about_the_rate_and_frames_are_lost() -> None:
    camera = replace(LEVEL, fps=24.0, stamp_jitter=0.005, drop_rate=0.05)
    times = camera.capture_times(400.0, np.random.default_rng(0))
    steps = np.diff(times)
    assert steps.min() > 0
    assert np.median(steps) == pytest.approx(1 / 24, rel=0.05)
    assert 0.02 < 1 - len(times) / (399.8 * 24) < 0.09
    assert steps.std() > 0.005


def test_who_leaves_the_view_is_gone_and_comes_back_as_somebody_new() -> None:
    out_and_in = [Stand(0.5), Walk([(2.6, 2.6)], 1.2), Turn(np.pi, 2.8), Walk([(2.6, 0.0)], 1.2), Stand(0.5)]
    motion = perform(Intent(plan((2.6, 0.0), np.pi / 2, out_and_in)), REST_OFFSETS, np.random.default_rng(0))
    camera = replace(LEVEL, skeleton="blazepose33")
    frames = filmed([motion], camera, NoiseModel.load())
    there = np.array([len(f.bodies) for f in frames])
    changes = np.flatnonzero(np.diff(there))
    assert there[0] == there[-1] == 1
    assert len(changes) == 2, "out and in"
    assert [frames[k].bodies[0].id for k in (0, -1)] == [1, 2]
    for f in frames:
        for body in f.bodies:
            seen = np.isfinite(body.positions).all(axis=1)
            assert ((body.confidence > 0) == seen).all()
            aside, _, ahead = body.positions[seen].T
            assert np.median(np.abs(aside / ahead)) < np.tan(camera.field_of_view[0] / 2)


def test_distance_makes_the_quick_noise_worse() -> None:
    noise = replace(NoiseModel.load(), jump_rate=np.zeros(22), session_spread=0.0)

    def shake(x: float) -> float:
        bodies = [f.bodies[0].positions for f in filmed([standing(x, 0.0)], LEVEL, noise) if f.bodies]
        return float(np.nanmedian(np.abs(np.diff(np.array(bodies), 2, axis=0))))

    assert shake(4.0) > 1.5 * shake(2.0)


@pytest.mark.parametrize("name", ["smpl22", "coco17", "blazepose33", "kinect22"])
def test_a_sensors_joints_map_back_to_the_canonical_ones(name: str) -> None:
    skeleton, on_body = SKELETONS[name], mount(name)
    body = standing(2.0, 0.0).at(np.array([1.0]))
    sensed = on_body.positions(body.positions, body.orientations, 1.0)
    canonical, _ = to_canonical(skeleton, sensed)
    off = np.linalg.norm(canonical - body.positions, axis=-1)[0]
    limbs = [
        j for j in range(22) if CANONICAL.joints[j].endswith(("hip", "knee", "ankle", "shoulder", "elbow", "wrist"))
    ]
    assert off[limbs].max() < 1e-9
    assert np.nanmax(off) < 0.13, "what is the mean of others lies near"


@pytest.mark.parametrize("name", ["coco17", "blazepose33", "kinect22"])
def test_counterparts_are_the_same_joint_of_the_other_side(name: str) -> None:
    skeleton, on_body = SKELETONS[name], mount(name)
    np.testing.assert_array_equal(on_body.mirror[on_body.mirror], np.arange(len(skeleton.joints)))
    for joint, other in zip(skeleton.joints, (skeleton.joints[m] for m in on_body.mirror), strict=True):
        swapped = joint.replace("left", "#").replace("right", "left").replace("#", "right")
        if name == "kinect22" and joint not in ("Waist", "Spine", "Chest", "Neck", "Head", "HeadTip"):
            swapped = ("R" if joint[0] == "L" else "L") + joint[1:]
        assert other == swapped


def test_a_sensor_that_cannot_be_placed_is_refused() -> None:
    with pytest.raises(ValueError, match="cannot simulate skeleton 'zed38'"):
        mount("zed38")


MODEL = NoiseModel.load()
NO_JUMPS = replace(MODEL, jump_rate=np.zeros(22))


def evenly(seconds: float, fps: float, speed: float = 0.0, batch: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Travel (batch, T, 22) and dt (T,) of joints that all move at one speed."""
    frames = round(seconds * fps)
    return np.full((batch, frames, 22), speed / fps), np.full(frames, 1 / fps)


def test_a_still_joint_keeps_its_bias_and_a_moving_one_loses_it() -> None:
    still, moving = (
        draw_errors(*evenly(6.0, 30.0, speed, batch=64), np.random.default_rng(0), NO_JUMPS).steady
        for speed in (0.0, 0.5)
    )
    np.testing.assert_allclose(still[:, -1], still[:, 30], atol=0.002)
    changed = np.median(np.abs(moving[:, -1] - moving[:, 30]))
    assert changed > 0.005


@pytest.mark.parametrize("fps", [15.0, 60.0])
def test_noise_is_a_matter_of_seconds_not_of_frames(fps: float) -> None:
    def spread(rate: float) -> tuple[float, float]:
        drawn = draw_errors(*evenly(4.0, rate, 0.3, batch=100), np.random.default_rng(0), MODEL)
        return float(np.median(np.abs(drawn.quick))), float(np.median(np.abs(drawn.steady)))

    assert spread(fps) == pytest.approx(spread(30.0), rel=0.15)


def test_fast_joints_are_noisier() -> None:
    slow, fast = (
        np.median(np.abs(draw_errors(*evenly(2.0, 30.0, v, batch=100), np.random.default_rng(0), NO_JUMPS).quick))
        for v in (0.02, 0.8)
    )
    assert fast > 3 * slow


def test_jumps_come_as_often_as_said_and_end() -> None:
    quiet = replace(
        MODEL, fast=np.zeros((22, 3)), offset=np.zeros((22, 3)), bias=np.zeros((22, 3)), session_spread=0.0,
        jump_rate=np.full(22, 0.2),
    )  # fmt: skip
    drawn = draw_errors(*evenly(60.0, 30.0, batch=4), np.random.default_rng(0), quiet).quick
    displaced = np.linalg.norm(drawn, axis=-1)
    begins = ((displaced[:, 1:] > 0) & (displaced[:, :-1] != displaced[:, 1:])).sum() / (4 * 22 * 60.0)
    assert begins == pytest.approx(0.2, rel=0.1)
    assert displaced[displaced > 0].min() >= quiet.jump_minimum * (1 - 1e-9)
    mean = quiet.jump_short_share * quiet.jump_short + (1 - quiet.jump_short_share) * quiet.jump_long
    assert (displaced > 0).mean() == pytest.approx(0.2 * mean, rel=0.25)


def test_noise_has_heavy_tails_and_memory_and_confidence_is_informative() -> None:
    motion = SCRIPTS["reach"](np.random.default_rng(0))[0].positions[::4]
    sessions = np.repeat(travelled(motion)[None], 24, axis=0)
    drawn = draw_errors(sessions, np.full(len(motion), 1 / 30), np.random.default_rng(3), MODEL)
    error = drawn.steady + drawn.quick
    size = np.linalg.norm(error, axis=-1)
    assert 0.015 < np.median(size) < 0.06
    assert 2.5 < np.percentile(size, 95) / np.median(size) < 7.0, "1.6 for a Gaussian"
    centred = error - error.mean(axis=1, keepdims=True)
    assert (centred[:, 1:] * centred[:, :-1]).sum() / (centred**2).sum() > 0.5
    confidence = confidence_of(drawn.scale, np.random.default_rng(0))
    assert -0.85 < float(np.corrcoef(rankdata(confidence), rankdata(size))[0, 1]) < -0.25
    small, large = (confidence_of(np.full(1000, s), np.random.default_rng(0)).mean() for s in (0.01, 0.3))
    assert small > 0.8
    assert large < 0.2


def test_swaps_last_a_moment() -> None:
    when = swapped(np.full(900, 1 / 30), np.random.default_rng(1), rate_factor=20.0)
    assert when.keys() == SWAP_GROUPS.keys()
    assert all(0 < active.mean() < 0.3 for active in when.values())


def test_ray_axes_are_right_handed() -> None:
    rays = np.random.default_rng(0).normal(size=(50, 3))
    axes = ray_axes(rays)
    np.testing.assert_allclose(axes @ np.swapaxes(axes, -1, -2), np.broadcast_to(np.eye(3), (50, 3, 3)), atol=1e-12)
    np.testing.assert_allclose(ray_axes(np.array([1.0, 0.0, 0.0])), [[1, 0, 0], [0, -1, 0], [0, 0, 1]], atol=1e-12)


def test_a_file_of_another_making_is_refused(tmp_path: Path) -> None:
    content = json.loads(noise_model.KINECT_NOISE.read_text())
    del content["parameters"]["fast"]
    path = tmp_path / "noise.json"
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match="expected parameters"):
        NoiseModel.load(path)


SEED = 5
FEET = list(CONTACT_JOINTS[2:6])


@cache
def played(script: str) -> list[Motion]:
    return SCRIPTS[script](np.random.default_rng(SEED))


@cache
def straight_walk() -> Motion:
    path = plan((0.0, 0.0), 0.0, [Stand(0.3), Walk([(3.0, 0.0), (7.0, 0.0)], 1.15), Stand(0.3)])
    return perform(Intent(path), REST_OFFSETS, np.random.default_rng(0))


@pytest.mark.parametrize("script", SCRIPTS)
def test_planted_feet_do_not_move(script: str) -> None:
    for motion in played(script):
        feet, planted = motion.positions[:, FEET], motion.contacts[:, 2:6]
        moved = np.linalg.norm(np.diff(feet, axis=0), axis=-1)
        assert moved[planted[1:] & planted[:-1]].max() < 1e-9
        assert planted.any(axis=1).all(), "no script leaves the ground"


@pytest.mark.parametrize("script", SCRIPTS)
def test_bones_keep_their_lengths_also_between_frames(script: str) -> None:
    for motion in played(script):
        for positions in (motion.positions, motion.at(np.array([1.003, 4.5071, 9.9999])).positions):
            lengths = np.linalg.norm(positions[:, 1:] - positions[:, list(PARENTS[1:])], axis=-1)
            np.testing.assert_allclose(lengths, np.tile(np.linalg.norm(motion.offsets[1:], axis=-1), (len(lengths), 1)))
        with pytest.raises(ValueError, match="leave the motion"):
            motion.at(np.array([motion.times[-1] + 1.0]))


@pytest.mark.parametrize("script", SCRIPTS)
def test_nothing_jerks_and_nothing_sinks(script: str) -> None:
    for motion in played(script):
        velocity = np.diff(motion.positions, axis=0) * RATE
        assert np.linalg.norm(velocity, axis=-1).max() < 7.0
        assert np.linalg.norm(np.diff(velocity, axis=0), axis=-1).max() < 1.0, "m/s from frame to frame at 120 Hz"
        assert motion.positions[..., 2].min() > TOE_HEIGHT - 1e-6


@pytest.mark.parametrize("script", SCRIPTS)
def test_contacts_are_those_that_motion_shows(script: str) -> None:
    for motion in played(script):
        labelled = label_contacts(motion.positions[::4], RATE / 4)
        assert (labelled == motion.contacts[::4])[:, 2:6].mean() > 0.88


def test_a_walk_has_the_measures_of_a_walk() -> None:
    motion = straight_walk()
    heel, toe = motion.contacts[:, 2], motion.contacts[:, 4]
    strikes = np.flatnonzero(np.diff(heel.astype(int)) == 1)
    strides = np.diff(motion.positions[strikes, J["left_ankle"], 0])[1:-1]
    rhythm = np.diff(motion.times[strikes])[1:-1]
    stance = (heel | toe)[strikes[1] : strikes[-2]].mean()
    assert 1.1 < strides.mean() < 1.5
    assert 0.95 < rhythm.mean() < 1.25
    assert 0.55 < stance < 0.65
    cruising = slice(strikes[1], strikes[-2])
    bob = np.ptp(motion.root[cruising, 2])
    assert 0.015 < bob < 0.07
    assert np.ptp(motion.root[cruising, 1]) < 0.08


def test_knees_bend_as_knees_do() -> None:
    for motion in (straight_walk(), *played("sit_rise")):
        for side in ("left", "right"):
            # Flexion is a turn about the leg's own y axis, never backwards and never folded flat.
            bend = motion.rotations[:, J[f"{side}_knee"]]
            angle = np.degrees(np.arctan2(bend[:, 0, 2] - bend[:, 2, 0], bend[:, 0, 0] + bend[:, 2, 2]))
            assert angle.min() > 0.0
            assert angle.max() < 130.0


def test_sitting_is_on_the_chair() -> None:
    (motion,) = played("sit_rise")
    hips = motion.positions[:, [J["left_hip"], J["right_hip"]], 2].mean(axis=1)
    assert 0.45 < hips.min() < 0.65
    knees = motion.positions[hips.argmin(), J["left_knee"], 2]
    assert abs(knees - hips.min()) < 0.15, "thighs are about level"


@given(st.integers(0, 2**32 - 1), st.floats(1.5, 2.0))
def test_random_bodies_have_the_height_asked_for_and_two_equal_sides(seed: int, height: float) -> None:
    offsets = random_offsets(np.random.default_rng(seed), height)
    assert stature(offsets) == pytest.approx(height)
    np.testing.assert_allclose(offsets[MIRROR] * [1, -1, 1], offsets, atol=1e-12)


directions = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)


@given(directions, st.floats(0.2, 0.98), directions)
def test_two_bones_reach_their_goal(direction: tuple[float, ...], share: float, pole: tuple[float, ...]) -> None:
    lengths = np.array([0.3, 0.25])
    goal = np.array([direction]) / np.linalg.norm(direction) * share * lengths.sum()
    if np.linalg.norm(np.cross(goal[0], pole)) < 1e-3:
        return  # a pole along the limb points nowhere
    first, second, hinge = two_bone(np.zeros((1, 3)), goal, np.array([pole]), lengths)
    np.testing.assert_allclose(lengths[0] * first + lengths[1] * second, goal, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(first), 1.0)
    assert float((hinge * goal).sum()) == pytest.approx(0.0, abs=1e-9)
    across = np.array(pole) - goal[0] * (goal[0] @ pole) / (goal[0] @ goal[0])
    assert first[0] @ across >= -1e-9, "the middle joint lies on the pole's side"
