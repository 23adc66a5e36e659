"""Training of HG-VAE (section 5): the evidence lower bound, and completion of partly observed windows.

Half of each batch follows the paper: clean windows with every entry observed, sampled latents, and KL warm-up. The
other half simulates a camera. Entries are hidden and completed by the completion network, which is trained first
(`completion_recipe`). Observed entries are noisy or faulty. The loss is the negative log-likelihood of the clean window
at the posterior means. One pass then denoises and completes a window, with a standard deviation.
"""

import math
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.optim.lr_scheduler import CosineAnnealingLR

from steadypose.prior.arrays import Floats
from steadypose.prior.models.hgvae.config import JOINT_NODES, SCALE, CompletionConfig, HGVAEConfig, Level
from steadypose.prior.models.weights import LICENCES, weights_path
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
from steadypose.training.data.dataset import SpeedWeightedWindows
from steadypose.training.data.hgvae_windows import STRIDES, Batch, Windows, mean_tracks
from steadypose.training.loop import Recipe, Rng, TrainingOptions
from steadypose.training.networks.graph import CompletionNet
from steadypose.training.networks.hgvae import HGVAE, HGVAEOutput
from steadypose.training.recipes.hgvae_faults import train_anomaly
from steadypose.training.weights import started

ITERATIONS = 9_000  # number of steps

FAULTS = (stands_still, exchanged, displaced)
FAULT_SHARE = 0.3
"""Kinds of tracking faults among the observed joints, and share of windows with one."""

BONE_SIGMA, TURN_SIGMA = 0.05, 0.2
"""Standard deviations of the augmentation `vary_builds`: of the logarithm of bone lengths, and (at most) of rotations,
radians. There are only 22 people to train on."""


COMPLETION_ITERATIONS, COMPLETION_BATCH, COMPLETION_AVERAGE = 14_000, 1_024, 0.998
"""Of the completion network: number of steps, windows per step, and decay of the average of its parameters."""

COMPLETION_RATE = 8e-4
"""Initial learning rate of the completion network; half of it if it starts from trained weights."""


def completion_recipe(model: HGVAE, train: Windows, val: Windows, rate: float) -> Recipe[CompletionNet]:
    """Return the recipe of ``model.completion``, whose loss is the negative log-likelihood of the hidden entries; the
    model's ``mean`` is set.

    Half of the windows are drawn with weights that grow with speed, and half of these have builds and poses varied
    further. Each entry is weighted by its predicted standard deviation (Seitzer et al., "On the Pitfalls of
    Heteroscedastic Uncertainty Estimation", ICLR 2022, beta = 0.5). Otherwise, entries of small deviation would
    dominate the gradient.
    """
    network, fast = _network(model), SpeedWeightedWindows(train.motion)

    def loss_of(_: CompletionNet, count: int, done: float, rng: Rng) -> tuple[Tensor, dict[str, float]]:
        half, quarter = count // 2, count // 4
        rows = [train.motion.sample(count - half, model.config.frames, STRIDES, rng)]
        rows.append(fast.sample(half, model.config.frames, STRIDES, rng))
        clean, sizes = train.clean(np.concatenate(rows), rng.random(count) < 0.5)
        builds = [vary_builds(clean[:-quarter], BONE_SIGMA, TURN_SIGMA, rng)]
        builds.append(vary_builds(clean[-quarter:], 1.4 * BONE_SIGMA, 2 * TURN_SIGMA, rng))
        clean = np.concatenate(builds)
        bias_sigma = draw_bias_sigma(count, rng)
        observed = occlude(with_faults(add_noise(clean, rng, bias_sigma), FAULTS, FAULT_SHARE, rng), rng)
        off, log_var, hidden = _errors(model, observed, clean, sizes, bias_sigma)
        density = 0.5 * (log_var + off.square() * (-log_var).exp())
        loss = (density * (0.5 * log_var.detach()).exp())[hidden].mean()
        return loss, {"loss": loss.item()}

    return Recipe(
        "hgvae", lambda: network, loss_of, lambda _: evaluate_completion(model, val), COMPLETION_ITERATIONS,
        COMPLETION_BATCH, rate, decay=1e-2, evaluations=20, average=COMPLETION_AVERAGE,
    )  # fmt: skip


