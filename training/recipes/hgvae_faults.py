"""Training of the score stage: the fault network, and the calibration of its scores on clean motion of unseen people.

Inputs are as in the live node: a sensor with a given error, half of it bias, and some joints missing.
"""

import math
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from rich.progress import track
from torch import Tensor
from torch.nn import functional as F
from torch.optim.lr_scheduler import CosineAnnealingLR

from steadypose.prior.arrays import Floats
from steadypose.prior.clean.outliers import MIN_NOISE, frozen_joints
from steadypose.prior.fit.tensors import load_network
from steadypose.prior.models.hgvae.config import SCALE, FaultNetConfig, HGVAEConfig
from steadypose.prior.models.hgvae.faults import (
    MISSING,
    PACE_EDGES,
    PACES,
    RATES,
    RECENT,
    SENSOR_SIGMAS,
    Calibration,
    fault_features,
    joint_odds,
    pace,
)
from steadypose.prior.models.hgvae.features import to_tracks
from steadypose.prior.models.weights import LICENCES
from steadypose.training.data.corruption import (
    JITTER_SHARE,
    displaced,
    exchanged,
    hide_joints,
    jumps,
    noisy,
    occlude,
    of_another_person,
    other_bones,
    repeats,
    sides_exchanged,
    stands_still,
    vary_builds,
    with_drifting_error,
    with_faults,
)
from steadypose.training.data.hgvae_windows import STRIDES, Windows, standardise
from steadypose.training.loop import Recipe, Rng, TrainingOptions
from steadypose.training.networks.graph import FaultNet
from steadypose.training.networks.hgvae import HGVAE
from steadypose.training.weights import started

WINDOWS = 2000
"""Number of windows for each sensor error, number of missing joints and pace; a few exceed the lowest rate."""

FASTER, MAX_DRAWS = (1, 2, 3), 12
"""Strides of the windows from which each pace is selected, and largest number of draws, as fast windows are rare."""

BATCH = 64  # number of windows per step of the fault network

MIN_FAULT = 0.015
"""Least error of a faulty joint along an axis over the scored frames, metres; it must also exceed the sensor's own
error. Joints with less than a fifth of it are not faulty; those between are ambiguous."""

FAULTS = (stands_still, exchanged, sides_exchanged, displaced, of_another_person, other_bones, noisy, jumps)
BONE_SIGMA, TURN_SIGMA = 0.05, 0.1
"""Standard deviations of the augmentation `vary_builds`: of the logarithm of bone lengths, and (at most) of rotations,
radians. A person's build and posture are no faults."""

FAULT_SHARE = 0.6  # share of the windows that have a fault
REPEATED = 0.15  # share of the windows in which a tracker repeats its last output for some joints


def train_anomaly(path: Path, iterations: int, options: TrainingOptions) -> None:
    """Train the fault network of the HG-VAE at ``path``, calibrate it on validation motion, and write both beside it.
    ``options`` are HG-VAE's, except that ``start`` names weights of a fault network."""
    weights, seed = options.weights, options.seed
    model = load_network(HGVAE, HGVAEConfig.from_dict, str(path), "hgvae")
    train, val = (Windows(motion) for motion in options.motion())
    torch.manual_seed(seed)
    network = FaultNet(FaultNetConfig(frames=model.config.frames))
    network.mean.copy_(model.mean)
    origin = started(network, "hgvae", options.start)

    def loss_of(network: FaultNet, count: int, _: float, rng: Rng) -> tuple[Tensor, dict[str, float]]:
        loss = _loss(network, model, train, count, rng)
        return loss, {"loss": loss.item()}

    def evaluate(network: FaultNet) -> dict[str, float]:
        return {"val loss": _loss(network, model, val, 1024, np.random.default_rng(1)).item()}

    recipe = Recipe(
        "hgvae", lambda: network, loss_of, evaluate, iterations, BATCH, rate=2e-3, decay=1e-3,
        schedule=CosineAnnealingLR, evaluations=10, clip=math.inf,
    )  # fmt: skip
    run = recipe.minimise(network, options.runs / f"{path.stem}-faults", iterations, seed)
    run.save(path.with_suffix(".faults.safetensors"), network, asdict(network.config), {
        "Model": f"fault network beside {path.name}, training/networks/graph.py",
        "Data": f"the '{weights}' set of `steadypose prepare`, split by subject, with tracking faults",
        "Licence": LICENCES[weights],
        "Training": f"with the HG-VAE, by `steadypose train`: {iterations} steps of {BATCH} windows, seed {seed}"
        f"{origin}",
    })  # fmt: skip
    note = "what validation people score; made with the weights by 'steadypose train'"
    calibrate(network, model, val, WINDOWS, seed=0).save(path.with_suffix(".anomaly.json"), note)


