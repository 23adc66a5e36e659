"""Training of the completion network: windows seen in part and with noise, against the whole ones.

The loss is the likelihood of what was hidden, each entry weighted by the standard deviation stated of it (Seitzer et
al., "On the Pitfalls of Heteroscedastic Uncertainty Estimation", with beta = 0.5): by the plain likelihood, what is
known to the millimetre would drown what is not.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from steadypose.prior.models.hgvae.completion import CompletionNet
from steadypose.prior.models.hgvae.config import SCALE
from steadypose.prior.models.hgvae.network import HGVAE
from steadypose.prior.models.hgvae.windows import STRIDES, Batch, Windows
from steadypose.prior.models.training import TrainingRun
from steadypose.prior.motion.corruption import (
    add_noise,
    elsewhere,
    exchanged,
    occlude,
    other_builds,
    slow_errors,
    spoil,
    stands_still,
)

Floats = NDArray[np.float64]

BATCH = 128
"""windows a step"""

SPOILT_BY = (stands_still, exchanged, elsewhere)
SPOILT = 0.3
"""what something seen is plainly wrong by, and the share of the windows in which it is"""

BONES, TURNED = 0.05, 0.2
"""By how much each bone is longer or shorter than it was, and turned, radians (`other_builds`): 22 people are few."""


def train_completion(model: HGVAE, train: Windows, val: Windows, directory: Path, iterations: int, seed: int) -> None:
    """Train ``model.completion``.

    Args:
        model: with such a network, and the mean of its training windows.
        train: motion.
        val: motion of others, to watch it by.
        directory: of the run; a killed one resumes there.
        iterations: optimiser steps.
        seed: of what is sampled.

    Raises:
        ValueError: the model has no such network.
    """
    network = _network(model)
    optimiser = torch.optim.AdamW(network.parameters(), lr=2e-3, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, iterations)
    run = TrainingRun(directory, network, schedule, iterations, evaluations=20)

    def loss_of(count: int, _: float, rng: np.random.Generator) -> tuple[Tensor, dict[str, float]]:
        clean, sizes = train.draw(count, model.config.frames, rng, STRIDES)
        clean = other_builds(clean, BONES, TURNED, rng)
        slow = slow_errors(count, rng)
        seen = occlude(spoil(add_noise(clean, rng, slow), SPOILT_BY, SPOILT, rng), rng)
        off, log_var, hidden = _errors(model, seen, clean, sizes, slow)
        density = 0.5 * (log_var + off.square() * (-log_var).exp())
        loss = (density * (0.5 * log_var.detach()).exp())[hidden].mean()
        return loss, {"loss": loss.item()}

    run.minimise(loss_of, lambda: evaluate_completion(model, val), BATCH, seed, clip=1.0)


def _errors(model: HGVAE, seen: Floats, truth: Floats, sizes: Floats, slow: Floats | float) -> tuple[Tensor, ...]:
    """What completed windows are off by and the log-variance stated, in units of `SCALE`, and what was hidden.

    Args:
        model: with a completion network.
        seen: (B, T, 22, 3) metres, NaN where hidden.
        truth: (B, T, 22, 3)
        sizes: (B,) of the bodies.
        slow: (B,) metres along an axis, the errors of the sensor that last.

    Returns:
        Three times (B, 66, T); what was before the first sighting of a body does not count as hidden.
    """
    batch = Batch.of(model, seen, truth, sizes)
    completed, log_var = _network(model).complete(batch.x, batch.observed, slow)
    off = completed - batch.target
    return off, log_var.repeat_interleave(3, dim=1), (batch.observed == 0) & (batch.counts > 0)


def _network(model: HGVAE) -> CompletionNet:
    if model.completion is None:
        raise ValueError("expected a model with a completion network")
    return model.completion


@torch.no_grad()
def evaluate_completion(model: HGVAE, val: Windows, windows: int = 512) -> dict[str, float]:
    """On unseen people: RMS along an axis of what is hidden as in training, and of joints hidden in clean windows.

    Returns:
        ``hidden mm``, ``1 joints mm``, ``4 joints mm``; ``found/stated``, of what is hidden as in training.
    """
    rng = np.random.default_rng(1)
    clean, sizes = val.draw(windows, model.config.frames, rng)
    slow = slow_errors(windows, rng)
    off, log_var, hidden = _errors(model, occlude(add_noise(clean, rng, slow), rng), clean, sizes, slow)
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
