from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tests.helpers.bodies import waving
from tests.helpers.prepared import write_motion

from steadypose.prior.body.kinematics import yaw_matrix
from steadypose.prior.body.layouts import KINECT22, to_canonical
from steadypose.prior.body.skeleton import REST_POSITIONS, J
from steadypose.prior.fit.tensors import load_tensors
from steadypose.prior.models.root_velocity import TrajectoryConfig
from steadypose.prior.models.sensor_bias import FEATURES, HISTORY, LiveCorrection, features, trunk_frame
from steadypose.training.data.dataset import MotionSet
from steadypose.training.data.readers import KinectPair
from steadypose.training.loop import TrainingOptions
from steadypose.training.recipes import root_velocity as training
from steadypose.training.recipes import sensor_bias
from steadypose.training.recipes.root_velocity import TrajectoryNet
from steadypose.training.recipes.sensor_bias import SensorTake, train_correction, train_sensor


@pytest.fixture
def prepared(tmp_path: Path) -> Path:
    """Bodies that glide in straight lines, their legs swinging at a rate that goes with their speed."""
    rng = np.random.default_rng(0)
    clips, count = [], 150
    for _ in range(6):
        t, speed = np.arange(count) / 30, rng.uniform(0.0, 1.5)
        pose = np.repeat((REST_POSITIONS + [0, 0, 0.9])[None], count, axis=0)
        swing = 0.4 * speed * np.sin(2 * np.pi * t)
        pose[:, [4, 7, 10], 0] += swing[:, None]
        pose[:, [5, 8, 11], 0] -= swing[:, None]
        pose[..., 0] += speed * t[:, None]
        clips.append(pose @ yaw_matrix(rng.uniform(-3, 3)).T)
    split, flat = ["train"] * 4 + ["val"] * 2, [True, True, True, False, True, True]
    return write_motion(tmp_path / "prepared.npz", clips, split, flat)


def test_where_somebody_climbs_contacts_are_not_learned(prepared: Path):
    everything, flat = (MotionSet.load(prepared, "default", "train", flat=flat) for flat in (False, True))
    assert (len(everything.clip_start) - 1, len(flat.clip_start) - 1) == (4, 3)


