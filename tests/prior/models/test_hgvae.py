import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.helpers.bodies import waving
from tests.prior.models.test_hmvae import prepared

from steadypose.prior.body.kinematics import yaw_matrix
from steadypose.prior.body.skeleton import J
from steadypose.prior.fit.tensors import load_tensors
from steadypose.prior.models.hgvae.config import CompletionConfig, HGVAEConfig, Level
from steadypose.prior.models.hgvae.features import from_tracks, hang_unseen, in_frame_of, to_tracks
from steadypose.prior.models.hgvae.inference import LiveHGVAE
from steadypose.prior.models.weights import WEIGHTS, WeightsError
from steadypose.training.loop import TrainingOptions
from steadypose.training.networks.graph import GraphBlock, GraphLinear, load_fault_net
from steadypose.training.networks.hgvae import HGVAE, Gaussian, dct_matrix
from steadypose.training.recipes.hgvae import train_hgvae
from steadypose.training.weights import arrays_of

SMALL = HGVAEConfig(
    frames=12, coefficients=6, features=8, levels=(Level(1, 4), Level(5, 3), Level(66, 2)),
    completion=CompletionConfig(patch=4, width=8, heads=2, layers=2),
)  # fmt: skip


def awake(config: HGVAEConfig = SMALL, seed: int = 0) -> HGVAE:
    """A model in which every weight counts: as it begins, residual branches are switched off."""
    torch.manual_seed(seed)
    model = HGVAE(config).eval()
    model.mean.normal_(std=0.1)
    for name, parameter in model.named_parameters():
        torch.nn.init.normal_(parameter, std=0.3)
        if "adjacency" in name or "weight" in name:
            parameter.data /= parameter.shape[-1] ** 0.5
    return model.requires_grad_(requires_grad=False)


def test_a_constant_track_has_one_cosine_coefficient_and_the_transform_is_its_own_inverse() -> None:
    dct = dct_matrix(50)
    coefficients = torch.full((3, 50), 2.0) @ dct.T
    assert torch.allclose(coefficients[:, 0], torch.full((3,), 2 * 50**0.5), atol=1e-5)
    assert coefficients[:, 1:].abs().max() < 1e-5
    assert torch.allclose(dct.T @ dct, torch.eye(50), atol=1e-5)


def test_a_node_is_one_coordinate_of_one_joint_through_all_frames() -> None:
    window = waving(50)
    tracks = to_tracks(window, 1.0)
    higher = window.copy()
    higher[:, J["left_wrist"], 2] += 0.1
    changed = np.abs(to_tracks(higher, 1.0).x - tracks.x).max(axis=1)
    assert np.flatnonzero(changed > 1e-9).tolist() == [3 * J["left_wrist"] + 2]


@given(
    st.floats(-3, 3), st.floats(-5, 5), st.floats(-5, 5), st.floats(0.5, 1.5),
    st.sets(st.integers(0, 21), max_size=12), st.integers(0, 2**31),
)  # fmt: skip
@settings(max_examples=30)
def test_tracks_do_not_depend_on_where_a_body_is_or_faces(turn, east, north, size, hidden, seed) -> None:
    window = waving(20)
    window[5:15, list(hidden)] = np.nan
    moved = size * window @ yaw_matrix(turn).T + [east, north, 0.3]
    here, there = to_tracks(window, 1.0), to_tracks(moved, size)
    np.testing.assert_allclose(there.x, here.x, atol=1e-9)
    np.testing.assert_array_equal(there.observed, np.repeat(np.isfinite(window[..., 0]).T, 3, axis=0))
    back = from_tracks(there.x, there, size)
    seen = np.isfinite(moved[..., 0])
    np.testing.assert_allclose(back[seen], moved[seen], atol=1e-9)
    other = moved[::-1] if seen.all() else np.random.default_rng(seed).normal(size=moved.shape)
    np.testing.assert_allclose(from_tracks(in_frame_of(there, other, size), there, size), other, atol=1e-9)


