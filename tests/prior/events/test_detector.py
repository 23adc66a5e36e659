import dataclasses
from collections.abc import Callable, Iterable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from tests.helpers.bodies import world_body

from steadypose.msgs.types import Event, EventKind, Hand, JointState, Phase, PoseWorld, Tracking
from steadypose.prior.body.skeleton import REST_POSITIONS, J
from steadypose.prior.events.detector import EventDetector, EventSettings
from steadypose.prior.events.features import features
from steadypose.prior.events.trigger import RandomWalk, Trigger, Wave

FRAME_NS = 33_333_333
START_NS = 1_000_000_000
Pose = NDArray[np.float64]


def standing(x: float = 2.5) -> Pose:
    """(22, 3) upright at (x, 0), facing the sensor at the origin, arms hanging."""
    p = REST_POSITIONS * [-1.0, -1.0, 1.0]
    for side in ("left", "right"):
        for joint, drop in (("elbow", 0.27), ("wrist", 0.52)):
            p[J[f"{side}_{joint}"]] = p[J[f"{side}_shoulder"]] - [0.0, 0.0, drop]
    return p + [x, 0.0, 0.96]


def raised(p: Pose, side: str = "right", swing: float = 0.0) -> Pose:
    """A hand up beside the head, the forearm turned to the side by ``swing`` radians."""
    p = p.copy()
    shoulder, out = p[J[f"{side}_shoulder"]], 1.0 if side == "right" else -1.0
    p[J[f"{side}_elbow"]] = shoulder + [0.0, 0.2 * out, -0.05]
    p[J[f"{side}_wrist"]] = p[J[f"{side}_elbow"]] + 0.26 * np.array([0.0, np.sin(swing), np.cos(swing)])
    return p


def sitting() -> Pose:
    p = standing()
    p[:, 2] -= 0.42
    for side in ("left", "right"):
        for joint, at in (("knee", (-0.41, -0.05)), ("ankle", (-0.41, -0.45)), ("foot", (-0.54, -0.5))):
            hip = p[J[f"{side}_hip"]]
            p[J[f"{side}_{joint}"]] = hip + [at[0], 0.0, at[1]]
    return p


def tipped(angle: float) -> Pose:
    """A standing body, rotated about its feet."""
    p = standing() - [2.5, 0.0, 0.0]
    c, s = np.cos(angle), np.sin(angle)
    return p @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]).T + [2.5, 0.0, 0.1 * s]


def pointing() -> Pose:
    p = standing()
    shoulder = p[J["right_shoulder"]]
    along = np.array([-1.0, 0.0, 0.0])
    p[J["right_elbow"]], p[J["right_wrist"]] = shoulder + 0.27 * along, shoulder + 0.52 * along
    return p


def message(index: int, *poses: Pose, sigma: float = 0.01, tracking: Tracking = Tracking.OK) -> PoseWorld:
    known = [np.where(np.isfinite(p).all(axis=1), JointState.SEEN, JointState.UNKNOWN) for p in poses]
    same = {"root_orientation": np.array([0.0, 0.0, 1.0, 0.0]), "sigma": np.full(22, sigma), "tracking": tracking}
    bodies = [world_body(p, id=k, state=known[k], covariance=np.eye(6) * sigma**2, **same) for k, p in enumerate(poses)]
    return PoseWorld(START_NS + index * FRAME_NS, "world", "test", np.array([0.0, 0.0, 1.0, 0.0]), bodies)


def changes(poses: Iterable[Pose], sigma: float = 0.01) -> list[tuple[int, EventKind, Hand, Phase]]:
    """What begins and ends, with the frame."""
    detector = EventDetector()
    return [
        (index, event.kind, event.hand, event.phase)
        for index, pose in enumerate(poses)
        for event in detector.update(message(index, pose, sigma=sigma))
        if event.phase != Phase.HOLDS
    ]


NEVER = 10**9


def first(found: list[tuple[int, EventKind, Hand, Phase]], kind: EventKind, phase: Phase = Phase.BEGINS) -> int:
    """The frame in which it begins, or ends; `NEVER` if it does not."""
    return next((index for index, k, _, p in found if (k, p) == (kind, phase)), NEVER)


STILL = [standing()] * 20


