import dataclasses
import sys
from collections import Counter

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher
from scipy.spatial.transform import Rotation
from tests.helpers.bodies import PERIOD_NS, noisy, raw, stream, waving
from tests.helpers.values import clean, observation

from steadypose.msgs.codec import encode
from steadypose.msgs.types import CleanBody, JointState, Pose, PoseClean
from steadypose.prior.body.kinematics import forward_kinematics, yaw_matrix
from steadypose.prior.body.layouts import INTERPOLATED_SIGMA, SKELETONS
from steadypose.prior.body.skeleton import REST_OFFSETS, J
from steadypose.prior.clean import core
from steadypose.prior.clean.pipeline import PriorPipeline, load_loops
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.sim.noise import time_correlated
from steadypose.prior.timing.rate import FPS


def positions(cleaned: list[PoseClean]) -> np.ndarray:
    return np.array([c.bodies[0].positions for c in cleaned])


@pytest.mark.parametrize(("delay", "frames"), [(0, 1), (0, 8), (1, 3), (4, 1), (4, 3), (4, 20), (12, 8), (12, 20)])
def test_every_frame_is_answered_once_in_order_however_short_the_stream(delay: int, frames: int) -> None:
    messages = stream(waving(frames))
    cleaned, _ = clean(messages, delay=delay)
    assert [c.stamp_ns for c in cleaned] == [m.stamp_ns for m in messages]
    assert np.isfinite(positions(cleaned)).all()
    assert all(c.delay_frames == delay for c in cleaned)


@pytest.mark.parametrize("delay", [0, 2, 4, 8])
def test_an_answer_leaves_exactly_its_delay_after_its_frame(delay: int) -> None:
    pipeline = PriorPipeline(PriorSettings(delay=delay))
    for k, message in enumerate(stream(waving(20))):
        assert [c.stamp_ns for c in pipeline.process(message)] == (
            [] if k < delay else [message.stamp_ns - delay * PERIOD_NS]
        )


@pytest.mark.parametrize(("delay", "lost"), [(0, 1), (0, 5), (1, 3), (4, 1), (4, 5)])
def test_without_any_network_of_windows_frames_may_be_lost(delay: int, lost: int) -> None:
    off = {name: {"enabled": False} for name in ("denoise", "score", "impute")}
    truth = waving(30)
    messages = [m for k, m in enumerate(stream(truth)) if not 20 <= k < 20 + lost]
    cleaned, _ = clean(messages, delay=delay, **off)
    assert [c.stamp_ns for c in cleaned] == [m.stamp_ns for m in stream(truth)]
    assert np.linalg.norm(positions(cleaned)[20 + lost :] - truth[20 + lost :], axis=-1).max() < 0.02


def test_with_a_longer_delay_a_frame_keeps_what_it_was_decoded_to_as_the_centre() -> None:
    off = {name: {"enabled": False} for name in ("fuse", "person", "steady")}
    settings = {**off, "refine": {"enabled": True}}
    messages = stream(waving(30) @ yaw_matrix(-1.2))  # faces to its left
    centre, late = (clean(messages, delay=delay, **settings)[0] for delay in (4, 10))
    for a, b in list(zip(centre, late, strict=True))[:20]:
        assert np.allclose(a.bodies[0].rotations, b.bodies[0].rotations, atol=1e-6)
    solved, _ = clean(messages, **{**settings, "refine": {"enabled": False}})
    refined, plain = (Rotation.from_quat([c.bodies[0].rotations[0] for c in cleaned]) for cleaned in (centre, solved))
    assert (refined.inv() * plain).magnitude().max() < 0.2


def test_the_same_stream_gives_the_same_bytes() -> None:
    messages = stream(noisy(20, 0.02))
    a, b = (b"".join(encode(c) for c in clean(messages)[0]) for _ in range(2))
    assert a == b


def test_no_frame_waits_for_a_loop_to_be_compiled_or_loaded() -> None:
    load_loops(PriorSettings())
    seen = noisy(40, 0.02)
    seen[12:24, J["left_wrist"]] = np.nan
    seen[28] = np.nan
    seen[33, J["right_ankle"]] += 1.0
    loaded = loops()
    clean(stream(seen))
    clean(stream(seen), delay=0)
    assert loops() == loaded


