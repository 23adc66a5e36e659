import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tests.helpers.bodies import waving
from tests.helpers.prepared import write_motion

from steadypose.prior.body.inverse_kinematics import solve_rotations
from steadypose.prior.body.skeleton import REST_OFFSETS
from steadypose.prior.fit.hmvae_network import HMVAE, SkeletonConv
from steadypose.prior.fit.tensors import forward_kinematics, from_6d, load_tensors, remove_heading, to_6d
from steadypose.prior.models.hmvae import HMVAEConfig, LiveHMVAE
from steadypose.prior.models.weights import WEIGHTS
from steadypose.training.data.dataset import MotionSet, mirror_offsets, mirror_rotations
from steadypose.training.loop import TrainingOptions
from steadypose.training.recipes.hmvae import SHORT, train_hmvae
from steadypose.training.weights import arrays_of


def random_rotations(*shape: int) -> torch.Tensor:
    count = int(np.prod(shape))
    return torch.from_numpy(Rotation.random(count, rng=np.random.default_rng(0)).as_matrix()).reshape(*shape, 3, 3)


@pytest.mark.parametrize(
    ("config", "local", "deep"),
    [(HMVAEConfig(), (2, 12, 6), (2, 7, 6)), (HMVAEConfig(64, 15, (2, 2, 2, 2), 12, 24), (2, 12, 12), (2, 7, 24))],
)
def test_the_papers_two_window_lengths_have_the_official_latents(config, local, deep) -> None:
    model = HMVAE(config)
    x = torch.randn(2, config.window, 22, 6)
    posterior = model.encode(x)
    assert posterior.local_mean.shape == local
    assert posterior.global_mean.shape == deep
    assert model.decode(*posterior.sample()).shape == x.shape


@pytest.mark.parametrize(
    "config", [HMVAEConfig(), HMVAEConfig(about_mean=True), HMVAEConfig(64, 15, (2, 2, 2, 2), 12, 24)]
)
@pytest.mark.parametrize("bodies", [1, 3])
def test_the_live_model_reconstructs_as_the_trained_one(config, bodies) -> None:
    torch.manual_seed(bodies)
    model = HMVAE(config).eval()
    for parameter in model.parameters():  # biases start at zero, where a slip in folding them would not show
        torch.nn.init.normal_(parameter, std=0.05)
    x = torch.randn(bodies, config.window, 22, 6)
    for module in model.modules():
        if isinstance(module, SkeletonConv):
            module.weight.data *= module.mask
    found = LiveHMVAE(model.config, arrays_of(model))(x.numpy())
    expected = model.reconstruct(x).detach().numpy()
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


def test_a_window_that_the_strides_do_not_divide_is_refused() -> None:
    with pytest.raises(ValueError, match="cannot be strided"):
        HMVAE(HMVAEConfig(window=6))


def test_mirroring_rotations_mirrors_positions() -> None:
    rotations = random_rotations(4, 22)
    offsets = torch.from_numpy(REST_OFFSETS * np.random.default_rng(0).uniform(0.8, 1.2, (22, 1)))
    plain, _ = forward_kinematics(rotations, offsets)
    mirrored, _ = forward_kinematics(mirror_rotations(rotations), mirror_offsets(offsets))
    assert torch.allclose(mirrored, mirror_offsets(plain))


def prepared(path: Path, clips: int = 4) -> Path:
    """A file in the layout of `steadypose prepare`, of people who wave."""
    waved = [waving(80, speed=1 + 0.1 * k) for k in range(clips)]
    return write_motion(path, waved, ["train"] * (clips - 1) + ["val"])


def test_sampled_windows_stay_inside_their_clips(tmp_path: Path) -> None:
    motion = MotionSet.load(prepared(tmp_path / "m.npz"), "default", "train")
    rows = motion.sample(500, 8, (1, 2, 3), np.random.default_rng(0))
    assert rows.shape == (500, 8)
    assert (rows // 80 == rows[:, :1] // 80).all()
    assert set(np.unique(np.diff(rows, axis=1))) == {1, 2, 3}
    assert len(motion.all_windows(8, 1)) == 3 * 73


def test_a_missing_split_and_a_missing_file_are_said(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="steadypose prepare"):
        MotionSet.load(tmp_path / "none.npz", "default", "train")
    with pytest.raises(ValueError, match="test"):
        MotionSet.load(prepared(tmp_path / "m.npz"), "default", "test")
    with pytest.raises(ValueError, match="expected one of default, research, got 'kinect_v2'"):
        MotionSet.load(prepared(tmp_path / "m.npz"), "kinect_v2", "train")


def test_training_writes_weights_and_curves_and_ends_the_same_twice(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("steadypose.prior.models.weights.WEIGHTS", tmp_path / "weights")
    monkeypatch.setattr("steadypose.training.recipes.hmvae.SHORT", replace(SHORT, batch=4))
    data = prepared(tmp_path / "m.npz")
    first, second = (
        train_hmvae(TrainingOptions(data, tmp_path / run, iterations=3)).read_bytes() for run in ("a", "b")
    )
    assert first == second
    assert [c["step"] for c in json.loads((tmp_path / "b/hmvae-default/curves.json").read_text())] == [1, 2, 3]
    assert (tmp_path / "b/hmvae-default/curves.png").stat().st_size > 1000


def test_the_weights_that_ship_reconstruct_motion_they_never_saw() -> None:
    """Golden figure: a regression of the weights, the layers or the solver moves it."""
    state, config = load_tensors("default", "hmvae")
    model = HMVAE(HMVAEConfig.from_dict(config)).eval()
    model.load_state_dict(state)
    rotations = torch.from_numpy(solve_rotations(waving(120), REST_OFFSETS)).float()
    windows, _ = remove_heading(rotations.unfold(0, 8, 1).movedim(-1, 1), 3)
    with torch.inference_mode():
        decoded = from_6d(model.reconstruct(to_6d(windows)))
    offsets = torch.from_numpy(REST_OFFSETS).float()
    error = forward_kinematics(decoded, offsets)[0] - forward_kinematics(windows, offsets)[0]
    assert 1000 * error.norm(dim=-1)[:, 3].mean().item() == pytest.approx(GOLDEN_CENTRE_MM, abs=0.2)
    assert (WEIGHTS / "hmvae-default.md").is_file()


GOLDEN_CENTRE_MM = 2.0