def _errors(
    model: HGVAE, noisy: Floats, truth: Floats, sizes: Floats, bias_sigma: Floats | float
) -> tuple[Tensor, ...]:
    """Return errors (B, 66, T) of completed windows (B, T, 22, 3), their predicted log-variance, both in units of
    `SCALE`, and which entries were hidden since the body's first observation."""
    batch = Batch.of(model, noisy, truth, sizes)
    completed, log_var = _network(model).complete(batch.x, batch.observed, bias_sigma)
    off = completed - batch.target
    return off, log_var.repeat_interleave(3, dim=1), (batch.observed == 0) & (batch.counts > 0)


def _network(model: HGVAE) -> CompletionNet:
    assert model.completion is not None, "expected a model with a completion network"
    return model.completion


@torch.no_grad()
def evaluate_completion(model: HGVAE, val: Windows, windows: int = 512) -> dict[str, float]:
    """Evaluate on unseen people: RMS error along an axis of joints hidden as in training, and of 1 and 4 hidden joints.
    Returns ``hidden mm``, ``1 joints mm``, ``4 joints mm``; and ``error/sigma``, the error-to-sigma ratio of the
    first."""
    rng = np.random.default_rng(1)
    clean, sizes = val.draw(windows, model.config.frames, rng)
    bias_sigma = draw_bias_sigma(windows, rng)
    off, log_var, hidden = _errors(model, occlude(add_noise(clean, rng, bias_sigma), rng), clean, sizes, bias_sigma)
    scores = {"hidden mm": _rms_mm(off[hidden]), "error/sigma": (off * (-0.5 * log_var).exp())[hidden].std().item()}
    for count in (1, 4):
        observed = clean.copy()
        for window in observed:
            window[:, 1 + rng.choice(21, count, replace=False)] = np.nan
        off, _, hidden = _errors(model, observed, clean, sizes, 0.0)
        scores[f"{count} joints mm"] = _rms_mm(off[hidden])
    return scores


def _rms_mm(off: Tensor) -> float:
    return off.square().mean().sqrt().item() * SCALE * 1000


CONFIG = HGVAEConfig(
    coefficients=20,
    features=48,
    levels=(Level(1, 48), Level(8, 24), Level(24, 24), Level(JOINT_NODES, 12)),
    completion=CompletionConfig(),
)
"""Sizes with which it runs live on a robot's CPU; the paper's are about five times as wide."""

BATCH, RATE = 64, 6e-3  # windows per step, and initial learning rate
KL_START = 0.001  # initial beta (section 5)
WARM_UP = 0.2  # share of the training over which beta rises to 1 (paper: 200 of 5,000 epochs of a much longer training)
CLIP_ENTRY = 100.0
"""Maximum norm of the gradient (section 5) per square root of a window's entries, over which the loss is summed."""