def loops() -> dict[str, int]:
    """Of every compiled function of the prior, for how many kinds of arguments it is loaded."""
    found = [value for name, module in list(sys.modules.items()) if name.startswith("steadypose.prior.")
             for value in vars(module).values() if isinstance(value, Dispatcher)]  # fmt: skip
    return {f"{f.py_func.__module__}.{f.py_func.__qualname__}": len(f.signatures) for f in found}


def test_settings_may_say_that_sensor_and_prior_are_never_wrong() -> None:
    seen = waving(40)
    seen[20:, J["left_wrist"]] = np.nan
    cleaned, _ = clean(stream(seen), bias_sigma=0.0, fuse={"prior_sigma": 0.0, "prior_drift": 0.0})
    assert np.isfinite(positions(cleaned)).all()
    assert all(np.isfinite(c.bodies[0].sigma).all() for c in cleaned)


def test_noise_shrinks_and_bones_stand_still() -> None:
    truth, seen = waving(170), noisy(170, 0.02)
    cleaned, _ = clean(stream(seen))
    settled = slice(125, None)
    got = positions(cleaned)[settled]
    before = np.linalg.norm(seen - truth, axis=-1)[settled].mean()
    assert np.linalg.norm(got - truth[settled], axis=-1).mean() < 0.6 * before
    jitter = np.abs(np.diff(got, n=2, axis=0)).mean() / np.abs(np.diff(seen[settled], n=2, axis=0)).mean()
    assert jitter < 0.2
    forearm = np.array([c.bodies[0].bone_lengths[J["left_wrist"]] for c in cleaned[settled]])
    assert np.ptp(forearm) < 5e-4
    assert forearm.mean() == pytest.approx(np.linalg.norm(REST_OFFSETS[J["left_wrist"]]), abs=0.01)


@pytest.mark.parametrize("delay", [0, 4, 16])
def test_a_perfect_input_stays_what_it_is(delay: int) -> None:
    truth = waving(40)
    cleaned, _ = clean(stream(truth), delay=delay)
    apart = np.linalg.norm(positions(cleaned) - truth[: len(cleaned)], axis=-1)
    assert apart.mean() < 0.001
    assert apart[0].max() < 0.01, "without delay, nothing is known of the noise yet"
    assert apart[1:].max() < 0.004


def test_rotations_and_bones_place_the_joints_where_they_are_said_to_be() -> None:
    cleaned, _ = clean(stream(waving(40)))
    body = cleaned[-1].bodies[0]
    assert np.allclose(body.bone_lengths[0], 0)
    rotations = Rotation.from_quat(body.rotations).as_matrix()
    unit = REST_OFFSETS / np.maximum(np.linalg.norm(REST_OFFSETS, axis=-1, keepdims=True), 1e-9)
    placed = forward_kinematics(rotations, unit * body.bone_lengths[:, None], body.positions[0])[0]
    assert np.linalg.norm(placed - body.positions, axis=-1).max() < 0.02


@pytest.mark.parametrize("up", ["y", "-y"])
def test_the_answer_is_in_the_sensors_frame_wherever_the_body_stands_and_faces(up: str) -> None:
    pose, about_z, step = Pose.from_up(up), yaw_matrix(1.1), np.array([3.0, -2.0, 0.4])
    turn = Rotation.from_quat(pose.orientation).as_matrix()
    seen = noisy(45, 0.02)
    seen[20:, [J["left_elbow"], J["left_wrist"]]] = seen[:, [J["right_knee"], J["right_ankle"]]] = np.nan
    moved = (seen @ about_z.T + step) @ turn
    here, there = (positions(clean(messages)[0]) for messages in (stream(seen), stream(moved, pose=pose)))
    assert np.allclose((there @ turn.T - step) @ about_z, here, atol=1e-5)


def test_a_joint_hidden_for_seconds_is_known_as_long_as_it_is_completed() -> None:
    seen = waving(108)
    seen[10:, J["left_wrist"]] = np.nan
    for imputes, at_last in ((True, JointState.IMPUTED), (False, JointState.UNKNOWN)):
        cleaned, _ = clean(stream(seen), impute={"enabled": imputes})
        assert cleaned[60].bodies[0].state[J["left_wrist"]] == JointState.IMPUTED
        assert cleaned[107].bodies[0].state[J["left_wrist"]] == at_last


