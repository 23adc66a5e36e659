"""Training of the mixture: ``steadypose train mixture --data MOCAP``, resumable.

Clips of true motion pass through simulated sensors and the live node's bank. The loss consists of the benchmark's
position error (mm) and acceleration error (mm/frame²). Each clip's errors are relative to those of its best single
expert, so that no kind of sensor or motion dominates. The standard deviation is trained by its likelihood.
"""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.optim.lr_scheduler import LambdaLR

from steadypose.prior.models.mixture.bank import DENSITIES, EXPERTS, MEASUREMENT_SIGMA, advance, new_bank
from steadypose.prior.models.mixture.features import FEATURES, PARENT, describe
from steadypose.prior.models.mixture.tracks import body_covariance
from steadypose.prior.models.mixture.whiteness import Whiteness, fallback
from steadypose.prior.models.weights import LICENCES
from steadypose.prior.timing.rate import FPS
from steadypose.training.data.recordings import write_arrays
from steadypose.training.data.sensors import Sensed, Sensors
from steadypose.training.loop import Recipe, Rng, TrainingOptions
from steadypose.training.networks.mixture import MixtureConfig, MixtureNet, estimate

ITERATIONS, RATE = 6000, 2e-3  # number of optimiser steps, and the initial learning rate
FRAMES = 90  # length of a clip, frames; it starts like a stream
CLIPS, DELAYS_A_STEP = 16, 2  # numbers of clips per delay, and of delays, in an optimiser step

DELAYS = np.array([0, 1, 2, 3, 4, 5, 6, 8, 10, 12, 16])
DELAY_SHARES = np.array([0.22, 0.08, 0.12, 0.05, 0.17, 0.03, 0.04, 0.13, 0.03, 0.03, 0.10])

MIN_MM = 1.0
"""Error added to the best expert's position error in the denominator, mm, so that noise-free inputs do not dominate."""

SMOOTH_DELAYS, SMOOTH = (0, 1, 2, 4, 8), (0.25, 0.4, 0.8, 2.0, 3.0)
"""Weight of the acceleration error, by delay in frames; without delay, smoothness costs lag."""

MIN_SMOOTH_MM = 0.5  # error added to the best expert's acceleration error in the denominator, mm/frame²

SPEED_WEIGHT, MAX_SPEED_WEIGHT = 0.5, 60.0
"""Constants of the weight of a joint's position error: 1 + (speed / SPEED_WEIGHT m/s)², at most MAX_SPEED_WEIGHT.
Joints are fast in few frames, in which filters lag most. Acceleration errors are divided by the weight's square
root."""

LAG = 1.0
"""Weight of a clip's relative excess of position error over the most accurate expert. In time-correlated errors,
smoothness must not come at the price of lag."""

DEVIATION = 0.3  # weight of the negative log-likelihood in the loss
AVERAGE = 0.999  # decay of the exponential moving average of the weights, which is saved


class Batch(NamedTuple):
    """Clips (C, T, ...): arguments of `estimate`, ground truth, and weights ``counts`` of the position errors."""

    features: Tensor
    experts: Tensor
    heading: Tensor
    scale: Tensor
    gap: Tensor
    between: Tensor
    fallback: Tensor
    truth: Tensor
    counts: Tensor


