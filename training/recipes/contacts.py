"""The contact network and its training: ``steadypose train contacts``.

HuMoR's decoder predicts contact of eight joints; its label requires that a joint is low and slower than 0.15 m/s.
Compared with force plates, this misses a third of a walker's stance, because a foot rolls over its heel and toe. Here,
each joint has two labels, load and rest (`prior.body.kinematics.label_contacts`). A separate recurrent network reads
smoothed joints with their standard deviations, in one pass per frame.

Clips of true motion are passed once through simulated sensors and the live node's smoother. Windows of its output are
then drawn and turned, and lose entries that a sensor may lack: the root, the ground, joints.
"""

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track
from torch import Tensor, nn
from torch.nn import functional as F

from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import CONTACT_JOINTS, LOAD_SPEED, REST_SPEED, heading, label_contacts
from steadypose.prior.body.skeleton import MIRROR, J
from steadypose.prior.models.contacts import FEATURES, contact_features
from steadypose.prior.models.mixture.inference import MixtureSmoother
from steadypose.prior.sim.noise import time_correlated
from steadypose.prior.timing.rate import FPS
from steadypose.training.data.dataset import MotionSet, describe_data
from steadypose.training.data.prepare import made_once
from steadypose.training.loop import Recipe, Rng, TrainingOptions

OUTPUTS = 2 * len(CONTACT_JOINTS)  # number of outputs: load of each joint, then rest of each joint


@dataclass(frozen=True)
class ContactConfig:
    hidden: int = 64  # size of a body's hidden state


class ContactNet(nn.Module):
    """A gated recurrent unit (Cho et al. 2014) and a linear layer."""

    def __init__(self, config: ContactConfig) -> None:
        super().__init__()
        self.config = config
        self.unit = nn.GRU(FEATURES, config.hidden, batch_first=True)
        self.head = nn.Linear(config.hidden, OUTPUTS)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Logits of load and of rest, (B, T, 8) each, of features (B, T, FEATURES) from a body's first frame on."""
        load, rest = self.head(self.unit(features)[0]).chunk(2, dim=-1)
        return load, rest


ITERATIONS, BATCH, LEARNING_RATE = 3_000, 64, 4e-3  # number of steps; clips per step; initial learning rate
FRAMES = 90  # length of a clip, frames; it includes the start of a stream
CLIPS = {"train": 3072, "val": 384}  # number of smoothed clips of each split
SIDE_BY_SIDE = 64  # number of clips that are smoothed together as bodies of one stream
DELAYS = (0, 2, 4, 4, 8)  # delays of the smoother, frames
MIN_SPEED = 0.1  # least speed in the sampling weight of a clip, which is proportional to the speed of its feet, m/s
SCALES = (0.8, 1.15)  # range of factors on people's sizes

SOLE_SD = 0.01
"""Standard deviation of offsets of joints, by rig and shoe, and of the ground from the training motion's, metres."""

YAW_SD = math.radians(15.0)  # standard deviation of the heading's error, radians

ROOT_UNOBSERVED, GROUND_UNKNOWN, FEET_ALONE = 0.25, 0.25, 0.15
"""Shares of windows with joints relative to the root only, with unknown ground, and with only the feet known."""

_HANDS_KNEES_ROOT = [0, *(J[f"{side}_{part}"] for side in ("left", "right") for part in ("knee", "wrist"))]
_FEET = slice(2, 6)


@dataclass(frozen=True)
class Pool:
    """Smoothed clips, (C, T, ...)."""

    positions: NDArray[np.float32]  # (C, T, 22, 3) metres, world, float32
    sigma: NDArray[np.float32]  # (C, T, 22) metres
    yaw: NDArray[np.float32]  # (C, T) radians
    load: NDArray[np.bool_]  # (C, T, 8) labels
    rest: NDArray[np.bool_]  # (C, T, 8)