@pytest.mark.parametrize(
    ("pose", "kind", "hand"),
    [
        (raised(standing()), EventKind.HAND_RAISED, Hand.RIGHT),
        (raised(standing(), "left"), EventKind.HAND_RAISED, Hand.LEFT),
        (sitting(), EventKind.SITS, Hand.NONE),
        (pointing(), EventKind.POINTS, Hand.RIGHT),
        (standing(0.9), EventKind.NEAR, Hand.NONE),
    ],
)
def test_a_pose_begins_one_event_within_a_third_of_a_second_and_ends_it(
    pose: Pose, kind: EventKind, hand: Hand
) -> None:
    found = changes([*STILL, *[pose] * 20, *STILL])
    others = {EventKind.ENTERED, EventKind.STANDS, EventKind.FACES_SENSOR}
    assert {(k, h) for _, k, h, _ in found if k not in others} == {(kind, hand)}
    begins, ends = first(found, kind), first(found, kind, Phase.ENDS)
    assert 20 < begins <= 30
    assert 40 < ends <= 45


@pytest.mark.parametrize(
    ("calibrated", "height", "hips", "guess"),
    [(True, 0.0, True, 1.0), (True, 0.6, True, 1.0), (False, 0.0, True, 1.0), (True, 0.0, False, 1.0),
     (True, 0.0, True, 1.12), (True, 0.0, True, 0.9)],
)  # fmt: skip
def test_behind_a_counter_the_height_over_a_known_floor_says_who_stands_and_sits(
    calibrated: bool, height: float, hips: bool, guess: float
) -> None:
    # legs are guessed to stand, always; hips that are hidden too are known by the neck
    legs = [J[f"{side}_{part}"] for side in ("left", "right") for part in ("knee", "ankle", "foot")]
    ankles = [J["left_ankle"], J["right_ankle"]]
    guessed = legs if hips else [*legs, J["pelvis"], J["left_hip"], J["right_hip"]]
    detector, found = EventDetector(), []
    for index, pose in enumerate([*STILL, *[sitting()] * 20, *STILL]):
        seen, middle = pose.copy(), pose[[J["left_hip"], J["right_hip"]]].mean(axis=0)
        seen[legs] = guess * (standing() - standing()[J["pelvis"]])[legs] + middle
        world = message(index, seen + [0.0, 0.0, height])
        body = world.bodies[0]
        body.state[guessed], body.sigma[guessed], body.contacts[:6] = JointState.IMPUTED, 0.2, np.nan
        if not hips:
            body.state[ankles], body.positions[ankles] = JointState.UNKNOWN, np.nan
        world.ground_plane[3] = -height
        found += [(index, event.kind, event.hand, event.phase) for event in
                  detector.update(world, calibrated=calibrated) if event.phase != Phase.HOLDS]  # fmt: skip
    if calibrated:
        assert [kind for _, kind, _, phase in found if phase == Phase.BEGINS and kind != EventKind.FACES_SENSOR] == [
            EventKind.ENTERED, EventKind.STANDS, EventKind.SITS, EventKind.STANDS
        ]  # fmt: skip
        begins = first(found, EventKind.SITS)
        assert 20 < begins <= 30
    else:
        assert {EventKind.STANDS, EventKind.SITS}.isdisjoint({kind for _, kind, _, _ in found})


def test_a_hand_swung_from_side_to_side_waves_and_one_that_is_only_raised_does_not() -> None:
    swings = [raised(standing(), swing=0.5 * np.sin(2 * np.pi * 1.5 * k / 30)) for k in range(45)]
    found = changes([*STILL, *[raised(standing())] * 5, *swings, *[raised(standing())] * 40])
    begins, ends = first(found, EventKind.WAVES), first(found, EventKind.WAVES, Phase.ENDS)
    assert begins - 25 <= 15
    assert ends < NEVER
    assert first(changes([*STILL, *[raised(standing())] * 60]), EventKind.WAVES) == NEVER


def test_who_topples_fell_and_who_lies_down_slowly_did_not() -> None:
    fast = changes([*STILL, *(tipped(a) for a in np.linspace(0, np.pi / 2, 15)), *[tipped(np.pi / 2)] * 20, *STILL])
    slow = changes([*STILL, *(tipped(a) for a in np.linspace(0, np.pi / 2, 120)), *[tipped(np.pi / 2)] * 20])
    for found in (fast, slow):
        assert first(found, EventKind.LIES) < NEVER
        assert first(found, EventKind.STANDS, Phase.ENDS) < NEVER
    assert first(fast, EventKind.FELL) < NEVER
    assert first(fast, EventKind.FELL, Phase.ENDS) < NEVER
    assert first(slow, EventKind.FELL) == NEVER


