import re
from pathlib import Path

import numpy as np
import pytest
from tests.nodes.conftest import walked

import steadypose
from steadypose import CONTACTS, JOINTS, JointState, PoseClean, PoseWorld
from steadypose.nodes.driving import stream
from steadypose.nodes.graph.prior_node import make_prior
from steadypose.nodes.graph.trajectory_node import make_trajectory
from steadypose.nodes.library.poses import ByName, Poses
from steadypose.nodes.sources.npz import ArraySource

FRAMES, DELAY = 30, 2
STAMPS = 10**18 + np.round(np.arange(FRAMES) * 1e9 / 30).astype(np.int64)
NODES = Path(__file__).parents[2] / "nodes"


@pytest.fixture(scope="module")
def joints() -> np.ndarray:
    """(T, 2, 22, 3) metres, z up; the second body comes later, and the first hides a wrist for a while."""
    found = walked(FRAMES, bodies=2)
    found[10:20, 0, 20] = np.nan
    found[:12, 1] = np.nan
    return found


@pytest.fixture(scope="module")
def first_alone(joints: np.ndarray) -> list[Poses]:
    return frame_by_frame(joints[:, 0])


def frame_by_frame(joints: np.ndarray, **more) -> list[Poses]:
    cleaner = steadypose.Filter(delay=DELAY)
    found = [pose for frame, ns in zip(joints, STAMPS, strict=True) if (pose := cleaner(frame, stamp_ns=ns, **more))]
    return found + cleaner.flush()


def test_it_gives_what_the_nodes_publish_and_what_clean_gives(joints: np.ndarray, first_alone: list[Poses]) -> None:
    alone, found = joints[:, 0], first_alone
    arrays = {"positions": alone, "stamp_ns": STAMPS, "skeleton": np.array("smpl22")}
    messages = [m for _, m in stream(ArraySource(Path("x"), arrays), make_prior({"delay": DELAY}), make_trajectory({}))]
    cleans = [m for m in messages if isinstance(m, PoseClean) and m.bodies]
    worlds = [m for m in messages if isinstance(m, PoseWorld) and m.bodies]
    assert len(found) == len(cleans) == len(worlds) == FRAMES
    for pose, clean, world in zip(found, cleans, worlds, strict=True):
        assert pose.stamp_ns == clean.stamp_ns
        for name in ("positions", "rotations", "state", "sigma", "anomaly", "anomaly_flag", "joint_anomaly"):
            np.testing.assert_array_equal(pose[name], getattr(clean.bodies[0], name), err_msg=name)
        np.testing.assert_array_equal(pose.world, world.bodies[0].positions)
        np.testing.assert_array_equal(pose.contacts, world.bodies[0].contacts)
        np.testing.assert_array_equal(pose.root_velocity, world.bodies[0].root_velocity)
    offline = steadypose.clean(alone, stamp_ns=STAMPS, delay=DELAY)
    assert set(offline) == set(found[0])
    for name in ("positions", "world_positions", "sigma", "state", "contacts", "anomaly_flag"):
        rows = np.array([pose[name] for pose in found])
        np.testing.assert_allclose(rows, offline[name], atol=1e-6, err_msg=name)  # stamps are whole nanoseconds


def test_none_until_the_delay_is_full_and_while_nobody_is_there(joints: np.ndarray) -> None:
    cleaner = steadypose.Filter(delay=3)
    found = [cleaner(frame, k / 30) for k, frame in enumerate(joints[:10, 0])]
    assert [pose is None for pose in found] == [True] * 3 + [False] * 7
    assert len(cleaner.flush()) == 3
    assert cleaner.flush() == []
    left = [cleaner(frame if k < 20 else [], 1 + k / 30) for k, frame in enumerate(joints[:24, 0])]
    assert left[20]["positions"].shape == (22, 3), "of the form of those who were there"  # type: ignore[index]
    empty = steadypose.Filter()
    assert [empty([], k / 30) for k in range(10)] == [None] * 10


def test_bodies_keep_their_numbers(joints: np.ndarray, first_alone: list[Poses]) -> None:
    found = frame_by_frame(joints, ids=[7, 3])
    assert found[0].body_id.tolist() == [7]
    last = found[-1]
    assert sorted(last.body_id.tolist()) == [3, 7]
    assert last["positions"].shape == (2, 22, 3)
    alone = first_alone[-1]
    np.testing.assert_array_equal(last.bodies[7].positions, alone.positions)
    np.testing.assert_array_equal(last.bodies[7]["anomaly"], alone["anomaly"])
    assert last.positions["head"].shape == (2, 3)