def train_hgvae(options: TrainingOptions) -> Path:
    """Train HG-VAE on prepared motion, after its completion network and before its fault network.

    With ``options.start``, the learning rate is halved, and the fault network starts from the one beside those weights.
    Returns the path of the weights.
    """
    weights, seed, start, path = options.weights, options.seed, options.start, options.path("hgvae")
    iterations = options.iterations or ITERATIONS
    train, val = (Windows(motion) for motion in options.motion())
    torch.manual_seed(seed)
    network = HGVAE(CONFIG)
    network.mean.copy_(mean_tracks(train, network.config.frames))
    origin = started(network, "hgvae", start)
    completion = completion_recipe(network, train, val, COMPLETION_RATE)
    steps = options.iterations or completion.iterations
    completion.minimise(_network(network), options.runs / f"{path.stem}-completion", steps, seed)
    recipe = recipe_of(train, val, RATE if start is None else RATE / 2)
    run = recipe.minimise(network, path.parent, iterations, seed)
    run.save(path, network, asdict(network.config), {
        "Model": "HG-VAE, of training/recipes/hgvae.py",
        "Data": f"the '{weights}' set of `steadypose prepare`, split by subject",
        "Licence": LICENCES[weights],
        "Training": f"`steadypose train hgvae --weights {weights}`: {iterations} steps of {BATCH} windows, "
        f"after {steps} of {completion.batch} for its completion network, "
        f"AdamW {recipe.rate:g}, seed {seed}{origin}",
    })  # fmt: skip
    faults = None if start is None else str(weights_path(start, "hgvae").with_suffix(".faults.safetensors"))
    train_anomaly(path, -(-iterations // 3), replace(options, start=faults))
    return path


def train_completion(options: TrainingOptions) -> Path:
    """Train the completion network alone, within the weights ``options.start`` or those that ship.

    The fault network and the calibration of the anomaly score are copied: they are about observed joints. Returns the
    path of the weights.
    """
    start, path = options.start or options.weights, options.path("hgvae")
    train, val = (Windows(motion) for motion in options.motion())
    network = HGVAE(CONFIG)
    origin = started(network, "hgvae", start)
    recipe = completion_recipe(network, train, val, COMPLETION_RATE / 2)
    iterations = options.iterations or recipe.iterations
    run = recipe.minimise(_network(network), path.parent, iterations, options.seed)
    for suffix in (".anomaly.json", ".faults.safetensors"):
        shutil.copyfile(weights_path(start, "hgvae").with_suffix(suffix), path.with_suffix(suffix))
    run.save(path, network, asdict(network.config), {
        "Model": "HG-VAE, of training/recipes/hgvae.py",
        "Data": f"the '{options.weights}' set of `steadypose prepare`, split by subject",
        "Licence": LICENCES[options.weights],
        "Training": f"`steadypose train completion --weights {options.weights}`: {iterations} steps of {recipe.batch} "
        f"windows, of its completion network alone, AdamW {recipe.rate:g}, seed {options.seed}{origin}",
    })  # fmt: skip
    return path


def recipe_of(train: Windows, val: Windows, rate: float) -> Recipe[HGVAE]:
    """Return the recipe of a model without its completion network, with the loss of the module's docstring."""

    def loss_of(model: HGVAE, count: int, done: float, rng: Rng) -> tuple[Tensor, dict[str, float]]:
        positions, sizes = train.draw(count, model.config.frames, rng, STRIDES)
        half = count // 2
        whole = Batch.of(model, positions[:half], positions[:half], sizes[:half])
        bias_sigma = draw_bias_sigma(count - half, rng)
        clean = vary_builds(positions[half:], BONE_SIGMA, TURN_SIGMA, rng)
        observed = occlude(with_faults(add_noise(clean, rng, bias_sigma), FAULTS, 0.5, rng), rng)
        both = whole.joined(Batch.of(model, observed, clean, sizes[half:]).completed(model, bias_sigma))
        drawn = model(both.x, both.certainty, spread=(torch.arange(count) < half).float()[:, None])
        density = drawn.tracks.log_density(both.target) * both.counts
        sigma = (0.5 * drawn.tracks.log_var[half:]).exp().detach()
        # weighted by the predicted deviation, see `completion_recipe`
        density[half:] = density[half:] * (sigma / sigma.mean())
        likelihood = density.flatten(1).sum(dim=1)
        kl = drawn.kl[:half].sum() / count
        beta = min(KL_START + (1 - KL_START) * done / WARM_UP, 1.0)
        loss = beta * kl - likelihood.mean()
        return loss, {"loss": loss.item(), "KL": 2 * kl.item()}

    return Recipe(
        "hgvae", lambda: HGVAE(CONFIG), loss_of, lambda model: evaluate_hgvae(model, val), ITERATIONS, BATCH, rate,
        schedule=CosineAnnealingLR, evaluations=24, clip=CLIP_ENTRY * math.sqrt(CONFIG.frames * JOINT_NODES),
        parameters=lambda model: [p for name, p in model.named_parameters() if not name.startswith("completion.")],
    )  # fmt: skip


def evidence(drawn: HGVAEOutput, target: Tensor) -> tuple[Tensor, Tensor]:
    """Return the two terms of equation 1, nats per window (B,): log p(x | z), x in metres, and the KL divergence."""
    entries = target[0].numel()
    return drawn.tracks.log_density(target).flatten(1).sum(dim=1) - entries * math.log(SCALE), drawn.kl.sum(dim=1)


@torch.no_grad()
def evaluate_hgvae(model: HGVAE, val: Windows, windows: int = 512) -> dict[str, float]:
    """Evaluate on unseen people: evidence lower bound, reconstruction error, and error of completed entries. Returns
    ``ELBO`` and its ``log p(x|z)``, nats per entry; ``val mm``, the mean joint error of whole windows; ``hidden mm``,
    that of joints hidden as in training; ``guess mm``, that of the completion network alone; ``hidden error/sigma``,
    the error-to-sigma ratio of the hidden joints."""
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
        "hidden error/sigma": z.unflatten(1, (-1, 3)).mean(dim=2)[hidden].mean().sqrt().item(),
    }


def _joint_error(x: Tensor, target: Tensor) -> Tensor:
    """(B, 22, T) millimetres of a standard body."""
    return (x - target).unflatten(1, (-1, 3)).norm(dim=2) * (SCALE * 1000)