def test_one_enters_after_a_while_and_leaves_after_another() -> None:
    detector, s = EventDetector(), EventSettings()
    found: list[tuple[int, Event]] = []
    for index in range(60):
        there = [standing()] if 10 <= index < 40 else []
        found += [(index, event) for event in detector.update(message(index, *there)) if event.phase != Phase.HOLDS]
    kinds = [(index, event.kind) for index, event in found if event.kind in (EventKind.ENTERED, EventKind.LEFT)]
    assert [kind for _, kind in kinds] == [EventKind.ENTERED, EventKind.LEFT]
    assert kinds[0][0] == 10 + round(s.entered * 30 + 0.5)
    assert kinds[1][0] == 39 + round(s.left * 30 + 1)
    # nothing before it has entered, and nothing that holds of somebody who has left
    assert min(index for index, _ in found) == kinds[0][0]
    assert {e.kind for i, e in found if i == kinds[1][0] and e.phase == Phase.ENDS} == {
        EventKind.STANDS, EventKind.FACES_SENSOR,
    }  # fmt: skip


def test_a_body_that_is_lost_has_left() -> None:
    detector = EventDetector()
    for index in range(20):
        detector.update(message(index, standing()))
    events = [e.kind for i in range(20, 40) for e in detector.update(message(i, standing(), tracking=Tracking.LOST))]
    assert EventKind.LEFT in events


def test_joints_that_may_be_anywhere_begin_nothing() -> None:
    poses = [*STILL, *[raised(standing())] * 20]
    assert first(changes(poses, sigma=0.01), EventKind.HAND_RAISED) < NEVER
    assert first(changes(poses, sigma=0.5), EventKind.HAND_RAISED) == NEVER


def test_joints_that_are_not_known_neither_begin_nor_end_anything() -> None:
    blind = raised(standing())
    blind[J["right_wrist"]] = np.nan
    found = changes([*STILL, *[raised(standing())] * 20, *[blind] * 20])
    assert first(found, EventKind.HAND_RAISED) < NEVER
    assert first(found, EventKind.HAND_RAISED, Phase.ENDS) == NEVER
    assert changes([*STILL, *[np.full((22, 3), np.nan)] * 10])[-1][0] < 20


def test_who_points_points_from_the_head_through_the_wrist() -> None:
    detector, direction = EventDetector(), None
    for index, pose in enumerate([*STILL, *[pointing()] * 20]):
        for event in detector.update(message(index, pose)):
            if event.kind == EventKind.POINTS:
                direction = event.direction
    expected = pointing()[J["right_wrist"]] - pointing()[J["head"]]
    assert direction is not None
    np.testing.assert_allclose(direction, expected / np.linalg.norm(expected), atol=1e-6)


@pytest.mark.parametrize(("speed", "points"), [(0.3, True), (0.5, False)])
def test_an_arm_that_moves_points_only_below_04_m_s(speed: float, points: bool) -> None:
    moving = [pointing() + [0.0, speed * frame / 30.0, 0.0] for frame in range(-10, 10)]
    assert (first(changes([*STILL, *moving]), EventKind.POINTS) < NEVER) is points


def test_the_sensor_that_is_faced_is_where_it_is_said_to_be() -> None:
    def faces(sensor: list[float]) -> bool:
        detector = EventDetector()
        events = [e for i in range(20) for e in detector.update(message(i, standing()), np.array(sensor))]
        return any(event.kind == EventKind.FACES_SENSOR for event in events)

    assert faces([0.0, 0.0, 1.0])
    assert not faces([5.0, 0.0, 1.0])


def test_where_a_body_faces_comes_from_its_rotations_not_from_a_shoulder_that_is_off() -> None:
    body = message(0, standing()).bodies[0]
    body.positions[J["left_shoulder"], 0] += 0.4
    assert features(body, np.zeros(3)).across == pytest.approx((0.0, -0.536))
    body.rotations[J["spine2"]] = [0.0, 0.0, 0.5, np.sqrt(0.75)]  # the chest turns left by 60 degrees
    assert features(body, np.zeros(3)).across == pytest.approx((0.36 * np.sqrt(0.75), -0.176 - 0.18))
    body.state[J["left_shoulder"]] = JointState.UNKNOWN
    assert np.isnan(features(body, np.zeros(3)).across).all()


