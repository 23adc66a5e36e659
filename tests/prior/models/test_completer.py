from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp
from test_hmvae import prepared
from tests.helpers.bodies import random_pose, waving

from steadypose.prior.body.bone_lengths import estimate_offsets
from steadypose.prior.body.inverse_kinematics import place_joints, solve_rotations
from steadypose.prior.body.kinematics import rotation_matrices
from steadypose.prior.body.skeleton import REST_OFFSETS, J
from steadypose.prior.complete.body import frames_since_and_until
from steadypose.prior.models import completer_features
from steadypose.prior.models.completer import LiveCompleter
from steadypose.prior.models.completer_features import CompleterConfig, correction_share, read_window, solved_rotations
from steadypose.prior.models.line import anchored, draw_line
from steadypose.prior.models.weights import WeightsError
from steadypose.training.data.dataset import MotionSet
from steadypose.training.loop import TrainingOptions
from steadypose.training.recipes.completer import Completer, Truth, calibrate, masks, predict, train_completer
from steadypose.training.weights import arrays_of

SMALL = CompleterConfig(width=16, heads=2, layers=2)
USUAL = np.tile([0.0, 0.0, 0.0, 1.0], (22, 1))


def network(config: CompleterConfig = SMALL) -> Completer:
    """Untrained, and loud: what it says is no small matter."""
    torch.manual_seed(0)
    model = Completer(config).eval()
    with torch.no_grad():
        model.write.weight.mul_(40.0)
    return model


@given(seed=st.integers(0, 10_000), gap=st.integers(1, 20), context=st.integers(2, 8))
@settings(max_examples=25, deadline=None)
def test_whatever_the_network_says_what_is_known_stays(seed: int, gap: int, context: int) -> None:
    positions, offsets = waving(gap + context), REST_OFFSETS
    known = masks(1, gap, context, np.random.default_rng(seed))[0]
    seen = np.where(known[..., None], positions, np.nan)
    live = LiveCompleter(SMALL, arrays_of(network()))
    rotations, root = live(seen[None], offsets[None])
    solved, sure = solved_rotations(seen, offsets, rotation_matrices(USUAL))
    assert np.isfinite(rotations).all()
    assert np.allclose(rotations[0][sure], solved[sure], atol=1e-6)
    assert np.allclose(root[0][known[:, 0]], positions[known[:, 0], 0], atol=1e-9)
    assert np.allclose(rotations @ rotations.swapaxes(-1, -2), np.eye(3), atol=1e-9)


def test_the_answer_turns_and_moves_with_the_body() -> None:
    positions, offsets = waving(40), REST_OFFSETS
    seen = positions.copy()
    seen[10:30] = np.nan
    seen[:, [J["left_elbow"], J["left_wrist"]]] = np.nan
    turn = Rotation.from_euler("z", 2.0).as_matrix()
    live = LiveCompleter(SMALL, arrays_of(network()))
    rotations, root = live(seen[None], offsets[None])
    turned, moved = live(seen[None] @ turn.T + [3.0, -2.0, 0.5], offsets[None])
    assert np.allclose(moved, root @ turn.T + [3.0, -2.0, 0.5], atol=1e-4)
    assert np.allclose(turned[:, :, 0], turn @ rotations[:, :, 0], atol=1e-4)
    assert np.allclose(turned[:, :, 1:], rotations[:, :, 1:], atol=1e-4)


def test_the_live_form_gives_what_the_network_gives() -> None:
    model = network()
    live = LiveCompleter(SMALL, arrays_of(model))
    x = np.random.default_rng(0).standard_normal((3, 70, completer_features.FEATURES)).astype(np.float32)
    assert np.allclose(live.forward(x), model(torch.from_numpy(x)).detach().numpy(), atol=1e-4)
    positions, offsets = waving(30), REST_OFFSETS
    seen = np.stack([positions, positions])
    seen[0, 8:25], seen[1, :, 16:] = np.nan, np.nan
    both = np.stack([offsets, offsets])
    window = read_window(seen, both, USUAL)
    rotations, root = (part.detach().double().numpy() for part in predict(model, window))
    live_rotations, live_root = live(seen, both)
    live_rotations[:, :, 0] = window.turn.swapaxes(1, 2)[:, None] @ live_rotations[:, :, 0]
    assert np.allclose(rotations, live_rotations, atol=1e-4)
    assert np.allclose(root, (live_root - window.origin[:, None]) @ window.turn, atol=1e-4)


