"""Training of the refinement model, HM-VAE (section 3.2 and 5 of the paper)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import roma
import torch
from torch import Tensor
from torch.optim import Adam, Optimizer
from torch.optim.lr_scheduler import LRScheduler, MultiStepLR

from steadypose.prior.body.inverse_kinematics import solve_rotations
from steadypose.prior.body.skeleton import limbs
from steadypose.prior.fit.hmvae_network import HMVAE
from steadypose.prior.fit.tensors import forward_kinematics, from_6d, remove_heading, to_6d
from steadypose.prior.models.hmvae import HMVAEConfig
from steadypose.training.data.dataset import (
    MotionSet,
    SpeedWeightedWindows,
    describe_data,
    mirror_offsets,
    mirror_rotations,
)
from steadypose.training.loop import Recipe, Rng, TrainingOptions

KL_WEIGHT = 1e-5
"""Weight beta of equation 3; it matches `Posterior.kl`'s reduction and losses that are means. Deviations from a mean
pose are small, so with the paper's beta (0.003), the KL divergence outweighs the latents' gain and they collapse to the
prior."""

GLOBAL_FIRST = 0.08
"""Share of the training in which z_l is detached, so that z_g is used (official: 20,000 of 250,000 steps)."""

LOCAL_WARM_UP = 0.4
"""Share of the training over which beta of z_l then rises from 0. With the full beta at once, z_l collapses to its
prior and the reconstruction error rises by a tenth, because the decoder has learnt to ignore z_l
(benchmarks/NOTEBOOK.md)."""

TILT_SD = math.radians(3.0)

_LIMBS = limbs(("elbow", "wrist"), ("knee", "ankle", "foot"))

NOISY, NOISE, HELD = 0.5, 0.03, 0.25
"""Corruption of the input, whose target is the clean window: share of windows with noise; largest standard deviation of
the noise along an axis, metres, with a random share of bias; and share of these windows with a frozen limb."""

LONG_CONFIG = HMVAEConfig(window=64, kernel=7, strides=(2, 2, 2, 2), local_latent=24, global_latent=24, about_mean=True)
"""Sizes for windows of 64 frames, used by `prior.fit.optimise`. They are the official sizes, except for half the
kernel, twice the dimensions of z_l (for fast motion), and encoding about the mean pose."""


@dataclass(frozen=True)
class Hyperparameters:
    iterations: int  # number of optimiser steps
    batch: int  # windows per step
    learning_rate: float  # initial learning rate of Adam; it falls to a third twice
    joint_weight: float  # lambda of equation 5
    strides: Sequence[int]  # frame strides of windows; each entry has the same probability
    speed_weighted: bool  # whether windows are speed-weighted: fast motion is drawn more often, large sources less


# The paper varies the frame rate. Prepared motion has 30 Hz, so its halves and thirds are available. Half of the
# windows keep the live node's rate.
SHORT = Hyperparameters(1_800, 64, 2e-3, 200.0, strides=(1, 1, 1, 2, 2, 3), speed_weighted=False)
"""Hyperparameters with the official schedule (250,000 steps of 8 windows at 1e-4) condensed into fewer, larger steps.
The proportions are kept: z_l enters late, and the learning rate falls twice."""

LONG = Hyperparameters(12_000, 16, 1e-3, 100.0, strides=(1, 1, 2, 3), speed_weighted=True)


def train_hmvae(options: TrainingOptions) -> Path:
    return _train("hmvae", HMVAEConfig(about_mean=True), "window 8 about its mean pose", SHORT, options)


def train_long_hmvae(options: TrainingOptions) -> Path:
    """Train the denoising HM-VAE over windows of 64 frames for `complete --optimise`; returns the weights' path."""
    return _train("hmvae64", LONG_CONFIG, "window 64 about its mean pose", LONG, options)


def _train(name: str, config: HMVAEConfig, described: str, used: Hyperparameters, options: TrainingOptions) -> Path:
    train, val = options.motion()
    described = f"HM-VAE, {described}, 22 joints (prior/fit/hmvae_network.py)"
    return recipe_of(name, config, train, val, used).train(
        options, described, describe_data(options.weights, train, val)
    )


