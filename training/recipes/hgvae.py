"""Training of HG-VAE (section 5): the evidence lower bound, and completion of windows seen in part.

Half of each batch is the paper's: clean windows, every entry observed, latents sampled, KL warmed up. The other half
simulates a camera: entries are hidden, and completed by the completion network, which is trained first
(`training.recipes.hgvae_completion`); observed entries are noisy or faulty; and the loss is the negative
log-likelihood of the clean window at the posterior means. One pass then denoises and completes a window, with a
standard deviation.
"""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from steadypose.prior.models.hgvae.config import JOINT_NODES, SCALE, CompletionConfig, HGVAEConfig, Level
from steadypose.prior.models.weights import LICENCES, weights_path
from steadypose.training.data.corruption import add_noise, draw_bias_sigma, occlude, vary_builds, with_faults
from steadypose.training.data.dataset import MotionSet
from steadypose.training.data.hgvae_windows import STRIDES, Batch, Windows, mean_tracks
from steadypose.training.loop import TrainingOptions, TrainingRun
from steadypose.training.networks.hgvae import HGVAE, HGVAEOutput
from steadypose.training.recipes.hgvae_completion import BATCH, BONE_SIGMA, FAULTS, TURN_SIGMA, train_completion
from steadypose.training.recipes.hgvae_faults import train_anomaly
from steadypose.training.weights import started

MODELS: dict[str, HGVAEConfig] = {
    "hgvae": HGVAEConfig(
        coefficients=20,
        features=48,
        levels=(Level(1, 48), Level(8, 24), Level(24, 24), Level(JOINT_NODES, 12)),
        completion=CompletionConfig(),
    ),
    "hgvae-wide": HGVAEConfig(
        coefficients=50,
        features=256,
        levels=(Level(1, 256), Level(8, 128), Level(24, 128), Level(JOINT_NODES, 128)),
        completion=CompletionConfig(),
    ),
}
"""``hgvae`` runs live on a robot's CPU; ``hgvae-wide`` has the paper's size, for recordings."""

KL_START = 0.001
"""beta at the start (section 5)"""
WARM_UP = 0.2
"""Share of the training over which beta rises to 1 (the paper: 200 of 5,000 epochs, of a much longer training)."""
CLIP_ENTRY = 100.0
"""Maximum norm of the gradient (section 5) per root of the entries of a window: the loss is summed over these"""


def train_hgvae(options: TrainingOptions) -> Path:
    """Train HG-VAE on prepared motion, after its completion network and before its fault network.

    From ``options.start`` the learning rate is half, and the fault network goes on from the one beside those weights.

    Returns:
        The path of the weights.
    """
    return _train("hgvae", options, options.iterations or 9_000, batch=64, learning_rate=6e-3)


def train_hgvae_wide(options: TrainingOptions) -> Path:
    """Train the paper's size: fewer and smaller steps, so that it stays within an hour on two cores."""
    return _train("hgvae-wide", options, options.iterations or 4_000, batch=32, learning_rate=5e-4)