def test_legs_that_were_never_seen_are_where_a_standing_body_has_them() -> None:
    truth, legs = waving(60), [J[f"{side}_{part}"] for side in ("left", "right") for part in ("knee", "ankle", "foot")]
    seen = truth.copy()
    seen[:, legs] = np.nan
    cleaned, _ = clean(stream(seen))
    body = cleaned[50].bodies[0]
    error = np.linalg.norm(body.positions - truth[50], axis=-1)
    assert (body.state[legs] == JointState.IMPUTED).all()
    assert error[legs].max() < 0.25
    assert (error[legs] < 4 * body.sigma[legs]).all()
    assert np.delete(error, legs).max() < 0.03


def test_what_a_sensor_lacks_is_held_between_its_neighbours_or_completed() -> None:
    coco = SKELETONS["coco17"]
    mapped = np.zeros((20, 17, 3))
    truth = waving(20)
    for k, name in enumerate(coco.joints):
        mapped[:, k] = (
            truth[:, J[name]] if name in J else truth[:, J["head"]] + [0.08, 0.03 if "left" in name else -0.03, 0]
        )
    cleaned, _ = clean(stream(mapped, skeleton="coco17"))
    state = cleaned[15].bodies[0].state
    assert state[J["spine2"]] == JointState.IMPUTED
    assert state[J["left_foot"]] == JointState.IMPUTED
    assert state[J["left_elbow"]] == JointState.REFINED
    assert np.linalg.norm(positions(cleaned)[15] - truth[15], axis=-1)[J["left_wrist"]] < 0.05
    sigma = cleaned[15].bodies[0].sigma
    assert sigma[[0, J["neck"]]].min() > 0.5 * INTERPOLATED_SIGMA, "they lie only about between hips and shoulders"
    assert sigma[J["left_hip"]] < 0.1 * INTERPOLATED_SIGMA


def test_collars_that_a_sensor_lacks_are_where_they_are_in_all_motion() -> None:
    truth = waving(20)
    for side in ("left", "right"):
        collar = 0.333 * truth[:, J["spine3"]] + 0.278 * truth[:, J["neck"]] + 0.389 * truth[:, J[f"{side}_shoulder"]]
        truth[:, J[f"{side}_collar"]] = collar
    kinect = np.einsum("ij,tjk->tik", np.linalg.pinv(SKELETONS["kinect22"].to_canonical), truth)
    body = clean(stream(kinect, skeleton="kinect22"))[0][15].bodies[0]
    collars = [J["left_collar"], J["right_collar"]]
    assert np.abs(body.positions[collars] - truth[15, collars]).max() < 0.002
    assert body.sigma[collars].max() < 0.005
    assert (body.state[collars] == JointState.IMPUTED).all()


def test_bodies_of_which_an_arm_is_hidden_do_not_disturb_each_other() -> None:
    a, b = noisy(45, 0.02), noisy(45, 0.02) + [2.0, 0, 0]
    a[30:, [J["left_elbow"], J["left_wrist"]]] = b[:, [J["left_elbow"], J["left_wrist"]]] = np.nan
    together = [raw(10**18 + k * PERIOD_NS, {1: a[k], 2: b[k]}) for k in range(45)]
    alone, _ = clean([raw(10**18 + k * PERIOD_NS, {1: a[k]}) for k in range(45)])
    both, _ = clean(together)
    assert [[x.id for x in c.bodies] for c in both] == [[1, 2]] * 45
    assert np.allclose(positions(both), positions(alone), atol=1e-5)


