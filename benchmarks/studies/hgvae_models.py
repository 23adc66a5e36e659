"""Small HG-VAEs trained for tables and pictures: stochastic depth at equal capacity, and conditioned on actions."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from steadypose.prior.models.hgvae.config import JOINT_NODES, SCALE, HGVAEConfig, Level
from steadypose.training.data.dataset import MotionSet
from steadypose.training.data.hgvae_windows import Batch, Windows, mean_tracks
from steadypose.training.loop import TrainingRun
from steadypose.training.networks.hgvae import HGVAE
from steadypose.training.recipes.hgvae import CLIP_ENTRY, evidence

DEPTHS = (1, 2, 4, 8, 16)
"""Stochastic levels, of the paper's table 1."""

_NODES = (1, 8, 24, JOINT_NODES)
"""of the graphs, each of which has four of the 16 levels"""


def of_depth(depth: int) -> HGVAEConfig:
    """16 levels, of which the lowest ``depth`` are random: the same parameters at every depth.

    With many latents a node, the finest level alone can say all there is to say of a window.
    """
    levels = tuple(Level(nodes, 3) for nodes in _NODES for _ in range(4))
    return HGVAEConfig(features=32, levels=levels, stochastic=depth)


DEPTH_RATE = 8e-3
"""Adam's rate for models with the branches of `of_depth` closed at first: at 1e-3 all depths are still learning to walk
when an hour is over, and which one is ahead says nothing of depth."""


MIN_SIGMA = 0.05
"""Metres, lower bound of the standard deviation of generative models: without it, the trunk's millimetres outweigh the
arms' motion in the likelihood, and neither latents nor samples represent it."""


def of_levels() -> HGVAEConfig:
    """Four levels, the finest with few latents, so that the others are used and samples of all are plausible bodies."""
    return HGVAEConfig(features=48, levels=(Level(1, 48), Level(8, 24), Level(24, 24), Level(JOINT_NODES, 2)))


def with_actions(count: int) -> HGVAEConfig:
    """One level, with the action as one-hot beside its latent: with several, the top one is hardly used."""
    return HGVAEConfig(features=48, levels=(Level(1, 96),), actions=count)


class ActionWindows(Windows):
    """Windows of some actions, each action drawn as often.

    Attributes:
        names: of the actions.
    """

    def __init__(self, motion: MotionSet, names: Sequence[str]) -> None:
        super().__init__(motion)
        self.names = names
        kind = np.array([action_name(action) for action in motion.action])
        self._parts = [Windows(motion.only(kind == name)) for name in names]

    def draw_actions(
        self, count: int, frames: int, rng: np.random.Generator
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.intp]]:
        """``count`` random windows, body sizes, and the number of each window's action."""
        actions = rng.integers(len(self.names), size=count)
        positions, sizes = np.empty((count, frames, 22, 3)), np.empty(count)
        for k, part in enumerate(self._parts):
            rows = np.flatnonzero(actions == k)
            if len(rows):
                found = part.motion.sample(len(rows), frames, (1,), rng)
                positions[rows], sizes[rows] = part.clean(found, np.zeros(len(rows), dtype=bool))
        return positions, sizes, actions


def action_name(name: str) -> str:
    """What is done, without the style and the number of a take: 'walk-turn-left active' is 'walk-turn-left'."""
    return re.sub(r"\W*[_ ]?\d*$", "", name.split()[0]) if name else ""


def train(
    config: HGVAEConfig,
    windows: Windows,
    directory: Path,
    steps: int,
    batch: int = 32,
    least_sigma: float = 0.0,
    rate: float = 1e-3,
) -> HGVAE:
    """By the evidence lower bound alone, as the paper; a run of the same name in ``directory`` is resumed.

    ``least_sigma``, metres, is the least standard deviation that the likelihood takes the model to state; ``rate`` is
    Adam's at the start.
    """
    torch.manual_seed(0)
    model = HGVAE(config)
    model.mean.copy_(mean_tracks(windows, config.frames, count=500))
    optimiser = torch.optim.Adam(model.parameters(), lr=rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    run = TrainingRun(directory, model, schedule, steps, evaluations=8)
    entries = JOINT_NODES * config.frames

    def loss_of(count: int, done: float, rng: np.random.Generator) -> tuple[Tensor, dict[str, float]]:
        action = None
        if isinstance(windows, ActionWindows):
            positions, sizes, actions = windows.draw_actions(count, config.frames, rng)
            action = one_hot(actions, config.actions)
        else:
            positions, sizes = windows.draw(count, config.frames, rng)
        whole = Batch.of(model, positions, positions, sizes)
        drawn = model(whole.x, whole.certainty, spread=torch.ones(count, 1), action=action)
        if least_sigma:
            log_var = drawn.tracks.log_var.clamp(min=2 * math.log(least_sigma / SCALE))
            drawn = drawn._replace(tracks=drawn.tracks._replace(log_var=log_var))
        likelihood, kl = evidence(drawn, whole.target)
        beta = min(0.001 + done / 0.2, 1.0)
        terms = {"ELBO": (likelihood - kl).mean().item() / entries, "KL": kl.mean().item()}
        return (beta * kl - likelihood).mean(), terms

    run.minimise(loss_of, dict, batch, seed=0, clip=CLIP_ENTRY * entries**0.5)
    return model


def draw_tops(top: NDArray[np.float64], actions: NDArray[np.intp], wanted: NDArray[np.intp], seed: int) -> Tensor:
    """Top latents sampled for the actions ``wanted``, each from a Gaussian fitted to those of windows of that action.

    The prior N(0, I) is far wider than the aggregate posterior (ex-post density estimation, Ghosh et al. 2020).

    Args:
        top: (B, latent) posterior means of real windows, whose
        actions: (B,) are known.
        wanted: (M,)
        seed: of what is drawn.
    """
    rng = np.random.default_rng(seed)
    drawn = np.empty((len(wanted), top.shape[1]))
    for k in np.unique(wanted):
        of_action, rows = top[actions == k], np.flatnonzero(wanted == k)
        spread = np.cov(of_action.T) + 1e-4 * np.eye(top.shape[1])
        drawn[rows] = rng.multivariate_normal(of_action.mean(axis=0), spread, len(rows))
    return torch.from_numpy(drawn).float()


def one_hot(actions: NDArray[np.intp], count: int) -> Tensor:
    """(B, count)"""
    return torch.nn.functional.one_hot(torch.from_numpy(actions).long(), count).float()
