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
from steadypose.prior.body.skeleton import PARENTS, REST_OFFSETS
from steadypose.prior.fit.hmvae_network import HMVAE, SkeletonConv, SkeletonPool, SkeletonUnpool
from steadypose.prior.fit.tensors import forward_kinematics, from_6d, load_tensors, remove_heading, to_6d
from steadypose.prior.models.hmvae import HMVAEConfig, LiveHMVAE
from steadypose.prior.models.layers import pooling_levels
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
    first, second = (train_hmvae(TrainingOptions(data, tmp_path / run, iterations=3)).read_bytes() for run in "ab")
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


SMPL24 = (*PARENTS, 20, 21)  # with hands, as the official code has it


def test_on_smpls_24_joints_the_graph_gives_the_official_tables() -> None:
    levels = pooling_levels(SMPL24)
    assert [len(level.neighbours) for level in levels] == [24, 14, 9, 7]
    assert [len(n) for n in levels[0].neighbours] == [
        7, 8, 8, 8, 7, 7, 9, 4, 4, 9, 3, 3, 8, 9, 9, 5, 7, 7, 5, 5, 4, 4, 3, 3,
    ]  # fmt: skip
    assert all(len(n) == 7 for n in levels[3].neighbours)


def test_chains_pair_from_the_root_and_odd_ones_leave_the_first_edge_alone() -> None:
    levels = pooling_levels(PARENTS)
    assert [len(level.neighbours) for level in levels] == [22, 12, 7, 7]
    assert levels[0].groups == [
        [0], [1, 4], [2, 5], [3], [6, 9], [7, 10], [8, 11], [12, 15], [13, 16], [14, 17], [18, 20], [19, 21],
    ]  # fmt: skip
    for level in levels:
        assert sorted(e for group in level.groups for e in group) == list(range(len(level.neighbours)))


def test_an_edge_is_deaf_to_all_but_its_neighbours() -> None:
    level = pooling_levels(PARENTS)[0]
    conv = SkeletonConv(2, 3, level.neighbours, kernel=3)
    x = torch.randn(1, 22 * 2, 8)
    base = conv(x).reshape(22, 3, 8)
    for edge in range(22):
        touched = x.clone()
        touched[:, 2 * edge : 2 * edge + 2] += 1.0
        changed = (conv(touched).reshape(22, 3, 8) - base).abs().amax(dim=(1, 2)) > 1e-6
        assert [e for e in range(22) if edge in level.neighbours[e]] == np.flatnonzero(changed).tolist()


def test_training_never_wakes_a_masked_weight() -> None:
    conv = SkeletonConv(2, 2, pooling_levels(PARENTS)[0].neighbours, kernel=3)
    optimiser = torch.optim.Adam(conv.parameters(), lr=0.1, weight_decay=1e-4)
    for _ in range(3):
        conv(torch.randn(4, 44, 8)).square().sum().backward()
        optimiser.step()
    assert torch.all(conv.weight[conv.mask.expand_as(conv.weight) == 0] == 0)
    x = torch.randn(2, 44, 8)
    assert torch.equal(conv(x), conv.eval()(x))


def test_pooling_means_and_unpooling_copies() -> None:
    groups = [[0], [1, 2]]
    x = torch.arange(3 * 2 * 4, dtype=torch.float32).reshape(1, 6, 4)
    edges = x.reshape(3, 2, 4)
    pooled = SkeletonPool(groups)(x).reshape(2, 2, 4)
    assert torch.allclose(pooled[0], edges[0])
    assert torch.allclose(pooled[1], (edges[1] + edges[2]) / 2)
    back = SkeletonUnpool(groups)(SkeletonPool(groups)(x)).reshape(3, 2, 4)
    assert torch.equal(back[1], back[2])
    assert torch.equal(back[1], pooled[1])
