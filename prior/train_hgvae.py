"""Training of HG-VAE (section 5): the evidence lower bound, and completion of windows seen in part.

Half of each batch is the paper's: clean windows, every entry observed, latents drawn, KL warmed up. The other half
teaches the encoder what a camera does: entries are hidden, the rest is noisy or plainly wrong, and the likelihood of
the true window, at the means of the latents, is all that counts. One pass then completes a window and says how sure it
is; what was seen where the model would not have put it is an anomaly.
"""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from prior.body_tracks import in_frame_of, to_tracks
from prior.checkpoint import LICENCES
from prior.distributed import share
from prior.hgvae import HGVAE, JOINT_NODES, SCALE, HGVAEConfig, Level, Pass
from prior.motion_windows import MotionSet
from prior.skeletons import MIRROR, PARENTS, J
from prior.track_windows import Windows, mean_tracks, standardise
from prior.train_anomaly import calibrate_anomaly
from prior.training import TrainingRun
from prior.window import FPS

Floats = NDArray[np.float64]

MODELS: dict[str, HGVAEConfig] = {
    "hgvae": HGVAEConfig(
        coefficients=20, features=48, levels=(Level(1, 48), Level(8, 24), Level(24, 24), Level(JOINT_NODES, 12))
    ),
    "hgvae-wide": HGVAEConfig(
        coefficients=50, features=256, levels=(Level(1, 256), Level(8, 128), Level(24, 128), Level(JOINT_NODES, 128))
    ),
}
"""``hgvae`` fits a robot's budget; ``hgvae-wide`` has the paper's size, for recordings."""

STRIDES = (1, 1, 1, 2)
"""Every fourth window at twice the speed: people move faster than most of those who were recorded."""

SLOW_HZ = 0.7
"""how fast a sensor's slow error changes at most"""

KL_START = 0.001
"""beta at the start (section 5)"""
WARM_UP = 0.2
"""Share of the training over which beta rises to 1 (the paper: 200 of 5,000 epochs, of a much longer training)."""
CLIP_ENTRY = 100.0
"""norm of the gradient (section 5), times the root of how many entries a window has: here the loss is their sum"""


def train_hgvae(
    data: Path,
    runs: Path,
    weights: str = "default",
    model: str = "hgvae",
    iterations: int = 9_000,
    batch: int = 64,
    learning_rate: float = 1e-3,
    seed: int = 0,
) -> Path:
    """Train HG-VAE on prepared motion and write weights, card and curves.

    Args:
        data: ``prepared.npz``.
        runs: folder of training runs; a killed run of the same name resumes there.
        weights: which set: ``default`` or ``research``.
        model: which of `MODELS`.
        iterations: optimiser steps.
        batch: windows a step.
        learning_rate: of Adam at the start; falls to nothing along a cosine.
        seed: of weights and of sampling.

    Returns:
        The path of the weights.
    """
    name = f"{model}-{weights}"
    train = Windows(MotionSet.load(data, weights, "train"))
    val = Windows(MotionSet.load(data, weights, "val"))
    torch.manual_seed(seed)
    network = HGVAE(MODELS[model])
    network.mean.copy_(mean_tracks(train, network.config.frames))
    run = fit(network, train, val, runs / name, iterations, batch, learning_rate, seed)
    path = run.ship(name, network, asdict(network.config), {
        "Model": f"HG-VAE, '{model}' of prior/train_hgvae.py",
        "Data": f"the '{weights}' set of `steadypose prepare`, split by subject",
        "Licence": LICENCES[weights],
        "Training": f"`steadypose train {model} --weights {weights}`: {iterations} steps of {batch} windows, "
        f"Adam {learning_rate:g}, seed {seed}",
    })  # fmt: skip
    calibrate_anomaly(data, weights, path)
    return path


def train_hgvae_wide(data: Path, runs: Path, weights: str = "default", seed: int = 0) -> Path:
    """Train the paper's size: fewer and smaller steps, so that it stays within an hour on two cores."""
    return train_hgvae(data, runs, weights, "hgvae-wide", iterations=4_000, batch=32, learning_rate=5e-4, seed=seed)