def through_bank(sensed: Sensed, delay: int) -> Batch:
    """Compute the live node's features of clips, without the last ``delay`` frames."""
    clips, frames = sensed.observed.shape[:2]
    kept = frames - delay
    features = np.empty((kept, clips, 22, FEATURES), dtype=np.float32)
    experts = np.empty((kept, clips, 22, EXPERTS, 3))
    heading, (scale, share) = np.empty((kept, clips, 2)), np.empty((2, kept, clips))
    gap, between = np.empty((2, kept, clips, 22))
    bank, whiteness, covariance = new_bank(clips, delay), Whiteness(clips, delay), body_covariance()
    for t in range(frames):
        frame, confidence = sensed.observed[:, t], sensed.confidence[:, t]
        advance(bank, t, 1 / FPS, frame, confidence, DENSITIES, MEASUREMENT_SIGMA, covariance)
        at, white = t - delay, whiteness.share(frame)
        if at >= 0:
            describe(bank, t + 1, delay, PARENT, white, experts[at], features[at], scale[at], gap[at], between[at])
            heading[at], share[at] = bank.heading, fallback(white, scale[at], delay)
    middle = sensed.truth[:, :1, :1]
    middle = np.where(np.isfinite(middle), middle, 0.0)  # so that single precision is enough
    arrays = (
        features, experts - middle.swapaxes(0, 1)[:, :, :, None], heading, scale, gap, between, share,
        (sensed.truth - middle)[:, :kept].swapaxes(0, 1), _counts(sensed.truth)[:, :kept].swapaxes(0, 1),
    )  # fmt: skip
    return Batch(*(torch.from_numpy(a.astype(np.float32)).transpose(0, 1) for a in arrays))


def _counts(truth: NDArray[np.float64]) -> NDArray[np.float64]:
    """(C, T, 22) weight of each joint's position error, by its true speed; see `SPEED_WEIGHT`."""
    speed = np.linalg.norm(np.gradient(truth, axis=1), axis=-1) * FPS
    return np.minimum(1.0 + np.square(np.nan_to_num(speed) / SPEED_WEIGHT), MAX_SPEED_WEIGHT)


class Errors(NamedTuple):
    """Errors of each clip, (C,) or (C, experts)."""

    position: Tensor  # mm
    acceleration: Tensor  # mm/frame²


def errors(places: Tensor, truth: Tensor, weight: Tensor, counts: Tensor) -> Errors:
    """Weighted mean errors of each clip's joints (C, T, 22, 3) metres; ``weight`` and ``counts`` are (C, T, 22).

    Estimates may be NaN where the weight is 0. ``counts`` weight positions; acceleration errors are divided by their
    square root.
    """
    off = torch.where(weight[..., None] > 0, places - truth, 0.0) * 1e3
    bent = off[:, 2:] - 2 * off[:, 1:-1] + off[:, :-2]
    observed = (weight[:, 2:] >= 1) & (weight[:, 1:-1] >= 1) & (weight[:, :-2] >= 1)
    counted, smooth = weight * counts, observed / counts[:, 1:-1].sqrt()
    return Errors(
        (counted * _length(off)).sum(dim=(1, 2)) / counted.sum(dim=(1, 2)).clamp(min=1),
        (smooth * _length(bent)).sum(dim=(1, 2)) / smooth.sum(dim=(1, 2)).clamp(min=1),
    )


def _length(vectors: Tensor) -> Tensor:
    return (vectors.square().sum(dim=-1) + 1e-4).sqrt()


def loss_of(network: MixtureNet, batch: Batch, delay: int) -> tuple[Tensor, Tensor]:
    """Return the loss of clips with one delay, and the errors of each clip (C,) relative to its best expert's."""
    smooth = float(np.interp(delay, SMOOTH_DELAYS, SMOOTH))
    outputs = network(batch.features, (batch.gap >= 0).any(dim=-1))
    known = batch.truth.isfinite().all(dim=-1) & batch.experts.isfinite().all(dim=(-1, -2))
    experts = torch.where(known[..., None, None], batch.experts, 0.0)
    places, variance = estimate(outputs, experts, batch.heading, batch.scale, batch.gap, batch.between, batch.fallback)
    weight = known / (1.0 + batch.gap.clamp(min=0))  # nothing can be learned far from any observation
    observed = known * (batch.gap == 0).float()
    own = errors(places, batch.truth, weight, batch.counts)
    with torch.no_grad():
        each = [errors(experts[:, :, :, m], batch.truth, observed, batch.counts) for m in range(EXPERTS)]
        position, acceleration = (torch.stack(values) for values in zip(*each, strict=True))
        nearest, best = position.amin(dim=0), (position + acceleration).argmin(dim=0, keepdim=True)
        position, acceleration = position.gather(0, best)[0], acceleration.gather(0, best)[0]
    relative = own.position / (position + MIN_MM) + smooth * own.acceleration / (acceleration + MIN_SMOOTH_MM)
    relative = relative + LAG * (own.position / (nearest + MIN_MM) - 1.0).relu()
    square = torch.where(known[..., None], places - batch.truth, 0.0).square().mean(dim=-1).detach() * 1e6
    density = 0.5 * (variance.log() + square / variance)
    likelihood = (density * known).sum(dim=(1, 2)) / known.sum(dim=(1, 2)).clamp(min=1)
    return relative.mean() + DEVIATION * likelihood.mean(), relative


