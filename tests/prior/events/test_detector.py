import dataclasses
from collections.abc import Callable, Iterable
from statistics import NormalDist

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from tests.helpers.bodies import fk, world_body

from steadypose.msgs.types import Event, EventKind, Hand, JointState, Phase, PoseWorld, Tracking
from steadypose.prior.body.skeleton import REST_POSITIONS, J
from steadypose.prior.events.detector import EventDetector, EventSettings
from steadypose.prior.events.features import Features, facing_away, features
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


def squatting(angle: float) -> Pose:
    """Thighs at ``angle`` from straight down, feet under the hips."""
    p, x, z = standing(), 0.4 * np.sin(angle), 0.4 * np.cos(angle)
    for side in ("left", "right"):
        p[J[f"{side}_knee"]] = p[J[f"{side}_hip"]] - [x, 0.0, z]
        p[J[f"{side}_ankle"]] = p[J[f"{side}_hip"]] - [0.0, 0.0, 2 * z]
    return p


def tall(height: float) -> Pose:
    """Pressed down until head and ankles are ``height`` apart, upright in every other respect."""
    p = standing()
    return p * [1.0, 1.0, height / (p[J["head"], 2] - p[J["left_ankle"], 2])]


def pointing(elbow: float = np.pi, lift: float = np.pi / 2) -> Pose:
    """An arm ``lift`` radians from straight down, bent at the elbow."""
    p = standing()
    along = np.array([-np.sin(lift), 0.0, -np.cos(lift)])
    p[J["right_elbow"]] = p[J["right_shoulder"]] + 0.27 * along
    p[J["right_wrist"]] = p[J["right_elbow"]] + 0.25 * (np.array([0.0, np.sin(elbow), 0.0]) - np.cos(elbow) * along)
    return p


def reaching(height: float, side: str = "right") -> Pose:
    """A forearm turned to the side, its fingertips ``height`` above the neck."""
    p = raised(standing(), side, swing=0.8)
    arm = [J[f"{side}_elbow"], J[f"{side}_wrist"]]
    p[arm, 2] += p[J["neck"], 2] + height - p[arm[1], 2] - 0.18 * np.cos(0.8)
    return p


def message(index: int, *poses: Pose, sigma: float = 0.01, tracking: Tracking = Tracking.OK) -> PoseWorld:
    known = [np.where(np.isfinite(p).all(axis=1), JointState.SEEN, JointState.UNKNOWN) for p in poses]
    same = {"root_orientation": np.array([0.0, 0.0, 1.0, 0.0]), "sigma": np.full(22, sigma), "tracking": tracking}
    same |= {"covariance": np.eye(6) * sigma**2}
    made = [world_body(np.nan_to_num(p), id=k, root_position=p[0], state=known[k], **same) for k, p in enumerate(poses)]
    return PoseWorld(START_NS + index * FRAME_NS, "world", "test", np.array([0.0, 0.0, 1.0, 0.0]), made)


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