@pytest.mark.parametrize(
    ("sigma", "ratio", "least", "most"),
    [
        (0.0, 0.0, 0.0, 1e-6),
        (0.0, np.inf, 0.95, 1.0),
        (0.01, 3.0, 0.05, 0.3),
        (0.1, 3.0, 0.7, 1.0),
        (0.1, 1.0, 0.2, 0.7),
    ],
)
def test_a_bounce_of_the_whole_body_stays_in_its_tracks_as_far_as_it_may_be_noise(sigma, ratio, least, most) -> None:
    """``least`` and ``most`` are shares of the bounce, of 3 cm at 5 Hz, in tracks of 50 frames."""
    window = waving(50) + np.random.default_rng(3).normal(0.0, sigma, (50, 22, 3))
    bounce = 0.03 * np.sin(2 * np.pi * 5 * np.arange(50) / 30)
    bounced = window + bounce[:, None, None] * [0, 0, 1]
    heads = (to_tracks(w, 1.0, ratio).x[3 * J["head"] : 3 * J["head"] + 3] for w in (window, bounced))
    left = np.linalg.norm(next(heads) - next(heads)) / np.linalg.norm(bounce)
    assert least <= left <= most


def test_a_joint_that_comes_and_goes_makes_no_jump_in_the_path() -> None:
    window = np.tile(waving(1), (50, 1, 1))
    window[:, J["neck"], 2] += np.linspace(0.0, 0.5, 50)  # its offset is not the mean offset
    flickering = window.copy()
    flickering[10:40:3, J["neck"]] = np.nan
    apart = to_tracks(flickering, 1.0, 0.0).path - to_tracks(flickering, 1.0).path
    assert np.abs(apart).max() < 1e-9


def test_the_guess_of_a_hidden_joint_goes_with_the_one_it_hangs_from() -> None:
    window = waving(30)
    foot, ankle = J["left_foot"], J["left_ankle"]
    seen = window.copy()
    seen[10:, foot] = np.nan
    guess = from_tracks(to_tracks(seen, 1.0).x, to_tracks(seen, 1.0), 1.0)
    expected = np.tile(window[9, foot] - window[9, ankle], (20, 1))
    np.testing.assert_allclose(guess[10:, foot] - window[10:, ankle], expected)
    unseen = np.zeros((66, 4))
    unseen[3 * ankle : 3 * ankle + 3] = 0.5
    unseen[3 * foot : 3 * foot + 3] = np.nan
    hang_unseen(unseen)
    assert (unseen[3 * foot : 3 * foot + 3] == 0.5).all()


def test_a_graph_layer_is_the_papers_sum_over_nodes_and_features() -> None:
    torch.manual_seed(0)
    for nodes_in, nodes_out in ((5, 3), (3, 5), (4, 4)):
        layer = GraphLinear(nodes_in, nodes_out, 2, 6)
        torch.nn.init.normal_(layer.bias)
        graph = torch.randn(nodes_in, 7, 2)
        naive = torch.einsum("oi,ibf,fg->obg", layer.adjacency, graph, layer.weight) + layer.bias[:, None]
        assert torch.allclose(layer(graph), naive, atol=1e-5)


def test_a_graph_block_begins_as_the_identity() -> None:
    graph = torch.randn(5, 3, 4)
    assert torch.equal(GraphBlock(5, 4)(graph), graph)


def test_normal_densities_and_divergences_are_torchs() -> None:
    torch.manual_seed(0)
    ours, other = (Gaussian(torch.randn(9), torch.randn(9)) for _ in range(2))
    p, q = (torch.distributions.Normal(g.mean, (0.5 * g.log_var).exp()) for g in (ours, other))
    value = torch.randn(9)
    assert torch.allclose(ours.log_density(value), p.log_prob(value), atol=1e-5)
    assert torch.allclose(ours.kl(other), torch.distributions.kl_divergence(p, q), atol=1e-5)


def test_levels_turned_off_cost_nothing_and_carry_nothing() -> None:
    model = awake(replace(SMALL, stochastic=1))
    x, observed = torch.randn(4, 66, 12), torch.ones(4, 66, 12)
    found = model(x, observed)
    assert (found.kl[:, :2] == 0).all()
    assert (found.kl[:, 2] > 0).all()
    assert sum(p.numel() for p in model.parameters()) == sum(p.numel() for p in HGVAE(SMALL).parameters())