class Batch(NamedTuple):
    """Windows as tensors.

    Attributes:
        x: (B, 66, T) what was seen and, elsewhere, the guess, about the model's mean and in its scale.
        observed: (B, 66, T) 1 where seen.
        target: (B, 66, T) the truth in the same frame.
        counts: (B, 1, T) 1 from the first sighting on; what was before, nobody asks for.
    """

    x: Tensor
    observed: Tensor
    target: Tensor
    counts: Tensor

    @classmethod
    def of(cls, model: HGVAE, seen: Floats, truth: Floats, sizes: Floats) -> Batch:
        """From positions (B, T, 22, 3) seen and true, and body sizes (B,)."""
        tracks = [to_tracks(window, size) for window, size in zip(seen, sizes, strict=True)]
        true = [in_frame_of(t, window, size) for t, window, size in zip(tracks, truth, sizes, strict=True)]
        observed = torch.from_numpy(np.stack([t.observed for t in tracks])).float()
        counts = (observed.amax(dim=1, keepdim=True).cumsum(dim=-1) > 0).float()
        x = standardise(model, np.stack([t.x for t in tracks]))
        return cls(x, observed, standardise(model, np.stack(true)), counts)

    def beside(self, other: Batch) -> Batch:
        """Both, one after the other."""
        return Batch(*(torch.cat(pair) for pair in zip(self, other, strict=True)))


def fit(
    model: HGVAE, train: Windows, val: Windows, directory: Path, iterations: int, batch: int, rate: float, seed: int
) -> TrainingRun:
    """Train ``model``; see `train_hgvae`."""
    optimiser = torch.optim.Adam(model.parameters(), lr=rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, iterations)
    state = {"model": model, "optimiser": optimiser, "schedule": schedule}
    run = TrainingRun(directory, state, iterations, every=max(iterations // 24, 1))
    frames, batch = model.config.frames, share(batch)
    losses: dict[str, float] = {}
    for step in run.steps(lambda: {**losses, **evaluate_hgvae(model, val)}):
        model.train()
        rng = run.random(seed)
        positions, sizes = train.draw(batch, frames, rng, STRIDES)
        half = batch // 2
        whole = Batch.of(model, positions[:half], positions[:half], sizes[:half])
        seen = occlude(spoil(add_noise(positions[half:], rng), rng), rng)
        both = whole.beside(Batch.of(model, seen, positions[half:], sizes[half:]))
        drawn = model(both.x, both.observed, spread=(torch.arange(batch) < half).float()[:, None])
        likelihood = (drawn.tracks.log_density(both.target) * both.counts).flatten(1).sum(dim=1)
        kl = drawn.kl[:half].sum() / batch
        beta = min(KL_START + (1 - KL_START) * step / (WARM_UP * iterations), 1.0)
        loss = beta * kl - likelihood.mean()
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), CLIP_ENTRY * math.sqrt(frames * JOINT_NODES))
        optimiser.step()
        schedule.step()
        losses.update({"loss": loss.item(), "KL": 2 * kl.item()})
    model.eval()
    return run


def evidence(drawn: Pass, target: Tensor) -> tuple[Tensor, Tensor]:
    """The two terms of equation 1, nats a window (B,): log p(x | z), x in metres, and the KL divergence."""
    entries = target[0].numel()
    return drawn.tracks.log_density(target).flatten(1).sum(dim=1) - entries * math.log(SCALE), drawn.kl.sum(dim=1)


@torch.no_grad()
def evaluate_hgvae(model: HGVAE, val: Windows, windows: int = 512) -> dict[str, float]:
    """On unseen people: the evidence lower bound, how far reconstruction is off, and completion against a line.

    Returns:
        ``ELBO`` and its ``log p(x|z)``, nats an entry; ``val mm``, the mean joint error of whole windows; ``hidden
        mm``, that of entries hidden as in training, and ``line mm``, that of the guess they started from.
    """
    model.eval()
    rng = np.random.default_rng(1)
    positions, sizes = val.draw(windows, model.config.frames, rng)
    whole = Batch.of(model, positions, positions, sizes)
    likelihood, kl = evidence(model(whole.x, whole.observed, spread=torch.ones(windows, 1)), whole.target)
    found = model(whole.x, whole.observed)
    partial = Batch.of(model, occlude(add_noise(positions, rng), rng), positions, sizes)
    completed = model(partial.x, partial.observed)
    hidden = (partial.observed[:, ::3] == 0) & (partial.counts > 0)
    z = (completed.tracks.mean - partial.target).square() * (-completed.tracks.log_var).exp()
    entries = whole.x[0].numel()
    return {
        "ELBO": ((likelihood - kl).mean() / entries).item(),
        "log p(x|z)": (likelihood.mean() / entries).item(),
        "val mm": _joint_error(found.tracks.mean, whole.target).mean().item(),
        "hidden mm": _joint_error(completed.tracks.mean, partial.target)[hidden].mean().item(),
        "line mm": _joint_error(partial.x, partial.target)[hidden].mean().item(),
        "hidden found/stated": z.unflatten(1, (-1, 3)).mean(dim=2)[hidden].mean().sqrt().item(),
    }


def _joint_error(x: Tensor, target: Tensor) -> Tensor:
    """(B, 22, T) millimetres of a standard body."""
    return (x - target).unflatten(1, (-1, 3)).norm(dim=2) * (SCALE * 1000)


# ---------------------------------------------------------------------------------------------------------------
# What a camera does to a window