def recipe_of(name: str, config: HMVAEConfig, train: MotionSet, val: MotionSet, used: Hyperparameters) -> Recipe[HMVAE]:
    """Return the recipe of a VAE of windows, with equations 3 and 5 to 8."""
    windows = SpeedWeightedWindows(train) if used.speed_weighted else train

    def loss_of(model: HMVAE, count: int, done: float, rng: Rng) -> tuple[Tensor, dict[str, float]]:
        rows = windows.sample(count, model.window, used.strides, rng)
        rotations, offsets = _augment(train.rotations[rows], train.offsets[rows[:, 0]])
        rotations, _ = remove_heading(rotations, model.window // 2 - 1)
        noisy = corrupt(rotations, offsets, rng)
        return _loss(model, noisy, rotations, offsets, (done - GLOBAL_FIRST) / LOCAL_WARM_UP, used.joint_weight)

    def falls_twice(optimiser: Optimizer, steps: int) -> LRScheduler:
        return MultiStepLR(optimiser, [int(steps * share) for share in (0.6, 0.85)], gamma=0.3)

    return Recipe(
        name, lambda: HMVAE(config), loss_of, lambda model: evaluate_hmvae(model, val), used.iterations, used.batch,
        used.learning_rate, decay=1e-4, optimiser=Adam, schedule=falls_twice, evaluations=24,
    )  # fmt: skip


def _augment(rotations: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
    """Mirror half of the windows, and tilt all slightly, because no camera is levelled perfectly.

    The paper turns windows at random in all directions. Here, heading normalisation removes yaw exactly, and gravity is
    known up to a small error of its direction.
    """
    half = len(rotations) // 2
    rotations = torch.cat([mirror_rotations(rotations[:half]), rotations[half:]])
    offsets = torch.cat([mirror_offsets(offsets[:half]), offsets[half:]])
    tilt = torch.randn(len(rotations), 3) * torch.tensor([TILT_SD, TILT_SD, 0.0])
    rotations[:, :, 0] = roma.rotvec_to_rotmat(tilt)[:, None] @ rotations[:, :, 0]
    return rotations, offsets


def corrupt(rotations: Tensor, offsets: Tensor, rng: Rng, noise: float | None = None) -> Tensor:
    """Return windows (B, T, 22, 3, 3) solved from noisy joints with bones (B, 22, 3) metres.

    ``noise`` is the independent noise of all joints in each frame, metres along an axis; random if omitted.
    """
    joints = forward_kinematics(rotations, offsets[:, None])[0].double().numpy()
    count, frames = joints.shape[:2]
    if noise is None:
        sigma = rng.uniform(0.0, NOISE, (count, 1, 1, 1)) * (rng.random((count, 1, 1, 1)) < NOISY)
        slow = rng.random((count, 1, 1, 1))
        constant = rng.standard_normal((count, 1, 22, 3))
        joints += sigma * (np.sqrt(1.0 - slow) * rng.standard_normal(joints.shape) + np.sqrt(slow) * constant)
        for row in np.flatnonzero((rng.random(count) < HELD) & (sigma[:, 0, 0, 0] > 0)):
            limb = _LIMBS[int(rng.integers(len(_LIMBS)))]
            first = int(rng.integers(1, frames))
            joints[row][first:, limb] = joints[row][first - 1, limb]
    else:
        sigma = np.full((count, 1, 1, 1), noise)
        joints += sigma * rng.standard_normal(joints.shape)
    solved = solve_rotations(joints, offsets[:, None].double().numpy())
    return torch.where(torch.from_numpy(sigma > 0)[..., None], torch.from_numpy(solved).float(), rotations)


def _loss(
    model: HMVAE, noisy: Tensor, rotations: Tensor, offsets: Tensor, local_weight: float, joint_weight: float
) -> tuple[Tensor, dict[str, float]]:
    """Equations 3 and 5 to 8, each term a mean. ``local_weight`` is z_l's share of beta; below 0, z_l is detached."""
    x = to_6d(rotations)
    given = to_6d(noisy)
    posterior = model.encode(given)
    local, deep = posterior.sample()
    local_kl, global_kl = posterior.kl()
    if local_weight < 0:  # as in the official code, its noise still reaches the decoder
        local, local_kl = local.detach(), local_kl.detach()
    decoded = model.placed(model.decode(local, deep), given)
    matrices = from_6d(decoded)
    joints, _ = forward_kinematics(torch.stack([matrices, rotations]), offsets[:, None])
    l_6d = (decoded - x).square().mean()
    l_rot = (matrices - rotations).square().mean()
    l_joints = (joints[0] - joints[1]).square().mean()
    kl = global_kl + min(max(local_weight, 0.0), 1.0) * local_kl
    loss = l_6d + l_rot + joint_weight * l_joints + KL_WEIGHT * kl
    return loss, {
        "loss": loss.item(), "L_6d": l_6d.item(), "KL local": local_kl.item(), "KL global": global_kl.item(),
    }  # fmt: skip


@torch.no_grad()
def evaluate_hmvae(model: HMVAE, motion: MotionSet, frames: int = 16_384) -> dict[str, float]:
    """Evaluate the reconstruction from the posterior's mean on unseen people. Returns ``val MPJPE mm`` over whole
    windows, root-centred, and ``val centre mm``, of the frame that refinement keeps."""
    window = model.window
    rows = motion.all_windows(window, step=1)
    rows = rows[:: max(len(rows) * window // frames, 1)]
    centre = window // 2 - 1
    rotations, _ = remove_heading(motion.rotations[rows], centre)
    decoded = from_6d(model.reconstruct(to_6d(rotations)))
    joints, _ = forward_kinematics(torch.stack([decoded, rotations]), motion.offsets[rows[:, 0]][:, None])
    error = (joints[0] - joints[1]).norm(dim=-1) * 1000
    return {
        "val MPJPE mm": float(error.mean()), "val centre mm": float(error[:, centre].mean()),
        "val noise left %": 100 * _noise_left(model, rotations, motion.offsets[rows[:, 0]]),
    }  # fmt: skip


def _noise_left(model: HMVAE, rotations: Tensor, offsets: Tensor) -> float:
    """Return the decoded joints' error in windows with 2 cm of noise, relative to the error before decoding."""
    noisy = corrupt(rotations, offsets, np.random.default_rng(0), noise=0.02)
    decoded = from_6d(model.reconstruct(to_6d(noisy)))
    joints, _ = forward_kinematics(torch.stack([decoded, noisy, rotations]), offsets[:, None])
    left, before = (joints[:2] - joints[2]).norm(dim=-1).mean(dim=(1, 2, 3))
    return float(left / before)