def test_windows_show_the_body_facing_forward(prepared: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(training, "WINDOW", 40)
    monkeypatch.setattr(training, "_SPAN", 84)
    motion = MotionSet.load(prepared, "default", "train")
    sampled = training._sample(motion, *training._chances(motion), 32, np.random.default_rng(0))
    windows = training._windows(sampled, np.random.default_rng(1), noise_sd=0.0)
    velocity = (windows.velocity[:, :, None] @ windows.turn)[:, :, 0]
    forward, sideways = velocity[..., 0], velocity[..., 1]
    assert (forward.mean(dim=1) > 2 * sideways.mean(dim=1).abs()).all()
    places = windows.features.unflatten(2, (22, 6))
    assert (places[:, :, 16, 1] > places[:, :, 17, 1]).all()
    assert (windows.velocity.diff(dim=1).abs() < 1e-3).all()


def test_mirroring_exchanges_left_and_right():
    positions, yaw, contacts = torch.randn(2, 7, 22, 3), torch.randn(2, 5), (torch.rand(2, 5, 8) > 0.5).float()
    mirrored = training._mirror_half(training._Motion(positions, yaw, contacts))
    torch.testing.assert_close(mirrored.positions[0, :, 7], positions[0, :, 8] * torch.tensor([1.0, -1.0, 1.0]))
    torch.testing.assert_close(mirrored.yaw[0], -yaw[0])
    torch.testing.assert_close(mirrored.contacts[0, :, 2], contacts[0, :, 3])
    torch.testing.assert_close(mirrored.positions[1], positions[1])


def test_corruption_keeps_the_root_at_the_origin():
    noisy = training._corrupt(torch.zeros(8, 20, 22, 3), np.random.default_rng(0))
    assert (noisy[:, :, 0] == 0).all()
    assert 0.005 < noisy[:, :, 1:].std() < 0.05


@torch.no_grad()
def test_calibration_finds_the_size_of_the_errors(prepared: Path, monkeypatch: pytest.MonkeyPatch):
    """Errors of independent frames, twice as large as stated, last a frame; lasting ones longer."""
    motion, frames = MotionSet.load(prepared, "default", "val"), training.WARM_UP + 60
    shape = (256, frames, 3)
    noise = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    turn = torch.eye(3).expand(256, frames, 3, 3)
    for error, lasts in ((2.0 * noise, 1 / 30), (2.0 * noise[:, :1].expand(shape), 1.0)):
        predicted = training.RootMotion(error, torch.zeros(shape), torch.zeros(256, frames, 8))
        truth = training._Windows(torch.empty(0), turn, torch.zeros(shape), torch.empty(0))
        monkeypatch.setattr(training, "_validate", lambda *_, p=predicted, t=truth, **__: (p, t))
        config = training.calibrate(TrajectoryNet(TrajectoryConfig(hidden=3)), motion)
        assert config.sigma_scale == pytest.approx((2.0, 2.0), rel=0.1)
        assert config.correlation_s == pytest.approx((lasts, lasts), rel=0.25)


def test_it_trains_and_writes_what_loads(prepared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(training, "BATCH", 4)
    monkeypatch.setattr(training, "WINDOW", 40)
    monkeypatch.setattr(training, "_SPAN", 84)
    path = training.train_trajectory(TrainingOptions(prepared, tmp_path, iterations=2))
    state, config = load_tensors(str(path), "trajectory")
    TrajectoryNet(TrajectoryConfig.from_dict(config)).load_state_dict(state)
    assert path.with_suffix(".md").read_text().startswith("# trajectory-default")
    assert path.with_suffix(".png").stat().st_size > 0


BIAS = np.zeros((22, 3))
BIAS[J["left_wrist"]], BIAS[J["right_wrist"]], BIAS[J["head"]] = [0.06, 0.04, 0], [0.06, -0.04, 0], [0, 0, 0.03]
"""Metres in the trunk's frame, what must be added; the same in a mirror."""
TURN, SHIFT, CAMERA = yaw_matrix(0.7), np.array([2.0, -1.0, 0.3]), np.array([3.0, 0.5, 1.2])


def observed(truth: np.ndarray) -> np.ndarray:
    return truth - BIAS @ trunk_frame(truth).swapaxes(-1, -2)


def test_what_is_missing_is_in_the_trunks_frame_of_the_pose_beside_it() -> None:
    truth = np.repeat(waving(1) @ TURN.T, 20, axis=0)
    elsewhere = (truth - SHIFT) @ TURN
    x, missing = sensor_bias._features_and_missing(observed(truth), elsewhere, (TURN, SHIFT), CAMERA, 30.0)
    np.testing.assert_allclose(missing, np.tile(BIAS, (20, 1, 1)), atol=1e-9)
    still = np.repeat(observed(truth)[None], len(HISTORY), axis=0)
    np.testing.assert_allclose(x, features(still, CAMERA), atol=1e-9)


def standing(seed: int) -> np.ndarray:
    """(20, 22, 3) somebody of random joints who stands still."""
    return np.random.default_rng(seed).normal(0.0, 0.4, (22, 3)) + np.zeros((20, 1, 1))


def pair(kinect: np.ndarray, vicon: np.ndarray) -> KinectPair:
    return KinectPair("a", "s01", "m01", 30.0, kinect, vicon)


def test_a_kinect_is_moved_to_vicon_by_joints_that_both_have_throughout() -> None:
    kinect = standing(0)
    seen = to_canonical(KINECT22, kinect)[0]
    vicon, wrist = seen @ TURN.T + SHIFT, J["left_wrist"]
    vicon[:, wrist] = (seen[:, wrist] + [0.0, 0.2, 0.0]) @ TURN.T + SHIFT
    vicon[3, wrist] = np.nan
    missing = sensor_bias._clip(pair(kinect, vicon))[1]
    others = np.delete(missing, wrist, axis=1)
    np.testing.assert_allclose(others[np.isfinite(others)], 0.0, atol=1e-9)
    np.testing.assert_allclose(missing[5, wrist], [0.0, 0.2, 0.0] @ trunk_frame(seen)[5], atol=1e-9)


def test_in_a_tenth_of_the_frames_a_fifth_of_the_joints_is_hidden_whole() -> None:
    x = torch.ones(20_000, FEATURES)
    found = sensor_bias._hide(x, np.random.default_rng(0))
    history, middle, seen = found[:, : 66 * len(HISTORY)], found[:, 66 * len(HISTORY) : -22], found[:, -22:]
    assert torch.equal(middle, x[:, 66 * len(HISTORY) : -22])
    hidden = seen == 0
    of_history = history.isnan().reshape(len(x), len(HISTORY), 22, 3)
    assert torch.equal(of_history, hidden[:, None, :, None].expand_as(of_history))
    assert float(hidden.any(dim=1).double().mean()) == pytest.approx(0.1, rel=0.1)
    assert float(hidden.double().mean()) == pytest.approx(0.02, rel=0.1)


def test_the_error_is_the_mean_distance_of_joints_that_the_reference_has() -> None:
    truth = torch.zeros(2, 22, 3)
    truth[0, 3, 1] = torch.nan
    estimate = torch.zeros(2, 22, 3)
    estimate[0, 3], estimate[1, 5] = 9.0, torch.tensor([0.3, 0.0, 0.4])
    assert float(sensor_bias._error(estimate, truth)) == pytest.approx(0.5 / 43, rel=1e-3)


def takes() -> list[SensorTake]:
    """Of two people, one turned; a foot is never seen, a knee unknown to the reference, a hip not seen at first."""
    found = []
    for person, turn in (("ann", 0.0), ("bob", 1.5)):
        truth = waving(90, 1.0 if person == "ann" else 0.93) @ yaw_matrix(turn).T
        seen = observed(truth)
        seen[:, J["left_foot"]], seen[:4, J["left_hip"]] = np.nan, np.nan
        truth[:, J["right_knee"]] = np.nan
        found.append(SensorTake(person, seen, CAMERA, truth))
    return found


def test_a_bias_is_learned_of_either_side_and_the_card_says_of_whom(tmp_path: Path) -> None:
    path = train_sensor([*takes(), takes()[0]], TrainingOptions(tmp_path, tmp_path, "mine", iterations=120))
    assert path == TrainingOptions(tmp_path, tmp_path, "mine").path("correction")
    card = path.with_suffix(".md").read_text()
    assert all(words in card for words in ("sensor mine", "3 recordings of 2 people beside", "that of the recordings"))
    x, missing = sensor_bias._take(takes()[1])
    there = np.isfinite(x[:, 0])
    assert there.sum() == len(x) - 4
    learned = LiveCorrection.load(str(path), int(there.sum()))(x[there])
    known = np.delete(np.arange(22), [J["left_foot"], J["right_knee"]])
    np.testing.assert_allclose(learned.mean(axis=0)[known], missing[there].mean(axis=0)[known], atol=0.01)


def test_each_pose_is_held_against_what_is_missing_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a mirror too: by a network that reads the answer, which is a coordinate that a mirror leaves as it is."""
    x, missing, losses = torch.randn(500, FEATURES), torch.zeros(500, 22, 3), []
    missing[..., 0] = x[:, :1]
    error = sensor_bias._error

    def kept(estimate: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
        losses.append(float(error(estimate, truth).detach()))
        return error(estimate, truth)

    def read(net: sensor_bias.CorrectionNet, features: torch.Tensor) -> torch.Tensor:
        told = features[:, :1, None].nan_to_num() * torch.tensor([1.0, 0.0, 0.0])
        return told.expand(-1, 22, -1) + 0.0 * sum(p.sum() for p in net.parameters())

    monkeypatch.setattr(sensor_bias, "_error", kept)
    monkeypatch.setattr(sensor_bias.CorrectionNet, "forward", read)
    sensor_bias._train(TrainingOptions(tmp_path, tmp_path, "mine", iterations=1), x, missing, "a", "b", "c")
    assert 0.005 < losses[0] < 0.1, "the noise on the inputs, and a fiftieth of them hidden"


def test_a_kinects_correction_is_of_the_subjects_that_are_named(tmp_path: Path, monkeypatch) -> None:
    read: list[tuple[Path, str]] = []

    def load(data: Path, subjects: tuple[str, ...]) -> list[KinectPair]:
        read.extend((data, subject) for subject in subjects)
        kinect = standing(len(read))
        return [pair(kinect, to_canonical(KINECT22, kinect)[0])]

    monkeypatch.setattr(sensor_bias, "load_pairs", load)
    data = tmp_path / "of_this_test.npz"
    path = train_correction(TrainingOptions(data, tmp_path, "mine", iterations=1), ("s05", "s02"))
    assert read == [(data, "s05"), (data, "s02")]
    card = path.with_suffix(".md").read_text()
    assert all(words in card for words in ("error of a Kinect v2", "Kinect beside Vicon: s05, s02", "Apache-2.0"))


@pytest.mark.parametrize(("steps", "evaluations"), [(50, 1), (250, 2), (None, 40)])
def test_a_training_says_its_mean_error_since_the_last_evaluation(steps, evaluations: int, tmp_path, monkeypatch):
    kept: dict[str, Any] = {}

    class Kept:
        def __init__(self, model: str, network: Any, loss: Any, evaluate: Any, *numbers: Any, **more: Any) -> None:
            kept.update(network=network, loss=loss, numbers=numbers, **more)

        def train(self, *_: Any, **__: Any) -> Path:
            return tmp_path

    monkeypatch.setattr(sensor_bias, "Recipe", Kept)
    x, y = torch.randn(40, FEATURES) * 3.0 + 1.0, torch.randn(40, 22, 3)
    x[:, 0], x[3:, 1], x[:, 2] = 5.0, torch.nan, torch.nan
    sensor_bias._train(TrainingOptions(tmp_path, tmp_path, "mine", iterations=steps), x, y, "a", "b", "c")
    assert kept["numbers"] == (4_000, 256, 1e-3, "frames")
    assert (kept["evaluations"], kept["decay"], kept["clip"]) == (evaluations, 1e-2, np.inf)
    net = kept["network"]()
    torch.testing.assert_close(net.mean, x.nanmean(dim=0).nan_to_num())
    spread = torch.from_numpy(np.nanstd(x.numpy()[:, 3:], axis=0))
    torch.testing.assert_close(net.scale[3:], spread)
    assert net.scale[0] == 0.01
    rng, losses, window = np.random.default_rng(0), [], (steps or 4_000) // evaluations
    for _ in range(window + 3):
        loss, terms = kept["loss"](net, 4, 0.0, rng)
        losses.append(1e3 * float(loss.detach()))
        assert terms["training mm"] == pytest.approx(np.mean(losses[-window:]))
    schedule = kept["schedule"](torch.optim.AdamW(net.parameters(), lr=1e-3), 10)
    assert schedule.total_steps == 10
    assert schedule.optimizer.param_groups[0]["max_lr"] == 2e-3