def test_the_line_is_slerp_and_lerp_and_its_bend_makes_it_a_cubic() -> None:
    rng = np.random.default_rng(3)
    poses = random_pose(rng, 4, 0.2)
    local = np.stack([Slerp([0, 30], Rotation.from_matrix(poses[:2, j]))(range(31)).as_matrix() for j in range(22)], 1)
    root = np.cumsum(rng.normal(0.0, 0.02, (31, 3)), axis=0)
    joints = place_joints(local, REST_OFFSETS) + root[:, None]
    seen = joints.copy()
    seen[10:25] = np.nan
    window = read_window(seen[None], REST_OFFSETS[None], USUAL)
    solved = solve_rotations(joints, REST_OFFSETS)
    back = window.rotations[0].copy()
    back[:, 0] = window.turn[0] @ back[:, 0]
    for joint in range(22):
        ends = Rotation.from_matrix(solved[[9, 25], joint])
        assert np.allclose(back[:, joint][9:26], Slerp([9, 25], ends)(np.arange(9, 26)).as_matrix(), atol=1e-6)
    way = window.root[0] @ window.turn[0].T + window.origin[0]
    assert np.allclose(way[9:26], np.linspace(root[9], root[25], 17), atol=1e-9)
    bend = window.bend[0, :, 22, :3] @ window.turn[0].T
    shown = np.r_[:10, 25:31]
    assert np.allclose((way + bend)[9:26], CubicSpline(shown, root[shown], bc_type="natural")(range(9, 26)), atol=1e-5)
    given = Rotation.from_matrix(solved[shown, J["left_knee"]]).as_quat()
    given *= np.where(given @ given[0] < 0, -1.0, 1.0)[:, None]
    turned = CubicSpline(shown, given, bc_type="natural")(np.arange(9, 26))
    columns = (back[:, J["left_knee"], :, :2].swapaxes(1, 2).reshape(31, 6) + window.bend[0, :, J["left_knee"]])[9:26]
    assert np.allclose(
        columns, Rotation.from_quat(turned).as_matrix()[..., :2].swapaxes(1, 2).reshape(17, 6), atol=1e-5
    )
    assert not window.bend[0, :10].any()
    assert not window.bend[0, 25:].any()


def test_in_a_short_gap_little_is_taken_from_the_network() -> None:
    known = np.ones((2, 70, 1), dtype=bool)
    known[0, 10:15] = known[1, 5:] = False
    shares = correction_share(draw_line(known))
    assert np.allclose(shares[0, 10:15], 6 / completer_features.SHARE_FRAMES)
    assert np.allclose(correction_share(draw_line(known), 3.0)[0, 10:15], 1.0)
    assert (shares[1, 5:] == 1.0).all()


def test_weights_of_an_earlier_version_are_refused() -> None:
    with pytest.raises(WeightsError, match="train again"):
        CompleterConfig.from_dict({"width": 16, "never_sigma": [0.1] * 22})


def test_the_line_knows_what_is_before_and_after() -> None:
    known = np.array([0, 1, 0, 0, 1, 0], dtype=bool)
    line = draw_line(np.stack([known, np.zeros(6, bool)], axis=-1)[None])
    assert line.before[0, :, 0].tolist() == [1, 1, 1, 1, 4, 4]
    assert line.after[0, :, 0].tolist() == [1, 1, 4, 4, 4, 4]
    assert np.allclose(line.weight[0, :, 0], [0, 0, 1 / 3, 2 / 3, 0, 0])
    assert line.ever.tolist() == [[True, False]]
    values = np.random.default_rng(0).standard_normal((1, 6, 2, 3))
    left = anchored(values, line, slice(0, 2))
    assert np.allclose(left[0, known, 0], 0.0)
    assert np.array_equal(left[:, :, 1], values[:, :, 1])


def test_rotations_are_known_where_joints_tell_them() -> None:
    positions, offsets = waving(1), REST_OFFSETS
    usual = rotation_matrices(USUAL)

    def sure(*hidden: str) -> np.ndarray:
        seen = positions.copy()
        seen[:, [J[name] for name in hidden]] = np.nan
        return solved_rotations(seen, offsets, usual)[1][0]

    assert sure().all()
    lost = {name for name, j in J.items() if not sure("left_knee")[j]}
    assert lost == {"left_hip", "left_knee", "left_ankle", "left_foot"}
    assert not sure("left_hip").any(), "the pelvis' frame is gone, and so is what it carries"
    lost = {name for name, j in J.items() if not sure("spine1", "spine2", "spine3")[j]}
    assert not lost & {"left_shoulder", "right_elbow", "neck"}, "sensors that know of no spine show arms all the same"


