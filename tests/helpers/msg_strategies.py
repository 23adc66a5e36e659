"""Any message that can be: hypothesis strategies, and one plain example of each."""

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from steadypose.msgs.topics import DIAGNOSTICS, POSE_CLEAN, POSE_EVENTS, POSE_RAW, POSE_TRUTH, POSE_WORLD
from steadypose.msgs.types import (
    CleanBody,
    Diagnostics,
    Event,
    EventKind,
    Hand,
    Level,
    Phase,
    Pose,
    PoseClean,
    PoseEvents,
    PoseRaw,
    PoseWorld,
    RawBody,
    Tracking,
    WorldBody,
)

STAMPS = st.integers(0, 2**31 * 10**9 - 1)
IDS = st.integers(-(2**31), 2**31 - 1)
TEXTS = st.text(max_size=12)


def f32(*shape: int):
    return arrays(np.float32, shape, elements=st.floats(width=32))


def f64(*shape: int):
    return arrays(np.float64, shape, elements=st.floats())


STATES = arrays(np.uint8, 22, elements=st.integers(0, 3))
POSES = st.builds(Pose, f64(3), f64(4))


@st.composite
def raw_bodies(draw: st.DrawFn) -> RawBody:
    joints = draw(st.integers(0, 40))
    return RawBody(draw(IDS), draw(f32(joints, 3)), draw(f32(joints)))


CLEAN_BODIES = st.builds(
    CleanBody,
    id=IDS,
    positions=f32(22, 3),
    rotations=f32(22, 4),
    state=STATES,
    sigma=f32(22),
    anomaly=st.floats(),
    anomaly_flag=st.booleans(),
    joint_anomaly=f32(22),
    bone_lengths=f32(22),
    raw_positions=f32(22, 3),
    raw_confidence=f32(22),
)
WORLD_BODIES = st.builds(
    WorldBody,
    id=IDS,
    root_position=f64(3),
    root_orientation=f64(4),
    root_velocity=f64(3),
    covariance=f64(6, 6),
    positions=f32(22, 3),
    rotations=f32(22, 4),
    state=STATES,
    sigma=f32(22),
    contacts=f32(8),
    tracking=st.sampled_from(Tracking),
)
RAW = st.builds(
    PoseRaw,
    stamp_ns=STAMPS,
    frame_id=TEXTS,
    source=TEXTS,
    skeleton=TEXTS,
    sensor_pose=POSES,
    calibrated=st.booleans(),
    bodies=st.lists(raw_bodies(), max_size=3),
    end_of_stream=st.booleans(),
)
CLEAN = st.builds(
    PoseClean,
    stamp_ns=STAMPS,
    frame_id=TEXTS,
    source=TEXTS,
    sensor_pose=POSES,
    calibrated=st.booleans(),
    delay_frames=st.integers(0, 2**32 - 1),
    bodies=st.lists(CLEAN_BODIES, max_size=2),
    end_of_stream=st.booleans(),
)
WORLD = st.builds(
    PoseWorld,
    stamp_ns=STAMPS,
    frame_id=TEXTS,
    source=TEXTS,
    ground_plane=f64(4),
    bodies=st.lists(WORLD_BODIES, max_size=2),
    end_of_stream=st.booleans(),
)
EVENTS = st.builds(
    PoseEvents,
    stamp_ns=STAMPS,
    frame_id=TEXTS,
    source=TEXTS,
    events=st.lists(
        st.builds(
            Event,
            body=IDS,
            kind=st.sampled_from(EventKind),
            phase=st.sampled_from(Phase),
            hand=st.sampled_from(Hand),
            confidence=st.floats(),
            direction=f64(3),
            since_ns=STAMPS,
        ),
        max_size=3,
    ),
    end_of_stream=st.booleans(),
)
DIAGNOSIS = st.builds(
    Diagnostics,
    stamp_ns=STAMPS,
    node=TEXTS,
    level=st.sampled_from(Level),
    message=TEXTS,
    values=st.dictionaries(TEXTS, TEXTS, max_size=4),
)
ANY = st.one_of(
    st.tuples(st.just(POSE_RAW), RAW),
    st.tuples(st.just(POSE_CLEAN), CLEAN),
    st.tuples(st.sampled_from([POSE_WORLD, POSE_TRUTH]), WORLD),
    st.tuples(st.just(POSE_EVENTS), EVENTS),
    st.tuples(st.just(DIAGNOSTICS), DIAGNOSIS),
)


def raw(stamp_ns: int = 0, joints: int = 32, bodies: int = 1) -> PoseRaw:
    positions = np.arange(3 * joints).reshape(joints, 3)
    body = [RawBody(n, positions + n, np.ones(joints)) for n in range(bodies)]
    return PoseRaw(stamp_ns, "camera", "test", "azure_kinect32", Pose.from_up("-y"), False, body)


def clean(stamp_ns: int = 0) -> PoseClean:
    joints = np.arange(66).reshape(22, 3)
    body = CleanBody(
        7, joints, np.ones((22, 4)), np.full(22, 2), np.ones(22), 0.5, True, np.ones(22), np.ones(22), joints * np.nan,
        np.zeros(22),
    )  # fmt: skip
    return PoseClean(stamp_ns, "camera", "test", Pose.from_up("-y"), False, 4, [body])


def world(stamp_ns: int = 0) -> PoseWorld:
    joints = np.arange(66).reshape(22, 3)
    body = WorldBody(
        id=7,
        root_position=np.arange(3),
        root_orientation=np.array([0, 0, 0, 1]),
        root_velocity=np.arange(3),
        covariance=np.arange(36).reshape(6, 6),
        positions=joints,
        rotations=np.ones((22, 4)),
        state=np.full(22, 3),
        sigma=np.ones(22),
        contacts=np.ones(8),
        tracking=Tracking.COASTING,
    )
    return PoseWorld(stamp_ns, "world", "test", np.array([0, 0, 1, 0]), [body])


def events(stamp_ns: int = 0) -> PoseEvents:
    event = Event(7, EventKind.POINTS, Phase.BEGINS, Hand.LEFT, 0.9, np.array([1, 0, 0]), stamp_ns)
    return PoseEvents(stamp_ns, "world", "test", [event])


def diagnostics(stamp_ns: int = 0) -> Diagnostics:
    return Diagnostics(stamp_ns, "prior", Level.WARN, "3 dropped or refused", {"rate": "30.0", "refused.nan": "3"})


EXAMPLES = {
    POSE_RAW: raw(),
    POSE_CLEAN: clean(),
    POSE_WORLD: world(),
    POSE_EVENTS: events(),
    POSE_TRUTH: world(),
    DIAGNOSTICS: diagnostics(),
}
