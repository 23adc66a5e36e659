import itertools
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from conftest import raw, walk
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from tests.helpers.synthetic_poses import walker

from steadypose.msgs.topics import POSE_RAW, are_unit, broken
from steadypose.msgs.types import JointState, Message, Pose, PoseClean, PoseRaw, PoseWorld, RawBody
from steadypose.nodes.driving import stream
from steadypose.nodes.graph.prior_node import make_prior
from steadypose.nodes.graph.relay import CONTEXT
from steadypose.nodes.graph.trajectory_node import make_trajectory
from steadypose.prior.clean.pipeline import PriorPipeline
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.world.pipeline import TrajectoryPipeline
from steadypose.prior.world.settings import TrajectorySettings

FRAMES, BAD = 42, 7
BASE = walk(FRAMES)
SHORT, BEFORE, SPOILT = BASE[:12], 5, 3
"""a short stream, in which so many good frames come before so many bad ones"""
Spoil = Callable[[PoseRaw], PoseRaw]


@pytest.fixture(scope="module")
def reference() -> dict[int, PoseWorld]:
    return worlds(outputs(BASE)[0])


def outputs(frames: list[PoseRaw]) -> tuple[list[Message], Counter[str]]:
    prior, trajectory = make_prior({}), make_trajectory({})
    messages = [message for _, message in stream([(POSE_RAW, frame) for frame in frames], prior, trajectory)]
    return messages, prior.counters + trajectory.counters


def worlds(messages: list[Message]) -> dict[int, PoseWorld]:
    return {m.stamp_ns: m for m in messages if isinstance(m, PoseWorld) and m.bodies}


def check_promises(messages: list[Message], *, restarts: bool = False) -> None:
    for kind in () if restarts else (PoseClean, PoseWorld):
        stamps = [m.stamp_ns for m in messages if isinstance(m, kind) and not m.end_of_stream]
        assert all(later > before for before, later in itertools.pairwise(stamps)), "stamps rise"
    for message in messages:
        if isinstance(message, PoseClean | PoseWorld):
            assert [broken(body) for body in message.bodies if broken(body)] == []
        if isinstance(message, PoseClean) and message.bodies:
            assert np.isfinite(message.sensor_pose.position).all()
            assert are_unit(message.sensor_pose.orientation).all()


def with_pose(position: float, orientation: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)) -> Spoil:
    pose = Pose(np.full(3, position), np.array(orientation))
    return lambda frame: replace(frame, sensor_pose=pose)


def scaled(factor: float) -> Spoil:
    def scale(frame: PoseRaw) -> PoseRaw:
        bodies = [replace(body, positions=body.positions * factor) for body in frame.bodies]
        return replace(frame, bodies=bodies)

    return scale


def with_body(positions: object, confidence: object = 1.0) -> Spoil:
    joints = np.asarray(positions, np.float32)
    return lambda frame: replace(frame, bodies=[RawBody(0, joints, np.broadcast_to(confidence, len(joints)))])  # type: ignore[arg-type]


def with_bodies(*ids: int) -> Spoil:
    return lambda frame: replace(frame, bodies=[replace(frame.bodies[0], id=id) for id in ids])


def spoil(change: Spoil) -> list[PoseRaw]:
    """Good frames, some spoilt ones, good frames."""
    return [change(frame) if BEFORE <= k < BEFORE + SPOILT else frame for k, frame in enumerate(SHORT)]


def set_by(seconds: float, *, once: bool = False) -> list[PoseRaw]:
    """A stream whose clock is set by so many seconds, for good or for one frame."""
    late = range(BEFORE, BEFORE + 1 if once else len(SHORT))
    step_ns = round(seconds * 1e9)
    return [replace(frame, stamp_ns=frame.stamp_ns + step_ns * (k in late)) for k, frame in enumerate(SHORT)]