@pytest.mark.parametrize("limb", [("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle")])
def test_a_hidden_hand_or_foot_does_not_twist_the_limb(limb: tuple[str, ...]) -> None:
    top, middle, end = (J[f"left_{part}"] for part in limb)
    positions, offsets, usual = np.repeat(waving(40)[25:26], 9, axis=0), REST_OFFSETS, rotation_matrices(USUAL)
    axis = positions[0, middle] - positions[0, top]
    bent = np.cross(axis, [0.3, 1.0, 0.2])  # across the limb, in a plane that the rest pose does not have
    positions[:, end] = positions[:, middle] + bent / np.linalg.norm(bent) * np.linalg.norm(offsets[end])
    swung = positions.copy()
    swung[:, middle] += np.linspace(0.0, 0.02, 9)[:, None] * bent
    swung[:, end] += np.linspace(0.0, 0.02, 9)[:, None] * bent
    seen = swung.copy()
    seen[3:6, end] = np.nan
    told, solved = solved_rotations(swung, offsets, usual)[0][:, top], solved_rotations(seen, offsets, usual)[0][:, top]
    assert np.allclose(solved[:3], told[:3])
    off = Rotation.from_matrix(solved @ told.swapaxes(-1, -2)).magnitude()
    assert np.degrees(off).max() < 1.0


def test_windows_of_training_are_of_one_person_and_keep_something() -> None:
    for seed in range(40):
        known = masks(8, 20, 5, np.random.default_rng(seed))
        assert known.any(axis=(1, 2)).all()
        assert (~known).any(axis=(1, 2)).mean() > 0.5


def test_training_ends_the_same_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("steadypose.training.recipes.completer.BATCH", 60)
    monkeypatch.setattr("steadypose.training.recipes.completer.GAPS", (5, 12))
    monkeypatch.setattr("steadypose.training.recipes.completer.evaluate_completer", lambda *_: {"val": 1.0})
    monkeypatch.setattr("steadypose.training.recipes.completer.calibrate", lambda model, _: model.config)
    data = prepared(tmp_path / "m.npz")
    one, other = (
        train_completer(TrainingOptions(data, tmp_path / run, iterations=4), SMALL).read_bytes() for run in "ab"
    )
    assert one == other
    motion = MotionSet.load(data, "default", "train")
    truth = Truth.of(motion, motion.all_windows(12, 40)[:2])
    assert np.isfinite(truth.window_of(np.ones((2, 12, 22), bool), torch.from_numpy(USUAL)).features).all()


def test_calibration_finds_the_errors_and_how_soon_they_grow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def late(_: object, seen: np.ndarray, __: object) -> Mock:
        """Every hidden joint is 0.1 m off along each axis at the distance of half the error, and 0.2 m far away."""
        since, until = frames_since_and_until(np.isfinite(seen[..., 0]))
        with np.errstate(divide="ignore"):
            off = 0.2 * completer_features.growth(1.0 / (1.0 / since + 1.0 / until), 5.0)
        return Mock(positions=true[0] + off[..., None])

    motion = MotionSet.load(prepared(tmp_path / "m.npz"), "default", "val")
    true = motion.positions[motion.all_windows(74, 5)[:1]].double().numpy()
    monkeypatch.setattr("steadypose.training.recipes.completer.complete", late)
    config = calibrate(network(), motion, windows=1)
    assert config.half_frames == 5.0
    assert np.allclose(config.far_sigma, 0.2, atol=1e-3)


def test_the_weights_that_ship_fill_a_gap_better_than_a_line() -> None:
    positions = waving(60)
    offsets = estimate_offsets(positions)
    seen = positions.copy()
    seen[20:35] = np.nan
    live = LiveCompleter.load("default")
    rotations, root = live(seen[None], offsets[None])
    filled = place_joints(rotations[0], offsets) + root[0][:, None]
    window = read_window(seen[None], offsets[None], live.usual)
    line = window.rotations[0].copy()
    line[:, 0] = window.turn[0] @ line[:, 0]
    way = window.root[0] @ window.turn[0].T + window.origin[0]
    drawn = place_joints(line, offsets) + way[:, None]
    ours, theirs = (np.linalg.norm(x - positions, axis=-1)[20:35].mean() for x in (filled, drawn))
    assert ours < 0.8 * theirs