@pytest.mark.parametrize(("kind", "hand", "pose", "outside", "begins", "ends", "inside"), [
    (EventKind.NEAR, Hand.NONE, standing, 2.0, 1.2, 1.4, 0.8),
    (EventKind.FACES_SENSOR, Hand.NONE, lambda a: standing() + [0, 2.5 * np.tan(a), 0], 1, 0.6, 0.8, 0.2),
    (EventKind.STANDS, Hand.NONE, lambda e: squatting(np.arccos(e)), 0.6, 0.85, 0.65, 0.95),
    (EventKind.SITS, Hand.NONE, squatting, 0.3, 0.95, 0.7, 1.2),
    (EventKind.LIES, Hand.NONE, tall, 1.0, 0.65, 0.8, 0.4),
    (EventKind.HAND_RAISED, Hand.RIGHT, reaching, -0.2, 0.0, -0.08, 0.2),
    (EventKind.HAND_RAISED, Hand.LEFT, lambda h: reaching(h, "left"), -0.2, 0.0, -0.08, 0.2),
    (EventKind.POINTS, Hand.RIGHT, pointing, 1.9, 2.4, 2.15, 2.9),
    (EventKind.POINTS, Hand.RIGHT, lambda lift: pointing(lift=lift), 0.5, 0.9, 0.9, 1.31),
])  # fmt: skip
def test_an_event_begins_alone_at_its_threshold_and_ends_at_the_laxer_one_when_crossed_for_its_hold(
    kind: EventKind, hand: Hand, pose: Callable[[float], Pose], outside: float, begins: float, ends: float,
    inside: float,
) -> None:  # fmt: skip
    hold = 5 if kind == EventKind.POINTS else 3
    inward = np.linspace(outside, inside, 97)
    found = changes(map(pose, [*[outside] * 20, *inward, *inward[::-1], *[outside] * 9]), sigma=1e-4)
    assert first(found, kind) == 20 + hold + np.argmax(np.abs(inward - outside) > abs(begins - outside))
    others = {EventKind.ENTERED, EventKind.STANDS, EventKind.FACES_SENSOR} - {kind}
    assert {(k, h) for _, k, h, _ in found if k not in others} == {(kind, hand)}
    back = np.argmax(np.abs(inward[::-1] - outside) < abs(ends - outside))
    assert first(found, kind, Phase.ENDS) == 20 + 97 + hold + back


@pytest.mark.parametrize(
    ("calibrated", "height", "hips", "guess"),
    [(True, 0.0, True, 1.0), (True, 0.6, True, 1.0), (False, 0.0, True, 1.0), (True, 0.0, False, 1.0),
     (True, 0.0, True, 1.12), (True, 0.0, True, 0.9)],
)  # fmt: skip
def test_behind_a_counter_the_height_over_the_floor_says_who_sits(calibrated: bool, height: float, hips: bool, guess):
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
        events = detector.update(world, calibrated=True) if calibrated else detector.update(world)
        found += [(index, e.kind, e.hand, e.phase) for e in events if e.phase != Phase.HOLDS]
    if calibrated:
        assert [kind for _, kind, _, phase in found if phase == Phase.BEGINS and kind != EventKind.FACES_SENSOR] == [
            EventKind.ENTERED, EventKind.STANDS, EventKind.SITS, EventKind.STANDS
        ]  # fmt: skip
        begins = first(found, EventKind.SITS)
        assert 20 < begins <= 30
    else:
        assert {EventKind.STANDS, EventKind.SITS}.isdisjoint({kind for _, kind, _, _ in found})


@pytest.mark.parametrize(
    ("swing", "hertz", "waves"), [(0.5, 1.5, True), (0.25, 1, True), (0.16, 2, False), (1, 0.5, False)]
)
def test_a_hand_that_swings_from_side_to_side_far_and_quickly_waves(swing: float, hertz: float, waves: bool) -> None:
    swings = [raised(standing(), swing=swing * np.sin(2 * np.pi * hertz * k / 30)) for k in range(90)]
    found = changes([*STILL, *[raised(standing())] * 5, *swings, *[raised(standing())] * 40])
    assert (first(found, EventKind.WAVES) <= 25 + 23 / hertz) is waves
    assert (115 < first(found, EventKind.WAVES, Phase.ENDS) < NEVER) is waves


def test_who_lies_does_nothing_else() -> None:
    waving = [raised(standing(), swing=0.5 * np.sin(k / 3)) for k in range(40)]
    for poses in ([pointing()] * 40, waving, [sitting()] * 40):
        assert {kind for _, kind, _, _ in changes([p * [1.0, 1.0, 0.2] for p in poses])} == {
            EventKind.ENTERED, EventKind.LIES,
        }  # fmt: skip