WALKING = SHORT[3].bodies[0].positions
STREAMS: dict[str, tuple[list[PoseRaw], dict[str, int]]] = {
    "nan": (spoil(with_body(np.full((22, 3), np.nan))), {}),
    "infinite": (spoil(with_body(np.full((22, 3), np.inf))), {}),
    "one joint infinite": (spoil(with_body(np.vstack([np.full((1, 3), np.inf), WALKING[1:]]))), {}),
    "as large as numbers go": (spoil(with_body(np.full((22, 3), 3e38))), {"joints_too_far": 22 * SPOILT}),
    "confidence nan": (spoil(with_body(WALKING, np.nan)), {}),
    "confidence out of range": (spoil(with_body(WALKING, -1e30)), {}),
    "all joints in one point": (spoil(with_body(np.zeros((22, 3)))), {"body_too_small": SPOILT}),
    "no bodies": (spoil(with_bodies()), {}),
    "the same body twice": (spoil(with_bodies(0, 0)), {"body_id_repeated": SPOILT}),
    "end of the stream twice": ([*SHORT[:5], *[replace(raw(6), end_of_stream=True)] * 2, *SHORT[6:]], {}),
    "ten kilometres away": (spoil(with_body(np.full((22, 3), 10_000.0))), {"joints_too_far": 22 * SPOILT}),
    "no joints": (spoil(with_body(np.zeros((0, 3)))), {"wrong_joint_count": SPOILT}),
    "too few joints": (spoil(with_body(np.zeros((17, 3)))), {"wrong_joint_count": SPOILT}),
    "too many joints": (spoil(with_body(np.zeros((1000, 3)))), {"wrong_joint_count": SPOILT}),
    "a hundred bodies": (spoil(with_bodies(*range(100))), {"too_many_bodies": 92 * SPOILT}),
    "unknown skeleton": (spoil(lambda frame: replace(frame, skeleton="octopus8")), {"unknown_skeleton": SPOILT}),
    "sensor pose nan": (spoil(with_pose(np.nan, (np.nan,) * 4)), {"sensor_pose_invalid": SPOILT}),
    "sensor pose zero": (spoil(with_pose(0.0, (0.0,) * 4)), {"sensor_pose_invalid": SPOILT}),
    "stamps repeat": ([frame for frame in SHORT for _ in range(2)], {"stamp_repeated": 12}),
    "stamps all the same": (
        [*(replace(f, stamp_ns=SHORT[0].stamp_ns) for f in SHORT[:BEFORE]), *SHORT[BEFORE:]],
        {"stamp_repeated": BEFORE - 1},
    ),
    "an hour back, for good": (set_by(-3600.0), {"stamp_jumped_back": 2}),  # by the prior, and by the trajectory
    "an hour back, once": (set_by(-3600.0, once=True), {"stamp_outlier": 1}),
    "an hour ahead, once": (set_by(3600.0, once=True), {"stamp_outlier": 1}),
    "stopped for ten seconds": (set_by(10.0), {"stream_gap": 1}),
    "out of order": ([frame for k in range(0, 12, 2) for frame in (SHORT[k + 1], SHORT[k])], {"stamp_out_of_order": 6}),
}


@pytest.mark.parametrize("kind", STREAMS)
def test_a_good_frame_after_bad_ones_is_answered(kind: str) -> None:
    frames, counted = STREAMS[kind]
    messages, counts = outputs(frames)
    assert counts == counted
    check_promises(messages, restarts=kind.startswith("an hour back"))
    for of in (PoseClean, PoseWorld):
        last = [m for m in messages if isinstance(m, of) and not m.end_of_stream][-1]
        assert last.bodies
        assert abs(last.stamp_ns - frames[-1].stamp_ns) < 60_000_000
    cleaned = [body for m in messages if isinstance(m, PoseClean) for body in m.bodies]
    assert all(np.isfinite(body.positions).all() for body in cleaned)
    assert all(np.abs(body.positions).max() < 100 for body in cleaned), "nothing made up of what is not plausible"


ONE_BAD_FRAME: dict[str, Spoil] = {
    "a sensor at 1e300": with_pose(1e300),
    "a sensor at 1e20": with_pose(1e20),
    "a sensor at a kilometre": with_pose(1e3),
    "a sensor at two metres": with_pose(2.0),
    "a sensor upside down": with_pose(0.0, (1.0, 0.0, 0.0, 0.0)),
    "a body twice as large": scaled(2.0),
    "a body five times as large": scaled(5.0),
    "a body in one point": scaled(0.0),
}


@pytest.mark.parametrize("kind", ONE_BAD_FRAME)
def test_one_bad_frame_is_over_within_a_second(kind: str, reference: dict[int, PoseWorld]) -> None:
    frames = [ONE_BAD_FRAME[kind](frame) if k == BAD else frame for k, frame in enumerate(BASE)]
    messages, _ = outputs(frames)
    check_promises(messages)
    found = worlds(messages)
    assert BASE[-1].stamp_ns - max(found) < 60_000_000
    after = BASE[BAD].stamp_ns + 1_000_000_000
    off = {
        stamp: float(np.abs(world.bodies[0].positions - reference[stamp].bodies[0].positions).max())
        for stamp, world in found.items()
        if stamp > after
    }
    assert len(off) >= 4
    assert max(off.values()) < 0.1


@pytest.mark.parametrize(
    ("factor", "cause"), [(0.1, ""), (0.3, ""), (2, ""), (2.4, ""), (3, "body_too_large"), (0, "body_too_small")]
)
def test_a_body_of_another_size_is_known_or_said_not_to_be_and_one_that_nobody_is_refused(factor: float, cause: str):
    messages, counts = outputs([scaled(factor)(frame) for frame in BASE[:12]])
    check_promises(messages)
    bodies = [body for m in messages if isinstance(m, PoseWorld) for body in m.bodies]
    assert bool(bodies) == (not cause)
    assert counts[cause] == (12 if cause else 0)
    for body in bodies:
        unknown = ~np.isfinite(body.positions).all(axis=1)
        assert (body.state[unknown] == JointState.UNKNOWN).all()


def test_a_sensor_that_was_put_elsewhere_is_believed_there_soon() -> None:
    moved = [with_pose(5.0)(frame) if k >= BAD else frame for k, frame in enumerate(BASE)]
    messages, counts = outputs(moved)
    check_promises(messages)
    assert counts["sensor_moved"] == 1
    assert counts["sensor_pose_jumped"] == 7, "a fifth of a second"
    last = worlds(messages)[max(worlds(messages))].bodies[0].root_position
    np.testing.assert_allclose(last, moved[-1].bodies[0].positions[0] + 5.0, atol=0.1)