def _loss(network: FaultNet, model: HGVAE, windows: Windows, count: int, rng: Rng) -> Tensor:
    """Binary cross-entropy over the observed joints that are clearly faulty or clearly not."""
    clean, sizes = windows.draw(count, model.config.frames, rng, STRIDES)
    clean = vary_builds(clean, BONE_SIGMA, TURN_SIGMA, rng)
    sigma = np.exp(rng.uniform(np.log(SENSOR_SIGMAS[0]), np.log(SENSOR_SIGMAS[-1]), count))
    faulty = with_faults(clean, FAULTS, FAULT_SHARE, rng)
    fast = rng.uniform(0.0, 1.0, count) * (rng.random(count) < 0.8)  # some sensors smooth their output
    noisy = with_drifting_error(faulty, sigma, rng, fast)
    observed = with_faults(noisy, (repeats,), REPEATED, rng)
    astray = np.sqrt(((faulty - clean + observed - noisy)[:, -RECENT:] ** 2).mean(axis=(1, 3)))
    repeated = (observed != noisy)[:, -RECENT:].any(axis=-1).mean(axis=1)
    lost = (repeated > 0.5) & (sigma * np.sqrt(fast) > MIN_NOISE)[:, None]
    lacking = rng.random(count)
    for k in np.flatnonzero(lacking < 0.7):
        alone, few = observed[k : k + 1], lacking[k] < 0.4
        alone[:] = hide_joints(alone, int(rng.integers(1, MISSING[-1])), rng) if few else occlude(alone, rng)
    limit = np.maximum(MIN_FAULT, sigma)[:, None]
    shown = np.isfinite(observed[:, -RECENT:, :, 0]).any(axis=1)
    off = (astray > limit) | lost
    clear = torch.from_numpy(shown & (off | (astray < 0.2 * limit) & (repeated == 0))).float()
    reconstructed = _reconstruct(model, observed, sizes, sigma * np.sqrt(1.0 - fast))
    logits = network(torch.from_numpy(fault_features(*reconstructed, sigma, network.mean.numpy())))
    labels = torch.from_numpy(off).float()
    return (F.binary_cross_entropy_with_logits(logits, labels, reduction="none") * clear).sum() / clear.sum()


@torch.no_grad()
def _reconstruct(
    model: HGVAE, windows: Floats, sizes: Floats, bias_sigma: Floats | float
) -> tuple[Floats, Floats, Floats, Floats]:
    """Reconstruct windows (B, T, 22, 3) of bodies of sizes (B,), given the sensor's bias ``bias_sigma`` (B,) metres.

    Returns the tracks, HG-VAE's mean and standard deviation, all (B, 66, T) metres, and the observed mask.
    """
    tracks = to_tracks(windows, sizes)
    observed = torch.from_numpy(tracks.observed).float()
    decoded = model(*model.completed(standardise(model, tracks.x), observed, bias_sigma)).tracks
    mean = decoded.mean.double() * SCALE + model.mean[:, None]
    return tracks.x, mean.numpy(), (0.5 * decoded.log_var.double()).exp().numpy() * SCALE, tracks.observed


class Scored(NamedTuple):
    """Scores of windows, from `score_windows`."""

    odds: Floats  # (B, 22) log odds from `joint_odds`
    pace: Floats  # (B,) m/s, from `pace`


@torch.inference_mode()
def score_windows(network: FaultNet, model: HGVAE, observed: Floats, sizes: Floats, sensor_sigma: float) -> Scored:
    """Score windows (B, T, 22, 3) of bodies of sizes (B,), by a sensor of ``sensor_sigma`` metres along an axis."""
    bias_sigma, mean, parts = sensor_sigma * np.sqrt(1.0 - JITTER_SHARE), network.mean.numpy(), []
    for start in range(0, len(observed), 256):
        some = slice(start, start + 256)
        reconstructed = _reconstruct(model, observed[some], sizes[some], bias_sigma)
        odds = network(torch.from_numpy(fault_features(*reconstructed, sensor_sigma, mean)))
        joints = joint_odds(odds.double().numpy(), reconstructed[-1], frozen_joints(observed[some]))
        parts.append(Scored(joints, pace(reconstructed[1])))
    return Scored(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def calibrate(network: FaultNet, model: HGVAE, windows: Windows, count: int, seed: int) -> Calibration:
    """Calibrate with about ``count`` windows for each condition; if none is fast enough, with all windows."""
    rng = np.random.default_rng(seed)
    conditions = [(m, s) for m in range(len(MISSING)) for s in range(len(SENSOR_SIGMAS))]
    quantiles = np.zeros((len(MISSING), len(SENSOR_SIGMAS), len(PACES), len(RATES)))
    for m, s in track(conditions, "calibrating"):
        positions, sizes = _at_paces(windows, model.config.frames, count, rng)
        sigma, fast = np.full(len(positions), SENSOR_SIGMAS[s]), rng.uniform(0.0, 1.0, len(positions))
        observed = hide_joints(with_drifting_error(positions, sigma, rng, fast), MISSING[m], rng)
        scored = score_windows(network, model, observed, sizes, SENSOR_SIGMAS[s])
        of_class = np.digitize(scored.pace, PACE_EDGES)
        odds = scored.odds.max(axis=1)
        for p in range(len(PACES)):
            own = odds[of_class == p]
            quantiles[m, s, p] = np.quantile(own if len(own) else odds, 1 - np.array(RATES))
    return Calibration(quantiles)


def _at_paces(windows: Windows, frames: int, count: int, rng: Rng) -> tuple[Floats, Floats]:
    """Return windows (B, T, 22, 3), up to ``count`` of each class of `PACES`, and body sizes."""
    kept: list[tuple[Floats, Floats]] = []
    wanted = np.full(len(PACES), count)
    for _ in range(MAX_DRAWS):
        positions, sizes = windows.draw(count, frames, rng, FASTER)
        of_class = np.digitize(pace(positions.reshape(count, frames, -1).swapaxes(1, 2)), PACE_EDGES)
        rows = np.concatenate([np.flatnonzero(of_class == p)[:most] for p, most in enumerate(wanted)])
        kept.append((positions[rows], sizes[rows]))
        wanted -= np.bincount(of_class[rows], minlength=len(PACES))
    return np.concatenate([positions for positions, _ in kept]), np.concatenate([sizes for _, sizes in kept])