@pytest.mark.parametrize(
    ("speed", "wait_s", "fell"), [(1.25, 0, True), (1.15, 0, False), (2, 1.3, True), (2, 1.7, False)]
)
def test_a_fall_is_faster_than_12_dm_s_within_two_seconds_before_lying(speed: float, wait_s: float, fell: bool) -> None:
    heights, neck = [1.5], standing()[J["neck"], 2] / (standing()[J["head"], 2] - standing()[J["left_ankle"], 2])
    while heights[-1] > (0.9 if wait_s else 0.4):
        heights.append(heights[-1] - speed / neck / 30)
    heights += [heights[-1]] * round(30 * wait_s)
    heights += [*np.linspace(heights[-1], 0.4, 20), *[0.4] * 20]
    found = changes([*STILL, *map(tall, heights), *STILL])
    assert (first(found, EventKind.FELL) < NEVER) is fell
    assert (20 + len(heights) < first(found, EventKind.FELL, Phase.ENDS) < NEVER) is fell, "until one is up again"


@pytest.mark.parametrize("lost", [True, False])
def test_one_enters_after_a_while_and_leaves_after_another(lost: bool) -> None:
    detector, s = EventDetector(), EventSettings()
    found: list[tuple[int, Event]] = []
    for index in range(60):
        gone = message(index, standing(), tracking=Tracking.LOST) if lost else message(index)
        world = message(index, standing()) if 10 <= index < 40 else gone
        found += [(index, event) for event in detector.update(world) if event.phase != Phase.HOLDS]
    kinds = [(index, event.kind) for index, event in found if event.kind in (EventKind.ENTERED, EventKind.LEFT)]
    assert [kind for _, kind in kinds] == [EventKind.ENTERED, EventKind.LEFT]
    assert kinds[0][0] == 10 + round(s.entered * 30 + 0.5)
    assert kinds[1][0] == 39 + round(s.left * 30 + 1)
    told = [event for _, event in found if event.kind in (EventKind.ENTERED, EventKind.LEFT)]
    since = [START_NS + index * FRAME_NS for index in (10, kinds[1][0])]
    assert [(e.body, e.hand, e.confidence, e.since_ns) for e in told] == [(0, Hand.NONE, 1.0, ns) for ns in since]
    # nothing before it has entered, and nothing that holds of somebody who has left
    assert min(index for index, _ in found) == kinds[0][0]
    assert {e.kind for i, e in found if i == kinds[1][0] and e.phase == Phase.ENDS} == {
        EventKind.STANDS, EventKind.FACES_SENSOR,
    }  # fmt: skip


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
    blind[J["left_shoulder"]] = np.nan
    assert np.isnan(features(message(0, blind).bodies[0], np.zeros(3)).across).all()


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
def test_an_arm_that_moves_points_only_below_04_m_s_however_it_shakes(speed: float, points: bool) -> None:
    moving = [pointing() + [0.0, speed * frame / 30.0 + 0.02 * (frame % 2), 0.0] for frame in range(-10, 10)]
    assert (first(changes([*STILL, *moving]), EventKind.POINTS) < NEVER) is points