def _measure_features(network: MixtureNet, sensors: Sensors, seed: int) -> None:
    """Set mean and standard deviation that normalise features."""
    rng = np.random.default_rng((seed, 7))
    rows = torch.cat([through_bank(sensors.draw(32, rng), int(d)).features.reshape(-1, FEATURES) for d in DELAYS])
    network.mean.copy_(rows.mean(dim=0))
    network.deviation.copy_(rows.std(dim=0).clamp(min=0.05))


def train_mixture(options: TrainingOptions) -> Path:
    """Train on recordings in the folder ``options.data`` that are licensed for products; returns the weights' path.

    Prepared arrays, at several speeds, are kept in the run's folder. With ``options.start``, the learning rate is
    halved.
    """
    arrays = write_arrays(options.data, options.path("mixture").parent / "arrays")
    sensors, val = (Sensors.of(arrays, split, FRAMES) for split in ("train", "val"))
    watched = [(delay, through_bank(val.draw(40, np.random.default_rng((1, delay))), delay)) for delay in (0, 4)]
    recent = {"loss": 0.0}

    def loss(network: MixtureNet, clips: int, done: float, rng: Rng) -> tuple[Tensor, dict[str, float]]:
        delays = [int(delay) for delay in rng.choice(DELAYS, DELAYS_A_STEP, p=DELAY_SHARES)]
        batches = [(through_bank(sensors.draw(clips, rng), delay), delay) for delay in delays]
        total = torch.stack([loss_of(network, batch, delay)[0] for batch, delay in batches]).mean()
        recent["loss"] += 0.02 * (total.item() - recent["loss"]) if done else total.item()
        return total, recent

    def evaluate(network: MixtureNet) -> dict[str, float]:
        return {f"val, delay {delay}": loss_of(network, batch, delay)[1].mean().item() for delay, batch in watched}

    recipe = Recipe(
        "mixture", lambda: MixtureNet(MixtureConfig()), loss, evaluate, ITERATIONS, CLIPS,
        RATE if options.start is None else RATE / 2, f"clips of each of {DELAYS_A_STEP} delays", decay=1e-4,
        schedule=lambda optimiser, steps: LambdaLR(optimiser, lambda step: _rate_factor(step, steps)),
        evaluations=20, average=AVERAGE,
    )  # fmt: skip
    return recipe.train(
        options,
        "weights that a network gives to a bank of fixed-lag smoothers, joint by joint",
        "CMU (AMC 01; BVH 06, 07; 08 to 14 and others; expmap; salsa), ReActIdle, UI-PRMD s01-s06 (Vicon, and "
        "Kinect beside it), at 1 to 2.5 times its speed, through simulated sensors; validated on CMU 02, ReActIdle "
        "013-015, UI-PRMD s07, s08",
        licence=LICENCES["default"],
        started_anew=lambda network: _measure_features(network, sensors, options.seed),
    )


def _rate_factor(step: int, steps: int) -> float:
    """Factor on the learning rate: a rise over 100 steps, then along a cosine to a hundredth."""
    return min(1.0, (step + 1) / 100) * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(step / steps, 1.0))))