def test_a_sensor_that_moves_is_never_doubted() -> None:
    frames = []
    for k, frame in enumerate(BASE):
        turned = np.array([0.0, 0.0, np.sin(0.1 * k), np.cos(0.1 * k)])
        frames.append(replace(frame, sensor_pose=Pose(np.array([0.15 * k, 0.0, 0.0]), turned)))  # 4.5 m/s and 6 rad/s
    assert not outputs(frames)[1]["sensor_pose_jumped"]


NUMBERS = st.one_of(
    st.sampled_from([np.nan, np.inf, -np.inf, 0.0, -0.0, 1e-300, 1e300, 3.4e38, 1e20, -1e3, 29.9, 30.1, 1e4]),
    st.floats(-5.0, 5.0),
)
STAMP_STEPS = st.sampled_from([33_333_333] * 12 + [0, 1, 10_000_000, -33_333_333, 400_000_000, 700_000_000])


@st.composite
def evil_frames(draw: st.DrawFn) -> list[PoseRaw]:
    """Good frames, among which some have any number anywhere, any pose of the sensor, any number of bodies."""
    stamp, frames = BASE[0].stamp_ns, []
    for k in range(draw(st.integers(6, 12))):
        stamp += draw(STAMP_STEPS)
        frame = BASE[k]
        bodies = list(frame.bodies)
        kind = draw(st.sampled_from(["good"] * 5 + ["joints", "scale", "pose", "bodies", "confidence"]))
        pose = frame.sensor_pose
        if kind == "joints":
            positions = bodies[0].positions.copy()
            for _ in range(draw(st.integers(1, 22))):
                positions[draw(st.integers(0, 21)), draw(st.integers(0, 2))] = draw(NUMBERS)
            bodies = [replace(bodies[0], positions=positions)]
        elif kind == "scale":
            bodies = scaled(draw(st.sampled_from([-1.0, 0.0, 0.1, 2.0, 7.0, 1e6])))(frame).bodies
        elif kind == "pose":
            pose = Pose(np.array([draw(NUMBERS) for _ in range(3)]), np.array([draw(NUMBERS) for _ in range(4)]))
        elif kind == "bodies":
            ids = draw(st.lists(st.integers(-3, 3), max_size=6))
            bodies = [replace(bodies[0], id=i) for i in ids]
        elif kind == "confidence":
            bodies = [replace(bodies[0], confidence=np.array([draw(NUMBERS) for _ in range(22)]))]
        frames.append(replace(raw(k), stamp_ns=max(stamp, 0), sensor_pose=pose, bodies=bodies))
    return frames


@given(evil_frames())
@settings(max_examples=10, deadline=None)
def test_what_goes_out_keeps_its_promises_whatever_comes_in(frames: list[PoseRaw]) -> None:
    check_promises(outputs(frames)[0])


KILLED, ACCEPT_AFTER = CONTEXT + 50, CONTEXT + 100


def positions(messages: list[PoseClean] | list[PoseWorld]) -> NDArray[np.float32]:
    """(ACCEPT_AFTER - KILLED - 10, 22, 3) metres, from the kill on."""
    end = messages[-1].stamp_ns - round(10 / 30 * 1e9)
    begin = end - round((ACCEPT_AFTER - KILLED - 10) / 30 * 1e9)
    return np.array([m.bodies[0].positions for m in messages if begin < m.stamp_ns + 1000 <= end + 2000])


@pytest.mark.slow
def test_who_begins_anew_is_a_little_off_and_no_worse() -> None:
    frames = walk(ACCEPT_AFTER)

    def cleaned(given: list[PoseRaw]) -> list[PoseClean]:
        pipeline = PriorPipeline(PriorSettings())
        return [clean for raw in given for clean in pipeline.process(raw)]

    def placed(given: list[PoseClean]) -> list[PoseWorld]:
        pipeline = TrajectoryPipeline(TrajectorySettings())
        return [world for clean in given for world in pipeline.process(clean)]

    clean = cleaned(frames)
    going_on, anew = positions(clean), positions(cleaned(frames[KILLED - CONTEXT :]))
    assert going_on.shape == anew.shape
    off = np.linalg.norm(anew - going_on, axis=2)
    first = round((clean[0].stamp_ns - frames[0].stamp_ns) * 30 / 1e9) + len(clean) - 10 - len(anew)
    true = np.array([walker((first + k) / 30)[0] for k in range(len(anew))])
    errors = [np.linalg.norm(found - true, axis=2).mean() for found in (going_on, anew)]
    assert np.median(off) < 2e-3  # bones are measured on other seconds
    assert off.max() < 1e-2
    assert errors[1] < 1.08 * errors[0]
    world = placed(clean)
    off = np.linalg.norm(positions(placed(clean[KILLED - CONTEXT :])) - positions(world), axis=2)
    assert off.max() < 1e-3