def smoothed_clips(motion: MotionSet, count: int, seed: int) -> Pool:
    """Draw ``count`` clips, weighted by speed, and simulate people of several sizes and several sensors."""
    rng = np.random.default_rng(seed)
    starts = motion.all_windows(FRAMES, 5)[:, 0]
    feet = motion.positions[:, [J["left_ankle"], J["right_ankle"]]].numpy()
    moved = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(feet, axis=0), axis=-1).mean(axis=1) * FPS)])
    chances = MIN_SPEED + (moved[starts + FRAMES - 1] - moved[starts]) / FRAMES
    first = rng.choice(starts, count, p=chances / chances.sum())
    parts = [
        _smoothed(motion, first[k : k + SIDE_BY_SIDE], rng)
        for k in track(range(0, count, SIDE_BY_SIDE), description="smoothing")
    ]
    return Pool(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _smoothed(motion: MotionSet, first: NDArray[np.int64], rng: Rng) -> tuple[NDArray, ...]:
    rows = first[:, None] + np.arange(FRAMES)
    truth = motion.positions[rows].numpy().astype(np.float64)
    yaw = heading(motion.rotations[rows, 0].numpy())
    mirrored = rng.random(len(rows)) < 0.5
    truth[mirrored] = truth[mirrored][:, :, MIRROR] * (1.0, -1.0, 1.0)
    yaw[mirrored] *= -1.0
    truth *= rng.uniform(*SCALES, (len(rows), 1, 1, 1))
    delay = int(rng.choice(DELAYS))
    smoother, observed = MixtureSmoother(delay, len(rows)), truth + _errors(truth.shape, rng)
    estimates = [smoother.update(observed[:, t], t / FPS) for t in range(FRAMES)]
    kept = [estimate for estimate in estimates if estimate is not None]
    positions, sigma = np.full(truth.shape, np.nan), np.full(truth.shape[:3], np.nan)
    positions[:, : len(kept)] = np.stack([estimate.positions for estimate in kept], axis=1)
    sigma[:, : len(kept)] = np.stack([estimate.sigma for estimate in kept], axis=1)
    load, rest = (np.stack([label_contacts(clip, FPS, speed) for clip in truth]) for speed in (LOAD_SPEED, REST_SPEED))
    return positions.astype(np.float32), sigma.astype(np.float32), yaw.astype(np.float32), load, rest


def _errors(shape: tuple[int, ...], rng: Rng) -> Floats:
    """(C, T, 22, 3) metres, of as many sensors as clips: jitter, time-correlated noise, and that of the whole body."""
    count, frames, joints, _ = shape
    of_clip = (count, 1, 1, 1)
    by_joint = np.exp(0.4 * rng.standard_normal((count, 1, joints, 1)))
    fast = 10 ** rng.uniform(-3.0, -1.3, of_clip) * by_joint * (rng.random(of_clip) < 0.75)
    slow = 10 ** rng.uniform(-3.0, -1.5, of_clip) * by_joint * (rng.random(of_clip) < 0.6)
    whole = 10 ** rng.uniform(-3.0, -1.7, of_clip) * (rng.random(of_clip) < 0.4)
    memory = rng.uniform(0.8, 0.98, of_clip[:1])[:, None, None]
    bias = rng.standard_normal(shape) * slow + rng.standard_normal((count, frames, 1, 3)) * whole
    return time_correlated(bias, memory, axis=1) + fast * rng.standard_normal(shape)


def draw(pool: Pool, clips: NDArray[np.int64], rng: Rng) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Features (C, T - 1, F), labels of load and rest (C, T - 1, 8), and which frames count (C, T - 1, 1)."""
    positions = pool.positions[clips].astype(np.float64)
    count, frames = positions.shape[:2]
    alone = rng.random(count) < FEET_ALONE
    positions[np.ix_(alone, np.arange(frames), _HANDS_KNEES_ROOT)] = np.nan
    positions[..., 2] += rng.normal(0.0, SOLE_SD, (count, 1, 1)) + rng.normal(0.0, SOLE_SD / 2, (count, 1, 22))
    root_observed = (alone | (rng.random(count) >= ROOT_UNOBSERVED)).astype(float)
    known = rng.random(count) >= GROUND_UNKNOWN
    ground = np.where(known[:, None], np.zeros((count, len(CONTACT_JOINTS))), np.nan)
    yaw = pool.yaw[clips] + np.where(alone, rng.uniform(-np.pi, np.pi, count), rng.normal(0.0, YAW_SD, count))[:, None]

    def rows(values: NDArray[Any]) -> NDArray[Any]:
        return values.reshape(-1, *values.shape[2:])

    def of_frames(values: Floats) -> Floats:
        return np.repeat(values, frames - 1, axis=0)

    features = contact_features(
        rows(positions[:, 1:]), rows(positions[:, :-1]), 1.0 / FPS, rows(yaw[:, 1:]), rows(pool.sigma[clips][:, 1:]),
        of_frames(root_observed), of_frames(ground),
    )  # fmt: skip
    estimated = np.isfinite(pool.sigma[clips][:, 1:, :1])
    load, rest, counts = pool.load[clips][:, 1:], pool.rest[clips][:, 1:], estimated
    counts = np.repeat(counts, load.shape[-1], axis=-1)
    counts[alone, :, : _FEET.start] = counts[alone, :, _FEET.stop :] = False
    inputs = torch.from_numpy(np.nan_to_num(features)).reshape(count, frames - 1, FEATURES)
    return inputs, torch.from_numpy(load).float(), torch.from_numpy(rest).float(), torch.from_numpy(counts).float()


def train_contacts(options: TrainingOptions) -> Path:
    motion = dict(zip(CLIPS, options.motion(flat=True), strict=True))
    train, val = (_pool(options.path("contacts").parent, motion[split], split, options.seed) for split in CLIPS)

    def loss_of(model: ContactNet, count: int, _: float, rng: Rng) -> tuple[Tensor, dict[str, float]]:
        features, load, rest, counts = draw(train, rng.integers(len(train.yaw), size=count), rng)
        losses = [
            (F.binary_cross_entropy_with_logits(logits, label, reduction="none") * counts).sum() / counts.sum()
            for logits, label in zip(model(features), (load, rest), strict=True)
        ]
        return losses[0] + losses[1], {"L_load": losses[0].item(), "L_rest": losses[1].item()}

    recipe = Recipe(
        "contacts", lambda: ContactNet(ContactConfig()), loss_of, lambda model: evaluate_contacts(model, val),
        ITERATIONS, BATCH, LEARNING_RATE, f"clips of {FRAMES} frames",
    )  # fmt: skip
    described = (
        f"load and rest of {len(CONTACT_JOINTS)} joints, a recurrent network, on {CLIPS['train']} clips through "
        "simulated sensors and the smoother"
    )
    return recipe.train(options, described, describe_data(options.weights, *motion.values()))


def _pool(directory: Path, motion: MotionSet, split: str, seed: int) -> Pool:
    make = partial(smoothed_clips, motion, CLIPS[split], seed + (split == "val"))
    return Pool(**made_once(directory / f"clips-{split}.npz", lambda: vars(make())))


def evaluate_contacts(model: ContactNet, pool: Pool) -> dict[str, float]:
    """F1 of the feet, of load and of rest, over all clips."""
    features, *labels, counts = draw(pool, np.arange(len(pool.yaw)), np.random.default_rng(0))
    counted = counts[..., _FEET] > 0
    scores = {}
    for name, logits, label in zip(("load", "rest"), model(features), labels, strict=True):
        yes, true = logits[..., _FEET][counted] > 0, label[..., _FEET][counted] > 0.5
        scores[f"val {name} F1"] = float(2 * (yes & true).sum() / (yes.sum() + true.sum()))
    return scores