def test_what_holds_is_told_with_every_message_and_since_when() -> None:
    detector = EventDetector()
    events = [detector.update(message(i, standing())) for i in range(30)]
    stands = [e for told in events for e in told if e.kind == EventKind.STANDS]
    assert [e.phase for e in stands[:2]] == [Phase.BEGINS, Phase.HOLDS]
    assert {e.since_ns for e in stands} == {START_NS}


def test_a_stream_that_begins_anew_begins_with_nobody() -> None:
    detector = EventDetector()
    for index in range(20):
        detector.update(message(index, standing()))
    again = [[e.kind for e in detector.update(message(i, standing()))] for i in range(10)]
    assert again[0] == []
    assert any(EventKind.ENTERED in kinds for kinds in again)


@given(st.lists(st.floats(-2.0, 2.0) | st.just(float("nan")), max_size=60), st.floats(0.0, 0.5))
@settings(max_examples=100, deadline=None)
def test_a_trigger_begins_above_its_threshold_only_and_ends_below_the_other_only(
    values: list[float], sigma: float
) -> None:
    trigger = Trigger(on=0.5, margin=0.4, hold_s=0.05, confidence=0.7)
    for index, value in enumerate(values):
        before = trigger.active
        if trigger.update(index * FRAME_NS, value, sigma):
            assert trigger.active is not before
            assert value > 0.5 if trigger.active else value < 0.1
        else:
            assert trigger.active is before
        assert 0.0 <= trigger.confidence <= 1.0


@pytest.mark.parametrize("course", [lambda t: 0.2 * t, lambda t: 0.1 * np.sin(9 * t), lambda t: 1.0 if t > 1 else 0.0])
def test_a_forearm_that_does_not_swing_does_not_wave(course: Callable[[float], float]) -> None:
    wave = Wave(0.28, 0.8)
    assert not any(wave.update(k * FRAME_NS, course(k / 30), 0.4, True, True) for k in range(90))


def test_an_arm_raised_aside_and_lowered_does_not_wave() -> None:
    """Its forearm comes up from one side and goes back to it: a swing, and back, but not about upright."""
    wave = Wave(EventSettings().wave_swing, EventSettings().wave_within)
    angles = 0.6 + 0.42 * np.cos(np.linspace(0.0, 2.0 * np.pi, 40))
    assert not any(wave.update(START_NS + k * FRAME_NS, angle, 0.4, True, True) for k, angle in enumerate(angles))
    again = [*angles, *angles, *angles]
    assert wave_begins(again), "but who does it again and again waves"


def wave_begins(angles: Iterable[float], heights: Iterable[float] | None = None) -> bool:
    wave, angles = Wave(EventSettings().wave_swing, EventSettings().wave_within), list(angles)
    samples = zip(angles, heights or [0.4] * len(angles), strict=True)
    return any(wave.update(START_NS + k * FRAME_NS, *sample, True, True) for k, sample in enumerate(samples))


RAISED, OUT = [-0.3] * 10, np.linspace(-0.3, -0.05, 6).tolist()
BACK = np.linspace(-0.1, -0.7, 12).tolist()
"""A hand held up; its forearm swings out by a little, as the first time, and back."""


def test_a_wave_begins_when_the_forearm_is_back_from_its_first_swing_which_may_be_small() -> None:
    assert wave_begins([*RAISED, *OUT, *BACK[:7]])
    assert not wave_begins([*RAISED, *OUT, *BACK[:6]])
    assert not wave_begins([*RAISED, *BACK[4:]])
    assert not wave_begins([*RAISED, *[0.5 * (angle + 0.3) - 0.3 for angle in OUT], *BACK[2:]]), "that was no swing"


def test_a_hand_that_comes_down_does_not_wave() -> None:
    heights = [*[0.4] * 16, *np.linspace(0.4, 0.2, 12)]
    assert not wave_begins([*RAISED, *OUT, *BACK], heights)
    assert wave_begins([*RAISED, *OUT, *BACK, *OUT], [*heights, *[0.2] * 6]), "but who swings it once more waves"