def test_the_same_window_is_scored_alike_and_samples_differ() -> None:
    model = awake()
    x, observed = torch.randn(2, 66, 12), torch.ones(2, 66, 12)
    assert torch.equal(model(x, observed).log_prior, model(x, observed).log_prior)
    drawn = [model(x, observed, spread=torch.ones(2, 1)).tracks.mean for _ in range(2)]
    assert not torch.equal(*drawn)
    still = model(x, observed, spread=torch.tensor([[0.0], [1.0]])).tracks.mean
    assert torch.allclose(still[0], model(x, observed).tracks.mean[0], atol=1e-6)


def test_generation_draws_as_many_levels_as_asked() -> None:
    model = awake(replace(SMALL, actions=3))
    action = torch.eye(3)
    torch.manual_seed(1)
    mean = model.generate(3, random_levels=0, action=action).mean
    assert torch.equal(mean, model.generate(3, random_levels=0, action=action).mean)
    assert not torch.allclose(mean[0], mean[1])
    assert not torch.equal(mean, model.generate(3, random_levels=1, action=action).mean)
    with pytest.raises(ValueError, match="one-hot"):
        model.generate(1)


def test_the_live_model_is_the_trained_one_and_a_window_does_not_depend_on_the_others() -> None:
    model = awake()
    rng = np.random.default_rng(0)
    x, observed = rng.normal(scale=0.3, size=(3, 66, 12)), (rng.random((3, 66, 12)) < 0.7).astype(float)
    look = LiveHGVAE(model.config, arrays_of(model), 4).reconstruct(x, observed, np.zeros(len(x)))
    scaled = torch.from_numpy((x - model.mean.numpy()[:, None]) / 0.2).float()
    found = model(*model.completed(scaled, torch.from_numpy(observed).float(), 0.0))
    np.testing.assert_allclose(look.mean, found.tracks.mean.numpy() * 0.2 + model.mean.numpy()[:, None], atol=1e-5)
    np.testing.assert_allclose(look.sigma, (0.5 * found.tracks.log_var).exp().numpy() * 0.2, rtol=1e-4)
    alone = LiveHGVAE(model.config, arrays_of(model), 1)
    for row in range(3):
        by_itself = alone.reconstruct(x[row : row + 1], observed[row : row + 1], np.zeros(1))
        assert all((a[0] == b[row]).all() for a, b in zip(by_itself, look, strict=True))


def test_training_writes_weights_their_card_and_their_scale(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("steadypose.prior.models.weights.WEIGHTS", tmp_path / "weights")
    config = replace(SMALL, frames=20)
    monkeypatch.setattr("steadypose.training.recipes.hgvae.CONFIG", config)
    monkeypatch.setattr("steadypose.training.recipes.hgvae_faults.WINDOWS", 16)
    path = train_hgvae(TrainingOptions(prepared(tmp_path / "m.npz"), tmp_path / "runs", iterations=2))
    state, stored = load_tensors(str(path), "hgvae")
    HGVAE(HGVAEConfig.from_dict(stored)).load_state_dict(state)
    assert all(torch.isfinite(tensor).all() for tensor in state.values())
    assert HGVAEConfig.from_dict(stored) == config
    assert json.loads(path.with_suffix(".anomaly.json").read_text())["quantiles"]
    assert load_fault_net(str(path)).config.frames == 20
    assert "steadypose train hgvae" in path.with_suffix(".md").read_text()


def test_weights_of_an_earlier_completion_network_are_refused() -> None:
    earlier = {**asdict(SMALL), "completion": {"patch": 4, "features": 8, "blocks": 1}}
    with pytest.raises(WeightsError, match=r"expected a completion network of this version, .* train again"):
        HGVAEConfig.from_dict(earlier)


def test_the_weights_that_ship_reconstruct_motion_they_never_saw() -> None:
    """Golden figure: a regression of the weights, the layers or the tracks moves it."""
    state, config = load_tensors("default", "hgvae")
    model = HGVAE(HGVAEConfig.from_dict(config)).eval()
    model.load_state_dict(state)
    live = LiveHGVAE(model.config, arrays_of(model), 7)
    tracks = to_tracks(np.stack([waving(120)[start : start + 50] for start in range(0, 70, 10)]), 1.0)
    off = live.reconstruct(tracks.x, tracks.observed, np.zeros(len(tracks.x))).mean - tracks.x
    assert 1000 * np.sqrt(np.mean(np.square(off))) == pytest.approx(GOLDEN_RMS_MM, abs=1.0)
    assert (WEIGHTS / "hgvae-default.md").is_file()


GOLDEN_RMS_MM = 2.7