def test_quantities_do_not_depend_on_where_a_body_is_and_hardly_on_its_size() -> None:
    rng = np.random.default_rng(0)
    vectors, a, s = 0.4 * rng.normal(size=(22, 3)), rng.normal(size=(6, 6)), rng.uniform(size=22)
    vectors[[J["left_collar"], J["right_collar"]]] = 0.0
    local = Rotation.from_rotvec(vectors)
    p, covariance, far = fk(local.as_matrix()), a @ a.T, np.array([2.0, 0.0, 1.0])
    seen = p + [[0.4, 0.0, 0.0]] * (np.arange(22)[:, None] == J["left_shoulder"])

    def found(turn: float, size: float, shift: NDArray[np.float64]) -> Features:
        """Of the whole scene, turned about the vertical."""
        about, c = Rotation.from_euler("z", turn), covariance.copy()
        c[:3, :3] = size**2 * about.as_matrix() @ c[:3, :3] @ about.as_matrix().T
        at, root = size * about.apply(seen) + shift, (about * Rotation.from_rotvec(vectors[0])).as_quat()
        fields = {"root_orientation": root, "covariance": c, "sigma": size * s}
        return features(world_body(at, local.as_quat(), **fields), size * about.apply(p[0] + far) + shift)

    one, shift = found(0.0, 1.0, np.zeros(3)), np.array([3.0, -1.0, 0.7])
    other, about = found(2.0, 2.0, shift), Rotation.from_euler("z", 2.0)
    sides = [p[J[f"left_{part}"]] - p[J[f"right_{part}"]] for part in ("hip", "shoulder")]
    assert one.across == pytest.approx((sides[0] + sides[1])[:2], abs=1e-6), "that a shoulder is off has no effect"
    assert one.distance == pytest.approx((2.0, np.sqrt(covariance[0, 0])))
    assert other.distance == pytest.approx([2.0 * value for value in one.distance])
    assert other.extent == pytest.approx([2.0 * value for value in one.extent])
    for name in ("extension", "thigh", "trunk"):
        assert getattr(other, name) == pytest.approx(getattr(one, name)), name
    facing = facing_away(one.across, 0.1, one.to_sensor)
    assert facing_away(other.across, 0.1, other.to_sensor) == pytest.approx(facing)
    assert facing_away([2.0 * c for c in other.across], 0.2, other.to_sensor) == pytest.approx(facing)
    assert features(message(0, standing(0.0)).bodies[0], np.zeros(3)).distance == (0.0, 0.0)
    for before, after in zip(one.arms, other.arms, strict=True):
        assert after.elbow == pytest.approx(before.elbow)
        assert (after.lift, after.swing) == pytest.approx((before.lift, before.swing))
        np.testing.assert_allclose(after.direction, about.apply(before.direction), atol=1e-6)


def test_a_stream_that_begins_anew_begins_with_nobody() -> None:
    detector = EventDetector()
    for index in range(20):
        detector.update(message(index, standing()))
    again = [[e.kind for e in detector.update(message(i, standing()))] for i in range(10)]
    assert again[0] == []
    assert any(EventKind.ENTERED in kinds for kinds in again)


@given(st.lists(st.floats(-2.0, 2.0) | st.just(float("nan")), max_size=60), st.floats(0.0, 0.5))
@settings(max_examples=100, deadline=None)
def test_a_trigger_begins_above_its_threshold_only_and_ends_below_the_other_only(values: list[float], sigma: float):
    trigger = Trigger(on=0.5, margin=0.4, hold_s=0.05, confidence=0.7)
    for index, value in enumerate(values):
        before = trigger.active
        if trigger.update(index * FRAME_NS, value, sigma):
            assert trigger.active is not before
            assert value - 0.5 * sigma > 0.5 if trigger.active else value + 0.5 * sigma < 0.1
        else:
            assert trigger.active is before
        confidence = 0.0 if np.isnan(value) else NormalDist(0.3, max(sigma, 1e-9)).cdf(value)
        assert trigger.confidence == pytest.approx(confidence, abs=1e-9)


def waves(
    angles: Iterable[float], heights: Iterable[float] | None = None, upright: Callable[[float], bool] = lambda _: True
) -> list[bool]:
    """Whether a forearm at these angles waves, frame by frame, whose hand is up, at heights of metres."""
    wave, angles = Wave(EventSettings().wave_swing, EventSettings().wave_within), list(angles)
    samples = zip(angles, heights or [0.4] * len(angles), strict=True)
    return [wave.update(START_NS + k * FRAME_NS, *it, upright(it[0]), True) for k, it in enumerate(samples)]


@pytest.mark.parametrize("course", [lambda t: 0.2 * t, lambda t: 0.1 * np.sin(9 * t), lambda t: 1.0 if t > 1 else 0.0])
def test_a_forearm_that_does_not_swing_does_not_wave(course: Callable[[float], float]) -> None:
    assert not any(waves(course(k / 30) for k in range(90)))