def test_a_body_that_leaves_is_dropped_and_its_place_is_free() -> None:
    p = waving(90)
    messages = [
        raw(10**18 + k * PERIOD_NS, {1: p[k]} | ({k // 30 + 2: p[k] + [1, 1, 0]} if k % 30 < 8 else {}))
        for k in range(90)
    ]
    cleaned, pipeline = clean(messages, max_bodies=2)
    assert {b.id for c in cleaned for b in c.bodies} == {1, 2, 3, 4}
    assert pipeline.counters["too_many_bodies"] == 0
    first = next(c for c in cleaned if any(b.id == 3 for b in c.bodies))
    assert np.allclose(next(b for b in first.bodies if b.id == 3).positions, p[30] + [1, 1, 0], atol=0.05)


@pytest.mark.parametrize("delay", [0, 4])
def test_who_comes_into_the_place_of_another_is_answered_as_if_that_one_had_never_been(delay: int) -> None:
    """To the bit, in all stages, and so is who stays. The one before was in lasting noise, hidden, frozen, mirrored."""
    rng, arm = np.random.default_rng(0), [J["left_elbow"], J["left_wrist"]]
    other, person = waving(60, scale=0.8) + [3.0, 0.0, 0.0], waving(45, scale=1.1) + [3.0, 0.0, 0.0]
    other += time_correlated(rng.normal(0.0, 0.04, other.shape), 0.95) * [1.0, 0.2, 0.2]
    other[50:, arm, 0] -= 2 * (other[50:, arm, 0] - other[50:, [J["left_shoulder"]], 0])
    other[40:, J["left_foot"]] = other[40, J["left_foot"]]
    person += rng.normal(0.0, 0.004, person.shape)
    other[30:, J["right_wrist"]] = person[:, [J["right_knee"], J["right_ankle"]]] = person[30:40, arm] = np.nan
    stays = waving(125) + rng.normal(0.0, 0.01, (125, 22, 3))

    def answers(before: list[dict[int, np.ndarray]]) -> dict[int, list[CleanBody]]:
        people = [*before, *[{}] * 20, *({2: frame} for frame in person)]
        messages = [raw(10**18 + k * PERIOD_NS, {7: stays[k], **others}) for k, others in enumerate(people)]
        every = {"correct": {"sensor": "kinect_v2"}, "refine": {"enabled": True}}
        cleaned, _ = clean(messages, delay=delay, max_bodies=2, **every)
        return {i: [b for c in cleaned for b in c.bodies if b.id == i] for i in (2, 7)}

    got, expected = answers([{1: frame} for frame in other]), answers([{}] * 60)
    np.testing.assert_equal(
        [dataclasses.asdict(body) for body in got[2]], [dataclasses.asdict(body) for body in expected[2]]
    )
    for a, b in zip(got[7], expected[7], strict=True):
        assert np.allclose([*a.positions.T, a.sigma], [*b.positions.T, b.sigma], atol=1e-4)
        assert np.allclose(a.joint_anomaly, b.joint_anomaly, atol=1e-2, equal_nan=True)
    assert len(got[2]) == len(person)


@pytest.mark.parametrize(("gap", "refused"), [(1, 6), (6, 1), (10, 0)])
def test_who_has_left_makes_way_for_who_is_there(gap: int, refused: int) -> None:
    """But not at once: a detector misses people for a few frames."""
    p = waving(60)
    messages = [
        raw(
            10**18 + k * PERIOD_NS,
            {1: p[k]} | ({2: p[k] + [1, 1, 0]} if k < 20 else {3: p[k]} if k >= 20 + gap else {}),
        )
        for k in range(60)
    ]
    cleaned, pipeline = clean(messages, max_bodies=2)
    assert pipeline.counters["too_many_bodies"] == refused
    here = [[body.id for body in c.bodies] for c in cleaned]
    assert here[19] == [1, 2]
    assert here[20 + gap + refused :] == [[1, 3]] * (40 - gap - refused)


class TestBadInput:
    """Counted, never raised; and good frames after it are answered as if nothing had been.

    More of it goes through all nodes' pipelines in ``tests/nodes/graph/test_bad_input.py``.
    """

    def test_a_body_wholly_away_or_wholly_missing_is_not_followed(self) -> None:
        for value in (np.nan, 10_000.0):
            cleaned, pipeline = clean(stream(np.full((20, 22, 3), value)))
            assert all(not c.bodies for c in cleaned)
            assert pipeline.counters["body_too_little_seen"] == 20

    def test_stamps_that_repeat_or_come_late_are_dropped(self) -> None:
        messages = stream(waving(30))
        late = [*messages[:10], messages[9], messages[7], *messages[10:]]
        cleaned, pipeline = clean(late)
        assert b"".join(map(encode, cleaned)) == b"".join(map(encode, clean(messages)[0]))
        assert pipeline.counters["stamp_repeated"] == 1
        assert pipeline.counters["stamp_out_of_order"] == 1

    @pytest.mark.parametrize(("jump_s", "cause"), [(-3600, "stamp_jumped_back"), (10, "stream_gap")])
    def test_a_jump_of_the_stamps_ends_one_stream_and_starts_another(self, jump_s: int, cause: str) -> None:
        first, second = stream(waving(15)), stream(waving(15), start_ns=10**18 + PERIOD_NS * 15 + jump_s * 10**9)
        cleaned, pipeline = clean(first + second)
        assert [c.stamp_ns for c in cleaned] == [m.stamp_ns for m in first + second]
        assert b"".join(map(encode, cleaned)) == b"".join(map(encode, clean(first)[0] + clean(second)[0]))
        assert pipeline.counters[cause] == 1

    def test_a_joint_of_confidence_zero_is_missing_wherever_it_is(self) -> None:
        missing, nowhere = stream(waving(40)), stream(waving(40))
        for frame, (a, b) in enumerate(zip(missing, nowhere, strict=True)):
            for joint in {J["left_wrist"], J["right_foot"], frame % 22}:
                a.bodies[0].positions[joint] = np.nan
                b.bodies[0].positions[joint], b.bodies[0].confidence[joint] = 0.0, 0.0
        assert b"".join(map(encode, clean(missing)[0])) == b"".join(map(encode, clean(nowhere)[0]))


@pytest.mark.parametrize("delay", [0, 4])
def test_to_keep_only_stamps_while_nobody_is_there_changes_nothing(delay: int, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = noisy(15, 0.02)
    visits = [[{id_: frame} for frame in seen] for id_ in (3, 4)]
    nobody = [{}] * 95
    people = [*visits[0], *nobody, *visits[1], *visits[0]]
    messages = [raw(10**9 + k * PERIOD_NS, present) for k, present in enumerate(people)]
    idle = [encode(c) for c in clean(messages, delay=delay)[0]]
    monkeypatch.setattr(core, "IDLE_S", np.inf)
    assert idle == [encode(c) for c in clean(messages, delay=delay)[0]]


def test_end_of_stream_flushes_and_is_passed_on() -> None:
    pipeline = PriorPipeline(PriorSettings())
    messages = stream(waving(10))
    for message in messages:
        pipeline.process(message)
    last = pipeline.process(dataclasses.replace(messages[-1], bodies=[], end_of_stream=True))
    assert [c.end_of_stream for c in last] == [False] * 4 + [True]
    assert pipeline.flush() == []


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"dellay": 2}, "did you mean 'delay'"),
        ({"gate": {"jmup": 2.0}}, r"prior\.gate"),
        ({"delay": "four"}, "expected int"),
        ({"delay": 17}, "delay: expected 0 to 16"),  # longer than the mixture has learned
        ({"timeout": True}, "expected float"),
        ({"score": {"false_alarms": 0.0}}, "false_alarms"),
        ({"identify": {"birth": -1.0}}, "birth: expected 0 to 60"),
        ({"identify": {"death": float("nan")}}, "death: expected"),
        ({"identify": {"death": 0.0}}, "death: expected"),  # with which nobody would ever get an id
    ],
)
def test_settings_that_cannot_be_are_refused(settings: dict, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        PriorPipeline(PriorSettings.from_dict(settings))


def test_a_whole_number_is_a_setting_of_seconds_or_metres() -> None:
    assert PriorSettings.from_dict({"gate": {"jump": 1}}).gate.jump == 1.0


def test_a_body_wholly_hidden_for_a_moment_stays_about_where_it_was() -> None:
    truth = waving(60) + [3.0, -2.0, 0.0]
    seen = truth.copy()
    seen[30:42] = np.nan
    cleaned, _ = clean(stream(seen))
    error = np.linalg.norm(positions(cleaned) - truth[: len(cleaned)], axis=-1)
    assert error[30:42].max() < 0.4


@pytest.mark.parametrize(("sigma", "frames"), [(0.0, 60), (0.02, 165)])
def test_the_noise_of_the_sensor_is_found(sigma: float, frames: int) -> None:
    pipeline = PriorPipeline(PriorSettings())
    assert pipeline.sensor_noise is None
    for message in stream(noisy(frames, sigma)):
        pipeline.process(message)
    found = pipeline.sensor_noise
    assert found is not None
    assert found.jitter_sigma == pytest.approx(sigma, rel=0.4, abs=0.002)
    assert found.bias_sigma < 0.006


def test_a_body_does_not_inherit_how_long_the_one_before_in_its_slot_went_unpublished() -> None:
    counters: Counter[str] = Counter()
    stages, half = core.CleanCore(PriorSettings(delay=0, max_bodies=1), counters), round(0.6 * core.UNPUBLISHED_S * FPS)
    everybody = np.ones(1, dtype=bool)
    for t, positions in enumerate(waving(2 * half)):
        if t == half:
            stages.forget(everybody)
        frame = stages.step(observation(positions[None], t / FPS))
        assert frame is not None
        stages.note_published(frame, published=())
    assert counters["body_begun_anew"] == 0
