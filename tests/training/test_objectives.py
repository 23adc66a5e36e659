"""What the VAEs are trained to minimise: the direction of the KL, its weight, and whose states steps start from.

Encoders and priors are made constant, so that the KL and its derivative are known by hand; the two normals have
different deviations, so that the reverse divergence is another number.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from tests.prior.models.test_hgvae import SMALL
from torch import Tensor, nn

from steadypose.benchmarks.motion import as_set, simulated_clips
from steadypose.prior.fit.hmvae_network import HMVAE
from steadypose.prior.fit.humor_network import HumorConfig, HumorNet
from steadypose.prior.fit.humor_state import State
from steadypose.prior.models.hgvae.faults import Calibration, LiveFaultNet
from steadypose.prior.models.hmvae import HMVAEConfig
from steadypose.prior.models.weights import weights_path
from steadypose.training.data.dataset import MotionSet
from steadypose.training.data.hgvae_windows import Windows
from steadypose.training.loop import TrainingOptions
from steadypose.training.networks.hgvae import HGVAE
from steadypose.training.recipes import hgvae, hmvae
from steadypose.training.recipes.humor import Batch, Sequences, transition_loss

SHIFT, SPREAD = 1.5, 0.5
"""Mean and standard deviation of a posterior whose prior is N(0, 1)."""
ONE_WAY = 0.5 * (SPREAD**2 + SHIFT**2 - 1.0) - float(np.log(SPREAD))
"""Nats a dimension, KL(posterior || prior). The other way it is 5.3, not 1.4."""

LossOf = Callable[[int, float, np.random.Generator], tuple[Tensor, dict[str, float]]]


def constant(layer: nn.Module, mean: float, spread: float) -> nn.Linear:
    """Make a linear head of means and log-variances answer these, whatever it is given."""
    assert isinstance(layer, nn.Linear)
    latent = layer.out_features // 2
    with torch.no_grad():
        layer.weight.zero_()
        layer.bias[:latent], layer.bias[latent:] = mean, 2 * float(np.log(spread))
    return layer


@pytest.fixture(scope="module")
def motion() -> MotionSet:
    return as_set(simulated_clips(40, 4, seed=0))


@pytest.fixture(scope="module")
def batch(motion: MotionSet) -> Batch:
    return Sequences.of(motion).draw(16, 5, np.random.default_rng(0))


@pytest.mark.parametrize(("done", "beta"), [(0.0, 0.0), (0.05, 8e-5), (0.125, 2e-4), (0.25, 4e-4), (0.9, 4e-4)])
def test_humors_kl_is_of_posterior_from_prior_and_warms_up(batch: Batch, done: float, beta: float) -> None:
    torch.manual_seed(0)
    net = HumorNet(HumorConfig(hidden=64, latent=6))
    assert net.prior is not None
    constant(net.encoder[-1], SHIFT, SPREAD)
    prior = constant(net.prior[-1], 0.0, 2.0)
    loss, terms = transition_loss(net, batch, done, np.random.default_rng(0))
    nats = 6 * (0.5 * ((SPREAD**2 + SHIFT**2) / 4.0 - 1.0) - np.log(SPREAD / 2.0))
    assert terms["KL, nats"] == pytest.approx(nats, rel=1e-5)
    # the prior is in no other term: d KL / d its mean = -(posterior's mean - prior's) / prior's variance
    (gradient,) = torch.autograd.grad(loss, prior.bias)
    assert gradient[:6].tolist() == pytest.approx([-beta * SHIFT / 4.0] * 6, rel=1e-4)


MARK = 40.0
"""m/s, a speed that no true state has."""


class Marking(HumorNet):
    """Its steps lead to states of a speed by which they are known; it counts how often it starts from one."""

    def step(self, state: State, latent: Tensor, offsets: Tensor) -> tuple[State, Tensor]:
        following, logits = super().step(state, latent, offsets)
        return replace(following, velocity=torch.zeros_like(following.velocity) + MARK), logits

    def decode(self, state: State, inputs: Tensor, latent: Tensor, offsets: Tensor) -> tuple[State, Tensor]:
        self.own = (state.velocity.norm(dim=-1) > MARK).double().mean(dim=-1)
        return super().decode(state, inputs, latent, offsets)


@pytest.mark.parametrize(("done", "share"), [(0.0, 0.0), (0.15, 0.0), (0.25, 0.5), (0.35, 1.0), (1.0, 1.0)])
def test_steps_start_from_the_true_state_at_first_and_the_models_own_at_last(motion, done: float, share: float):
    torch.manual_seed(0)
    net, rng = Marking(HumorConfig(hidden=64, latent=6)), np.random.default_rng(0)
    transition_loss(net, Sequences.of(motion).draw(128, 6, rng), done, rng)
    assert net.own.shape == (128, 6)
    assert not net.own[:, 0].any(), "the first state is always true"
    assert float(net.own[:, 1:].mean()) == pytest.approx(share, abs=0.06 if 0 < share < 1 else 0.0)


def value(loss: LossOf, done: float) -> tuple[float, dict[str, float]]:
    torch.manual_seed(0)
    found, terms = loss(8, done, np.random.default_rng(0))
    return found.item(), terms


def test_hmvaes_kl_is_to_the_standard_normal_and_the_local_one_comes_late(motion: MotionSet, monkeypatch) -> None:
    torch.manual_seed(0)
    model = HMVAE(HMVAEConfig(about_mean=True))
    with torch.no_grad():
        for head in (model.to_local, model.to_global):
            for name, parameter in head.named_parameters():
                parameter.zero_()
                if "bias" in name:
                    mean, log_var = parameter.chunk(2, dim=-1)
                    mean.fill_(SHIFT)
                    log_var.fill_(2 * float(np.log(SPREAD)))
    loss_of = partial(hmvae.recipe_of("hmvae", model.config, motion, motion, hmvae.SHORT).loss, model)
    for done, local in ((0.0, 0.0), (0.08, 0.0), (0.28, 0.5), (0.48, 1.0), (0.9, 1.0)):
        monkeypatch.setattr(hmvae, "KL_WEIGHT", 0.003)
        loss, terms = value(loss_of, done)
        monkeypatch.setattr(hmvae, "KL_WEIGHT", 0.0)
        assert terms["KL global"] == pytest.approx(model.config.global_latent * ONE_WAY, rel=1e-5)
        assert terms["KL local"] == pytest.approx(model.config.local_latent * ONE_WAY, rel=1e-5)
        beta = 0.003 * (terms["KL global"] + local * terms["KL local"])
        assert loss - value(loss_of, done)[0] == pytest.approx(beta, rel=1e-2)


def small_hgvae() -> HGVAE:
    torch.manual_seed(0)
    model = HGVAE(SMALL)
    for level in model.decoder_levels:
        constant(level.posterior_head, SHIFT, SPREAD)
        if not level.top:
            constant(level.prior_head, 0.0, 2.0)
    return model


def test_hgvaes_kl_is_of_posterior_from_prior_at_every_level() -> None:
    found = small_hgvae()(torch.randn(3, 66, 12), torch.ones(3, 66, 12)).kl
    below = 0.5 * ((SPREAD**2 + SHIFT**2) / 4.0 - 1.0) - float(np.log(SPREAD / 2.0))
    expected = [4 * ONE_WAY, 5 * 3 * below, 66 * 2 * below]
    np.testing.assert_allclose(found.detach().numpy(), np.tile(expected, (3, 1)), rtol=1e-4)


def test_hgvaes_kl_counts_in_full_after_a_fifth_of_the_training(motion: MotionSet) -> None:
    recipe = hgvae.recipe_of(Windows(motion), Windows(motion), 1e-3)
    loss = partial(recipe.loss, small_hgvae())
    nats = value(loss, 0.0)[1]["KL"] / 2
    start = value(loss, 0.0)[0] - 0.001 * nats
    for done, beta in ((0.1, 0.5005), (0.2, 1.0), (0.9, 1.0)):
        assert value(loss, done)[0] - start == pytest.approx(beta * nats, rel=1e-3)


def test_the_completion_network_alone_is_trained_within_weights_that_ship(tmp_path: Path) -> None:
    motion = as_set(simulated_clips(120, 4, seed=0))

    class Simulated(TrainingOptions):
        def motion(self, *, flat: bool = False) -> tuple[MotionSet, MotionSet]:
            return motion, motion

    path = hgvae.train_completion(Simulated(tmp_path, tmp_path, iterations=1))
    before, after = (load_file(file) for file in (weights_path("default", "hgvae"), path))
    changed = {name.partition(".")[0] for name in before if not torch.equal(before[name], after[name])}
    assert changed == {"completion"}
    Calibration.load(str(path))
    LiveFaultNet.load(str(path), 1)
