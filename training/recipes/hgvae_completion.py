"""Training of the completion network: windows seen in part and with noise, against the whole ones.

The loss is the negative log-likelihood of the hidden entries, each weighted by its stated standard deviation (Seitzer
et al., "On the Pitfalls of Heteroscedastic Uncertainty Estimation", ICLR 2022, beta = 0.5): without the weight, entries
of small deviation would dominate the gradient.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from steadypose.prior.arrays import Floats
from steadypose.prior.models.hgvae.config import SCALE
from steadypose.training.data.corruption import (
    add_noise,
    displaced,
    draw_bias_sigma,
    exchanged,
    occlude,
    stands_still,
    vary_builds,
    with_faults,
)
from steadypose.training.data.hgvae_windows import STRIDES, Batch, Windows
from steadypose.training.loop import TrainingRun
from steadypose.training.networks.hgvae import HGVAE
from steadypose.training.networks.hgvae_completion import CompletionNet

BATCH = 128
"""windows a step"""

FAULTS = (stands_still, exchanged, displaced)
FAULT_SHARE = 0.3
"""Kinds of tracking faults among the observed joints, and the share of windows with one"""

BONE_SIGMA, TURN_SIGMA = 0.05, 0.2
"""Augmentation by `vary_builds`: deviation of the logarithm of bone lengths, and of rotations in radians; there are
only 22 people to train on."""


def train_completion(model: HGVAE, train: Windows, val: Windows, directory: Path, iterations: int, seed: int) -> None:
    """Train ``model.completion``.

    Args:
        model: an HG-VAE with a completion network; its ``mean`` is set.
        train: training motion.
        val: motion of other people, for the validation curves.
        directory: of the run; a killed one resumes there.
        iterations: optimiser steps.
        seed: of what is sampled.

    Raises:
        ValueError: the model has no completion network.
    """
    network = _network(model)
    optimiser = torch.optim.AdamW(network.parameters(), lr=2e-3, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, iterations)
    run = TrainingRun(directory, network, schedule, iterations, evaluations=20)

    def loss_of(count: int, _: float, rng: np.random.Generator) -> tuple[Tensor, dict[str, float]]:
        clean, sizes = train.draw(count, model.config.frames, rng, STRIDES)
        clean = vary_builds(clean, BONE_SIGMA, TURN_SIGMA, rng)
        bias_sigma = draw_bias_sigma(count, rng)
        seen = occlude(with_faults(add_noise(clean, rng, bias_sigma), FAULTS, FAULT_SHARE, rng), rng)
        off, log_var, hidden = _errors(model, seen, clean, sizes, bias_sigma)
        density = 0.5 * (log_var + off.square() * (-log_var).exp())
        loss = (density * (0.5 * log_var.detach()).exp())[hidden].mean()
        return loss, {"loss": loss.item()}

    run.minimise(loss_of, lambda: evaluate_completion(model, val), BATCH, seed, clip=1.0)


def _errors(model: HGVAE, seen: Floats, truth: Floats, sizes: Floats, bias_sigma: Floats | float) -> tuple[Tensor, ...]:
    """Errors of completed windows, their stated log-variance, both in units of `SCALE`, and which entries count.

    Args:
        model: with a completion network.
        seen: (B, T, 22, 3) metres, NaN where hidden.
        truth: (B, T, 22, 3) metres.
        sizes: (B,) of the bodies.
        bias_sigma: (B,) metres along an axis, the sensor's slow error.

    Returns:
        Three times (B, 66, T): error, log-variance, and whether an entry was hidden since the body's first observation.
    """
    batch = Batch.of(model, seen, truth, sizes)
    completed, log_var = _network(model).complete(batch.x, batch.observed, bias_sigma)
    off = completed - batch.target
    return off, log_var.repeat_interleave(3, dim=1), (batch.observed == 0) & (batch.counts > 0)


def _network(model: HGVAE) -> CompletionNet:
    if model.completion is None:
        raise ValueError("expected a model with a completion network")
    return model.completion


@torch.no_grad()
def evaluate_completion(model: HGVAE, val: Windows, windows: int = 512) -> dict[str, float]:
    """On unseen people: RMS error along an axis of joints hidden as in training, and of 1 and 4 in clean windows.

    Returns:
        ``hidden mm``, ``1 joints mm``, ``4 joints mm``; and ``found/stated``, the former's error over its deviation.
    """
    rng = np.random.default_rng(1)
    clean, sizes = val.draw(windows, model.config.frames, rng)
    bias_sigma = draw_bias_sigma(windows, rng)
    off, log_var, hidden = _errors(model, occlude(add_noise(clean, rng, bias_sigma), rng), clean, sizes, bias_sigma)
    found = {"hidden mm": _rms_mm(off[hidden]), "found/stated": (off * (-0.5 * log_var).exp())[hidden].std().item()}
    for count in (1, 4):
        seen = clean.copy()
        for window in seen:
            window[:, 1 + rng.choice(21, count, replace=False)] = np.nan
        off, _, hidden = _errors(model, seen, clean, sizes, 0.0)
        found[f"{count} joints mm"] = _rms_mm(off[hidden])
    return found


def _rms_mm(off: Tensor) -> float:
    return off.square().mean().sqrt().item() * SCALE * 1000