def test_an_arm_raised_aside_and_lowered_does_not_wave() -> None:
    """Its forearm comes up from one side and goes back to it: a swing, and back, but not about upright."""
    angles = 0.6 + 0.42 * np.cos(np.linspace(0.0, 2.0 * np.pi, 40))
    assert not any(waves(angles))
    assert any(waves([*angles, *angles, *angles])), "but who does it again and again waves"


RAISED, OUT = [-0.3] * 10, np.linspace(-0.3, -0.05, 6).tolist()
BACK = np.linspace(-0.1, -0.7, 12).tolist()
"""A hand held up; its forearm swings out by a little, as the first time, and back."""


def test_a_wave_begins_when_the_forearm_is_back_from_its_first_swing_which_may_be_small() -> None:
    assert any(waves([*RAISED, *OUT, *BACK[:7]]))
    assert not any(waves([*RAISED, *OUT, *BACK[:6]]))
    assert not any(waves([*RAISED, *BACK[4:]]))
    assert not any(waves([*RAISED, *[0.5 * (angle + 0.3) - 0.3 for angle in OUT], *BACK[2:]])), "that was no swing"


def test_a_hand_that_comes_down_does_not_wave() -> None:
    heights = [*[0.4] * 16, *np.linspace(0.4, 0.2, 12)]
    assert not any(waves([*RAISED, *OUT, *BACK], heights))
    assert any(waves([*RAISED, *OUT, *BACK, *OUT], [*heights, *[0.2] * 6])), "but who swings it once more waves"


def test_a_raised_hand_that_drifts_or_jumps_while_hidden_does_not_wave() -> None:
    slow = np.linspace(-0.1, -0.52, 22).tolist()
    assert not any(waves([*RAISED, *OUT, *slow]))
    assert not any(waves([*RAISED, *OUT, *[np.nan] * 5, *[-0.7] * 10]))
    told = waves([*RAISED, *OUT, *BACK, *[np.nan] * 5, *[-0.2] * 5])
    assert all(told[told.index(True) :]), "but a wave goes on"


def test_a_forearm_that_passes_straight_down_turns_on_in_the_same_direction() -> None:
    circle = np.arange(0.0, 4.0 * np.pi, 0.2)
    assert not any(waves(np.angle(np.exp(1j * circle))))


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
    assert waves(np.nan if 3 < k % 20 < 12 else 0.5 * np.sin(9 * k / 30) for k in range(60))[-1]
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


def test_a_body_that_bends_down_neither_raises_a_hand_before_it_nor_sits() -> None:
    bent = raised(squatting(1.2))
    hips = bent[J["pelvis"]].copy()
    upper = [J[name] for name in ("spine1", "spine2", "spine3", "neck", "head")]
    bent[upper] = hips + (bent[upper] - hips) @ np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    found = changes([*STILL, *[bent] * 20])
    assert first(found, EventKind.HAND_RAISED) == first(found, EventKind.SITS) == NEVER


def test_who_waves_with_the_whole_arm_begins_to_wave_once() -> None:
    told = waves((1.3 * np.sin(9 * k / 30) for k in range(120)), upright=lambda angle: abs(angle) < 1.0)
    begun = told.index(True)
    assert begun < 60
    assert all(told[begun:])


def test_a_wave_is_over_when_the_hand_is_down_though_it_comes_up_again() -> None:
    wave = Wave(EventSettings().wave_swing, EventSettings().wave_within)
    assert [wave.update(k * FRAME_NS, 0.5 * np.sin(9 * k / 30), 0.4, True, True) for k in range(60)][-1]
    assert not wave.update(60 * FRAME_NS, 0.0, 0.4, False, False), "the hand is down"
    assert not wave.update(61 * FRAME_NS, 0.0, 0.4, True, True), "and up again"


@pytest.mark.parametrize(
    ("name", "value"), [("near", -1), ("hold", 61), ("confidence", 0.4), ("confidence", 1), ("faces", 4)]
)
def test_a_threshold_that_cannot_be_is_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        dataclasses.replace(EventSettings(), **{name: value})