def test_a_raised_hand_that_drifts_or_jumps_while_hidden_does_not_wave() -> None:
    slow = np.linspace(-0.1, -0.52, 22).tolist()
    assert not wave_begins([*RAISED, *OUT, *slow])
    assert not wave_begins([*RAISED, *OUT, *[np.nan] * 5, *[-0.7] * 10])
    wave = Wave(EventSettings().wave_swing, EventSettings().wave_within)
    angles = [*RAISED, *OUT, *BACK, *[np.nan] * 5, *[-0.2] * 5]
    waves = [wave.update(START_NS + k * FRAME_NS, angle, 0.4, True, True) for k, angle in enumerate(angles)]
    assert all(waves[waves.index(True) :]), "but a wave goes on"


def test_a_forearm_that_passes_straight_down_turns_on_in_the_same_direction() -> None:
    circle = np.arange(0.0, 4.0 * np.pi, 0.2)
    assert not wave_begins(np.angle(np.exp(1j * circle)))


def test_where_a_body_faces_is_told_through_noise_and_followed_where_there_is_none() -> None:
    rng = np.random.default_rng(0)
    noisy, sure = RandomWalk(0.3), RandomWalk(0.3)
    stamps = [START_NS + k * FRAME_NS for k in range(60)]
    line, sigma = [noisy.update(at, (0.5 + rng.normal(0.0, 0.3), rng.normal(0.0, 0.3)), 0.3) for at in stamps][-1]
    turning = [sure.update(at, (np.cos(k / 20.0), np.sin(k / 20.0)), 0.005) for k, at in enumerate(stamps)]
    x, y = turning[-1][0]
    assert sigma < 0.15
    assert abs(np.arctan2(line[1], line[0])) < 0.5
    assert np.arctan2(y, x) == pytest.approx(59 / 20.0, abs=0.05)
    assert np.isnan(noisy.update(START_NS + 61 * FRAME_NS, (np.nan, 0.0), 0.3)[0][0])
    assert noisy.update(START_NS + 62 * FRAME_NS, (0.0, 1.0), 0.3)[0] == (0.0, 1.0), "what was unknown begins anew"


def test_a_swing_that_is_not_observed_is_none() -> None:
    """What a guess of a hidden forearm does waves at nobody; a wave that is hidden for a moment goes on."""
    wave = Wave(0.36, 0.8)
    angles = [0.5 * np.sin(9 * k / 30) for k in range(60)]
    waves = [
        wave.update(k * FRAME_NS, np.nan if 3 < k % 20 < 12 else angle, 0.4, True, True)
        for k, angle in enumerate(angles)
    ]
    assert waves[-1]
    body = message(0, raised(standing(), "left", swing=0.5)).bodies[0]
    assert features(body, np.zeros(3)).arms[0].swing == pytest.approx(-0.5, abs=0.01)
    body.state[J["left_elbow"]] = JointState.IMPUTED
    assert np.isnan(features(body, np.zeros(3)).arms[0].swing)


def test_who_stands_is_told_through_noise_that_no_single_frame_decides() -> None:
    """Legs of a runner: each frame's height is uncertain by more than it is above the threshold, all together not."""
    rng = np.random.default_rng(1)
    poses = [standing() for _ in range(30)]
    for pose in poses:
        pose[[J["left_ankle"], J["right_ankle"]], 2] += 0.09 + rng.normal(0.0, 0.02)
    begins = first(changes(poses, sigma=0.1), EventKind.STANDS)
    assert begins < 15


def test_a_hand_before_a_body_that_bends_down_is_not_raised() -> None:
    bent = raised(standing())
    hips = bent[J["pelvis"]].copy()
    upper = [J[name] for name in ("spine1", "spine2", "spine3", "neck", "head")]
    bent[upper] = hips + (bent[upper] - hips) @ np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    assert first(changes([*STILL, *[bent] * 20]), EventKind.HAND_RAISED) == NEVER


def test_who_waves_with_the_whole_arm_begins_to_wave_once() -> None:
    wave = Wave(0.36, 0.8)
    angles = [1.3 * np.sin(9 * k / 30) for k in range(120)]
    waves = [wave.update(k * FRAME_NS, angle, 0.4, abs(angle) < 1.0, True) for k, angle in enumerate(angles)]
    begun = waves.index(True)
    assert begun < 60
    assert all(waves[begun:])
    assert not wave.update(120 * FRAME_NS, 0.0, 0.4, False, False), "the hand is down"


@pytest.mark.parametrize(("name", "value"), [("near", -1.0), ("hold", 61.0), ("confidence", 0.4)])
def test_a_threshold_that_cannot_be_is_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        dataclasses.replace(EventSettings(), **{name: value})