def test_joints_by_name_or_number_also_of_many_moments(first_alone: list[Poses]) -> None:
    pose = first_alone[16]
    wrist = JOINTS.index("left_wrist")
    np.testing.assert_array_equal(pose.positions["left_wrist"], pose["positions"][wrist])
    np.testing.assert_array_equal(pose.positions[wrist], pose["positions"][wrist])
    np.testing.assert_array_equal(pose.positions[["head", "neck"]], pose["positions"][[15, 12]])
    assert pose.state["left_wrist"] == JointState.IMPUTED
    assert pose.sigma["left_wrist"] > pose.sigma["right_wrist"]
    assert pose.contacts["left_foot"] == pose["contacts"][CONTACTS.index("left_foot")]
    assert pose.rotations["pelvis"].shape == (4,)
    assert (2 * pose.positions)["head"].shape == (3,), "what has the same shape has the same joints"
    with pytest.raises(KeyError, match="expected one of pelvis, left_hip"):
        pose.positions["nose"]
    with pytest.raises(KeyError, match="the axis of joints is gone"):
        pose.positions.mean(axis=0)["head"]
    named = ByName.of(np.arange(22 * 22 * 3.0).reshape(22, 22, 3), JOINTS, -2)
    np.testing.assert_array_equal(named["head"], np.asarray(named)[:, 15])
    assert type(named[0]) is np.ndarray


def test_a_slow_camera_completes_several_at_a_call(joints: np.ndarray) -> None:
    cleaner = steadypose.Filter(delay=0)
    found = [cleaner.update(frame, k / 15) for k, frame in enumerate(joints[:10, 0])]
    assert sum(map(len, found)) + len(cleaner.flush()) == 19
    assert max(map(len, found)) == 2


def test_a_layout_of_ones_own(joints: np.ndarray) -> None:
    alone = joints[:12, 0]
    order = np.random.default_rng(0).permutation(22)
    names = [JOINTS[joint] for joint in order]
    own = [f"my_{name}" for name in names]
    table = {name: f"my_{name}" for name in JOINTS}
    expected = steadypose.clean(alone, fps=30)["positions"]
    for skeleton in (names, {"joints": own, "canonical": table}):
        given = steadypose.clean(alone[:, order], fps=30, skeleton=skeleton)
        np.testing.assert_allclose(given["positions"], expected, atol=1e-6)
    with pytest.raises(ValueError, match="expected one of smpl22") as raised:
        steadypose.Filter(skeleton="mine")
    assert "own_" not in str(raised.value)
    with pytest.raises(ValueError, match="expected to find left_hip"):
        steadypose.Filter(skeleton=["a", "b"])


def test_a_frame_that_cannot_be_used_leaves_the_stream_as_it_was(joints: np.ndarray, first_alone: list[Poses]) -> None:
    alone = joints[:, 0]
    cleaner = steadypose.Filter(delay=DELAY)
    found = []
    for k, (frame, ns) in enumerate(zip(alone, STAMPS, strict=True)):
        if k == 15:
            with pytest.raises(ValueError, match=r"expected \(22, 3\) metres"):
                cleaner(frame[:17], stamp_ns=ns)
            with pytest.raises(ValueError, match="different integers of 32 bits, one a body"):
                cleaner(joints[k], stamp_ns=ns, ids=[1, 1])
            with pytest.raises(ValueError, match=r"expected steadypose\.Pose"):
                cleaner(frame, stamp_ns=ns, sensor_pose=np.eye(4))  # type: ignore[arg-type]
        found += cleaner.update(frame, stamp_ns=ns)
    found += cleaner.flush()
    assert len(found) == len(first_alone)
    np.testing.assert_array_equal(found[-1]["positions"], first_alone[-1]["positions"])


def test_a_camera_that_moves_says_where_it_is_with_every_frame(joints: np.ndarray) -> None:
    """One that came once would go on to count, although the camera is elsewhere by then."""
    place = steadypose.Pose(np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.0, 0.0, 1.0]))
    stands, moves = steadypose.Filter(delay=0, sensor_pose=place), steadypose.Filter(delay=0)

    def away(pose: Poses | None) -> np.ndarray:
        assert pose is not None
        return pose.world["head"] - pose.positions["head"]

    found = [away(stands(frame, k / 30)) for k, frame in enumerate(joints[:20, 0])]
    np.testing.assert_allclose(found[-1], [1, 2, 3], atol=0.15)
    moves(joints[0, 0], 0.0, sensor_pose=place)
    with pytest.raises(ValueError, match="expected one with every frame"):
        moves(joints[1, 0], 1 / 30)
    np.testing.assert_allclose(away(moves(joints[1, 0], 1 / 30, sensor_pose=place)), [1, 2, 3], atol=0.15)
    moves.flush()
    moves(joints[2, 0], 2 / 30)
    np.testing.assert_allclose(away(moves(joints[3, 0], 3 / 30)), [0, 0, 0], atol=0.15)


def test_the_library_is_above_all_commands() -> None:
    own = re.compile(r"^\s*(from|import) steadypose\.nodes\.library", re.MULTILINE)
    others = [file for file in NODES.rglob("*.py") if NODES / "library" not in file.parents]
    assert not [file for file in others if own.search(file.read_text())]


def test_all_public_names_are_there() -> None:
    assert set(steadypose.__all__) <= set(dir(steadypose))
    for name in steadypose.__all__:
        assert getattr(steadypose, name) is not None
    assert re.fullmatch(r"\d+\.\d+\.\d+", steadypose.__version__)
    assert (steadypose.PACKAGE / "py.typed").exists()