def _train(model: str, options: TrainingOptions, iterations: int, batch: int, learning_rate: float) -> Path:
    weights, seed, start, path = options.weights, options.seed, options.start, options.path(model)
    train, val = (Windows(MotionSet.load(options.data, weights, split)) for split in ("train", "val"))
    torch.manual_seed(seed)
    network = HGVAE(MODELS[model])
    network.mean.copy_(mean_tracks(train, network.config.frames))
    origin = started(network, model, start)
    rate = learning_rate if start is None else learning_rate / 2
    train_completion(network, train, val, options.runs / f"{path.stem}-completion", iterations, seed)
    run = fit(network, train, val, path.parent, iterations, batch, rate, seed)
    run.save(path, network, asdict(network.config), {
        "Model": f"HG-VAE, '{model}' of training/recipes/hgvae.py",
        "Data": f"the '{weights}' set of `steadypose prepare`, split by subject",
        "Licence": LICENCES[weights],
        "Training": f"`steadypose train {model} --weights {weights}`: {iterations} steps of {batch} windows, "
        f"after as many of {BATCH} for its completion network, "
        f"Adam {rate:g}, seed {seed}{origin}",
    })  # fmt: skip
    faults = None if start is None else str(weights_path(start, model).with_suffix(".faults.safetensors"))
    train_anomaly(path, -(-iterations // 3), replace(options, start=faults))
    return path


def fit(
    model: HGVAE, train: Windows, val: Windows, directory: Path, iterations: int, batch: int, rate: float, seed: int
) -> TrainingRun:
    """Train ``model``, all but its completion network, with the loss of the module's docstring."""
    learned = [p for name, p in model.named_parameters() if not name.startswith("completion.")]
    optimiser = torch.optim.Adam(learned, lr=rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, iterations)
    run = TrainingRun(directory, model, schedule, iterations, evaluations=24)
    frames = model.config.frames

    def loss_of(count: int, done: float, rng: np.random.Generator) -> tuple[Tensor, dict[str, float]]:
        positions, sizes = train.draw(count, frames, rng, STRIDES)
        half = count // 2
        whole = Batch.of(model, positions[:half], positions[:half], sizes[:half])
        bias_sigma = draw_bias_sigma(count - half, rng)
        clean = vary_builds(positions[half:], BONE_SIGMA, TURN_SIGMA, rng)
        seen = occlude(with_faults(add_noise(clean, rng, bias_sigma), FAULTS, 0.5, rng), rng)
        both = whole.joined(Batch.of(model, seen, clean, sizes[half:]).completed(model, bias_sigma))
        drawn = model(both.x, both.certainty, spread=(torch.arange(count) < half).float()[:, None])
        density = drawn.tracks.log_density(both.target) * both.counts
        stated = (0.5 * drawn.tracks.log_var[half:]).exp().detach()
        # weighted by the stated deviation: see `training.recipes.hgvae_completion`
        density[half:] = density[half:] * (stated / stated.mean())
        likelihood = density.flatten(1).sum(dim=1)
        kl = drawn.kl[:half].sum() / count
        beta = min(KL_START + (1 - KL_START) * done / WARM_UP, 1.0)
        loss = beta * kl - likelihood.mean()
        return loss, {"loss": loss.item(), "KL": 2 * kl.item()}

    clip = CLIP_ENTRY * math.sqrt(frames * JOINT_NODES)
    run.minimise(loss_of, lambda: evaluate_hgvae(model, val), batch, seed, clip)
    return run


def evidence(drawn: HGVAEOutput, target: Tensor) -> tuple[Tensor, Tensor]:
    """The two terms of equation 1, nats a window (B,): log p(x | z), x in metres, and the KL divergence."""
    entries = target[0].numel()
    return drawn.tracks.log_density(target).flatten(1).sum(dim=1) - entries * math.log(SCALE), drawn.kl.sum(dim=1)


@torch.no_grad()
def evaluate_hgvae(model: HGVAE, val: Windows, windows: int = 512) -> dict[str, float]:
    """On unseen people: evidence lower bound, reconstruction error, and error of completed entries.

    Returns:
        ``ELBO`` and its ``log p(x|z)``, nats an entry; ``val mm``, the mean joint error of whole windows; ``hidden
        mm``, that of joints hidden as in training, and ``guess mm``, that of the completion network alone; ``hidden
        found/stated``, RMS error over stated deviation of the former.
    """
    rng = np.random.default_rng(1)
    positions, sizes = val.draw(windows, model.config.frames, rng)
    whole = Batch.of(model, positions, positions, sizes)
    likelihood, kl = evidence(model(whole.x, whole.certainty, spread=torch.ones(windows, 1)), whole.target)
    whole_output = model(whole.x, whole.certainty)
    bias_sigma = draw_bias_sigma(windows, rng)
    partial = Batch.of(model, occlude(add_noise(positions, rng, bias_sigma), rng), positions, sizes)
    partial = partial.completed(model, bias_sigma)
    completed = model(partial.x, partial.certainty)
    hidden = (partial.observed[:, ::3] == 0) & (partial.counts > 0)
    z = (completed.tracks.mean - partial.target).square() * (-completed.tracks.log_var).exp()
    entries = whole.x[0].numel()
    return {
        "ELBO": ((likelihood - kl).mean() / entries).item(),
        "log p(x|z)": (likelihood.mean() / entries).item(),
        "val mm": _joint_error(whole_output.tracks.mean, whole.target).mean().item(),
        "hidden mm": _joint_error(completed.tracks.mean, partial.target)[hidden].mean().item(),
        "guess mm": _joint_error(partial.x, partial.target)[hidden].mean().item(),
        "hidden found/stated": z.unflatten(1, (-1, 3)).mean(dim=2)[hidden].mean().sqrt().item(),
    }


def _joint_error(x: Tensor, target: Tensor) -> Tensor:
    """(B, 22, T) millimetres of a standard body."""
    return (x - target).unflatten(1, (-1, 3)).norm(dim=2) * (SCALE * 1000)