_LIMBS = [
    [J[f"{side}_{n}"] for n in names]
    for side in ("left", "right")
    for names in (("wrist",), ("elbow", "wrist"), ("shoulder", "elbow", "wrist"), ("foot",), ("ankle", "foot"),
                  ("knee", "ankle", "foot"), ("hip", "knee", "ankle", "foot"))
]  # fmt: skip
_LOWER = [J[f"{side}_{n}"] for side in ("left", "right") for n in ("hip", "knee", "ankle", "foot")]
_ABSENT = [J[n] for n in ("spine1", "spine2", "spine3", "left_collar", "right_collar", "left_foot", "right_foot")]
"""joints that many sensors do not have"""


def add_noise(positions: Floats, rng: np.random.Generator) -> Floats:
    """Windows (B, T, 22, 3) with noise from frame to frame, of some joints more than of others, up to 10 cm, and with
    errors that last or change slowly, up to 3 cm."""
    count, frames, joints, _ = positions.shape
    fast = 10 ** rng.uniform(-3.3, -1.0, (count, 1, 1, 1)) * np.exp(0.4 * rng.standard_normal((count, 1, joints, 1)))
    slow = 0.03 * rng.uniform(0.0, 1.0, (count, 1, 1, 1)) * (rng.random((count, 1, 1, 1)) < 0.7)
    phase = rng.uniform(0.0, 2 * np.pi, (count, 1, joints, 3))
    turns = rng.uniform(0.0, SLOW_HZ, (count, 1, joints, 3)) * np.arange(frames)[:, None, None] / FPS
    bias = np.sqrt(2.0) * slow * np.cos(phase + 2 * np.pi * turns)
    return positions + fast * rng.standard_normal((count, frames, joints, 3)) + bias


def spoil(positions: Floats, rng: np.random.Generator) -> Floats:
    """Windows (B, T, 22, 3), half of them with what trackers get plainly wrong, for a while: limbs that stand still,
    that are exchanged with the other side's, or that lie elsewhere."""
    spoilt = positions.copy()
    frames = positions.shape[1]
    for window in spoilt:
        if rng.random() < 0.5:
            continue
        length = int(np.clip(np.exp(rng.uniform(np.log(2), np.log(2.0 * frames))), 1, frames - 1))
        start = frames - length if rng.random() < 0.5 else int(rng.integers(1, frames - length + 1))
        joints = _LIMBS[rng.integers(len(_LIMBS))] if rng.random() < 0.7 else [int(rng.integers(len(PARENTS)))]
        part, before = window[start : start + length], window[start - 1]
        kind = rng.random()
        if kind < 0.25:
            part[:, joints] = before[joints]
        elif kind < 0.4:
            part[:, joints] = before[joints] - before[0] + part[:, :1]
        elif kind < 0.7:
            both = [*joints, *MIRROR[joints]]
            part[:, both] = part[:, MIRROR[both]]
        else:
            part[:, joints] += rng.normal(0.0, 0.15, 3)
    return spoilt


def occlude(positions: Floats, rng: np.random.Generator) -> Floats:
    """Windows (B, T, 22, 3) with entries made NaN as cameras lose them: limbs, sets of joints, single ones, the past.

    The newest frame matters most, so half of the gaps reach it.
    """
    seen = positions.copy()
    frames = positions.shape[1]
    for window in seen:
        if rng.random() < 0.4:
            window[:, _ABSENT] = np.nan
        if rng.random() < 0.25:
            window[:, 1 + rng.choice(len(PARENTS) - 1, rng.integers(1, 7), replace=False)] = np.nan
        for _ in range(rng.integers(1, 4)):
            kind = rng.random()
            joints = (
                _LIMBS[rng.integers(len(_LIMBS))] if kind < 0.6
                else _LOWER if kind < 0.7
                else _below(int(rng.integers(1, len(PARENTS)))) if kind < 0.8
                else np.flatnonzero(rng.random(len(PARENTS)) < rng.uniform(0.05, 0.5))
            )  # fmt: skip
            length = int(np.clip(np.exp(rng.uniform(np.log(2), np.log(2.0 * frames))), 1, frames))
            start = frames - length if rng.random() < 0.5 else int(rng.integers(0, frames - length + 1))
            window[start : start + length, joints] = np.nan
        if rng.random() < 0.2:
            window[rng.random(window.shape[:2]) < 10 ** rng.uniform(-3, -0.3)] = np.nan
        if rng.random() < 0.15:
            window[: rng.integers(1, frames - 3)] = np.nan
    return seen


def _below(joint: int) -> list[int]:
    """A joint and all that hangs from it."""
    found = [joint]
    for child in range(joint + 1, len(PARENTS)):
        if PARENTS[child] in found:
            found.append(child)
    return found
