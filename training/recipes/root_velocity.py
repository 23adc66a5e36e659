"""The trajectory network and its training: root velocity (HM-VAE, section 3.3) and contacts (HuMoR, section 3.2).

Four skeleton convolutions with pooling over the skeleton and none over time, then a linear layer, as in the paper.
Unlike there, the convolutions see no future, so that no delay is added; the input is turned to the body's heading,
which the official code leaves to the network to learn; velocities are in m/s; and beside them the network predicts
their standard deviation and the probability of each contact (HuMoR's eight), which keeps the velocity consistent with
the feet in training.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import roma
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from steadypose.prior.body.kinematics import CONTACT_JOINTS
from steadypose.prior.body.skeleton import MIRROR, PARENTS, limbs
from steadypose.prior.fit.hmvae_network import SkeletonConv, SkeletonPool
from steadypose.prior.fit.tensors import heading, yaw_rotation
from steadypose.prior.models.layers import SLOPE, Level, pooling_levels
from steadypose.prior.models.root_velocity import CHANNELS, FRAME_S, TrajectoryConfig
from steadypose.prior.sim.noise import time_correlated
from steadypose.training.data.dataset import MotionSet, describe_data
from steadypose.training.loop import Recipe, Rng, TrainingOptions


class RootMotion(NamedTuple):
    """What the network predicts of each frame, in the frame of its input."""

    velocity: Tensor
    """(B, T, 3) m/s, of the root"""
    log_sigma: Tensor
    """(B, T, 3) log of the standard deviation of that along each axis, m/s"""
    contact_logits: Tensor
    """(B, T, 8) of `CONTACT_JOINTS`"""


class _Block(nn.Module):
    """Convolution, pooling over the skeleton, activation."""

    def __init__(self, in_channels: int, out_channels: int, level: Level, kernel: int) -> None:
        super().__init__()
        self.conv = SkeletonConv(in_channels, out_channels, level.neighbours, kernel, padding="causal")
        self.pool = SkeletonPool(level.groups)

    def forward(self, features: Tensor) -> Tensor:
        return F.leaky_relu(self.pool(self.conv(features)), SLOPE)


class TrajectoryNet(nn.Module):
    """Root velocity and contacts from joint positions, causal in time."""

    def __init__(self, config: TrajectoryConfig) -> None:
        super().__init__()
        self.config = config
        levels = pooling_levels(PARENTS)
        c = CHANNELS
        self.blocks = nn.ModuleList(_Block(c[k], c[k + 1], level, config.kernel) for k, level in enumerate(levels))
        self.head = nn.Linear(c[-1] * len(levels[-1].groups), 3 + 3 + len(CONTACT_JOINTS))

    def forward(self, joints: Tensor) -> RootMotion:
        """Every frame of joints (B, T, 22, 3): metres from the root, turned so that the body faces about +x.

        Before its first frame a window is taken to have stood still; the standard deviations know that.
        """
        features = _features(joints)
        for block in self.blocks:
            features = block(features)
        return _read(self.head(features.transpose(1, 2)))


def _read(outputs: Tensor) -> RootMotion:
    return RootMotion(*outputs.split([3, 3, len(CONTACT_JOINTS)], dim=-1))


def _features(joints: Tensor) -> Tensor:
    """(B, 22 * 6, T) of joints (B, T, 22, 3): position in metres, and velocity in m/s against the frame before.

    The paper feeds positions alone. A step of a few centimetres is then a small difference of large numbers, and
    training spends itself on learning to differentiate.
    """
    before = torch.cat([joints[:, :1], joints[:, :-1]], dim=1)
    velocity = (joints - before) / FRAME_S
    return torch.cat([joints, velocity], dim=-1).flatten(2).transpose(1, 2)


ITERATIONS, BATCH, LEARNING_RATE = 2_000, 64, 2e-3
"""Windows a step; the rate at the start."""

WINDOW = 48
"""Frames of a training window, 1.6 s."""

WARM_UP = 8
"""Frames of a window before which the trajectory is not accumulated: there is not yet motion enough to read."""

RATES = (0.75, 1.3)
"""Range of speeds at which motion is replayed in training."""

SCALES = (0.85, 1.15)
"""Range of factors on people's sizes in training."""

MIN_SPEED = 0.1
"""m/s: a window is drawn as often as its root is fast, and one that stands still as if it were this fast."""

TILT_SD, YAW_SD = np.deg2rad(3.0), np.deg2rad(10.0)
"""How well gravity and heading are known."""

NOISE_SD = 0.02
"""Metres: the most noise a window's joints get, half of it on average: what a prior leaves of a sensor's."""

OFFSET_SD = 0.015
"""Metres: how far a sensor's idea of a joint lies from that of the motion capture, for a whole window."""

IMPUTED_SHARE = 0.3
"""Of windows, one limb of which is hidden for a while and stays where it was."""

NLL_WEIGHT, CONTACT_WEIGHT, STILL_WEIGHT = 0.05, 0.1, 0.01
"""Of the standard deviation's likelihood, the contacts' cross-entropy, and their consistency with the velocity."""

_LIMBS = limbs(("elbow", "wrist"), ("shoulder", "elbow", "wrist"), ("knee", "ankle", "foot"))
_MIRRORED_CONTACTS = [1, 0, 3, 2, 5, 4, 7, 6]


@dataclass(frozen=True)
class _Windows:
    """What the network is given and should predict, in the frame of its input.

    Attributes:
        joints: (B, T, 22, 3) metres from the root, as the prior would leave them.
        velocity: (B, T, 3) m/s of the root.
        joint_velocity: (B, T, 8, 3) m/s of the contact joints against the root, true.
        contacts: (B, T, 8) labels.
    """

    joints: Tensor
    velocity: Tensor
    joint_velocity: Tensor
    contacts: Tensor


def train_trajectory(options: TrainingOptions) -> Path:
    """Train the trajectory network on prepared motion; the path of the weights."""
    train, val = options.motion(flat=True)
    starts, chances = _chances(train)

    def loss_of(model: TrajectoryNet, count: int, _: float, rng: Rng) -> tuple[Tensor, dict[str, float]]:
        windows = _sample(train, starts, chances, count, rng)
        return _loss(model(windows.joints), windows)

    recipe = Recipe(
        "trajectory", lambda: TrajectoryNet(TrajectoryConfig()), loss_of,
        lambda model: evaluate_trajectory(model, val), ITERATIONS, BATCH, LEARNING_RATE, evaluations=50, clip=math.inf,
    )  # fmt: skip
    described = f"root velocity and contacts, {TrajectoryConfig().context} frames of context, 22 joints"
    data = describe_data(options.weights, train, val)
    return recipe.train(options, described, data, calibrated=lambda model: calibrate(model, val))


_SPAN = int(np.ceil((WINDOW + 1) * RATES[1])) + 2


def _chances(motion: MotionSet) -> tuple[np.ndarray, np.ndarray]:
    """Where windows may start, and the chance of each: the faster the root, the likelier, for people mostly stand."""
    rows = motion.all_windows(_SPAN, step=2)
    path = motion.positions[rows, 0].diff(dim=1)[..., :2].norm(dim=-1).mean(dim=1).numpy() / FRAME_S
    weights = MIN_SPEED + path
    return rows[:, 0], weights / weights.sum()


def _sample(motion: MotionSet, starts: np.ndarray, chances: np.ndarray, count: int, rng: Rng) -> _Windows:
    """Random windows: replayed faster or slower, scaled, tilted, mirrored, and seen as a prior would leave them."""
    rows = rng.choice(starts, size=count, p=chances)[:, None] + np.arange(_SPAN)
    # One frame more at each end, for central differences.
    times = rng.uniform(*RATES, (count, 1)) * np.arange(WINDOW + 2)
    frames = torch.from_numpy(np.take_along_axis(rows, times.astype(np.int64), axis=1))
    positions = torch.lerp(
        motion.positions[frames], motion.positions[frames + 1], _tensor(times % 1.0)[..., None, None]
    )
    positions = positions * _tensor(rng.uniform(*SCALES, (count, 1, 1, 1)))
    facing = frames[torch.arange(count), rng.integers(0, WINDOW, count) + 1]
    yaw = heading(motion.rotations[facing, 0]) + _tensor(rng.normal(0.0, YAW_SD, count))
    tilt = roma.rotvec_to_rotmat(_tensor(rng.normal(0.0, TILT_SD, (count, 3)) * [1.0, 1.0, 0.0]))
    windows = _mirror_half(_windows(positions, motion.contacts[frames], tilt.mT @ yaw_rotation(yaw)))
    return replace(windows, joints=_corrupt(windows.joints, rng))


def _tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(values).float()


def _windows(positions: Tensor, contacts: Tensor, turn: Tensor) -> _Windows:
    """Windows of T frames from T + 2 frames of positions (B, T + 2, 22, 3), turned by (B, 3, 3) from the right."""
    joints = positions - positions[:, :, :1]
    moved = torch.cat([positions[:, :, :1], joints[:, :, list(CONTACT_JOINTS)]], dim=2)
    velocity = (moved[:, 2:] - moved[:, :-2]) / (2 * FRAME_S) @ turn[:, None]
    return _Windows(joints[:, 1:-1] @ turn[:, None], velocity[:, :, 0], velocity[:, :, 1:], contacts[:, 1:-1].float())


def _mirror_half(windows: _Windows) -> _Windows:
    """Exchange left and right, across the body's xz plane, in the first half of the windows."""
    half = len(windows.joints) // 2
    flip = torch.tensor([1.0, -1.0, 1.0])

    def mirror(x: Tensor, order: list[int] | None = None, flip: Tensor | float = flip) -> Tensor:
        mirrored = x[:half] if order is None else x[:half][:, :, order]
        return torch.cat([mirrored * flip, x[half:]])

    return _Windows(
        joints=mirror(windows.joints, MIRROR.tolist()),
        velocity=mirror(windows.velocity),
        joint_velocity=mirror(windows.joint_velocity, _MIRRORED_CONTACTS),
        contacts=mirror(windows.contacts, _MIRRORED_CONTACTS, flip=1.0),
    )


def _corrupt(joints: Tensor, rng: Rng, noise_sd: float | None = None) -> Tensor:
    """Add noise that lasts (AR(1)) to joints (B, T, 22, 3), the root's too, and hold a limb still in some windows.

    Args:
        joints: metres from the root.
        rng: random numbers.
        noise_sd: metres, of every window; random up to `NOISE_SD` if left out.
    """
    count, time = joints.shape[:2]
    sd = rng.uniform(0.0, NOISE_SD, (count, 1, 1, 1)) if noise_sd is None else np.full((count, 1, 1, 1), noise_sd)
    memory = rng.uniform(0.7, 0.95, (count, 1, 1))
    noise = time_correlated(rng.normal(0.0, 1.0, tuple(joints.shape)), memory, axis=1)
    offset = rng.normal(0.0, OFFSET_SD, (count, 1, *joints.shape[2:]))
    noisy = joints + _tensor(sd * noise + offset)
    noisy = noisy - noisy[:, :, :1]
    for row in np.flatnonzero(rng.random(count) < IMPUTED_SHARE):
        limb = _LIMBS[rng.integers(len(_LIMBS))]
        start = int(rng.integers(1, time))
        end = start + int(rng.integers(3, 30))
        noisy[row, start:end, limb] = noisy[row, start - 1, limb]
    return noisy


def _loss(predicted: RootMotion, windows: _Windows) -> tuple[Tensor, dict[str, float]]:
    """Equation 9, the likelihood of its error, and HuMoR's two terms of contacts; every term a mean."""
    error = predicted.velocity - windows.velocity
    l_velocity = error.square().mean()
    l_trajectory = (error[:, WARM_UP:].cumsum(dim=1) * FRAME_S).square().mean()
    l_nll = (0.5 * (error.detach().square() * torch.exp(-2.0 * predicted.log_sigma)) + predicted.log_sigma).mean()
    l_contact = F.binary_cross_entropy_with_logits(predicted.contact_logits, windows.contacts)
    joint_velocity = predicted.velocity[:, :, None] + windows.joint_velocity
    l_still = (torch.sigmoid(predicted.contact_logits) * joint_velocity.square().sum(dim=-1)).mean()
    loss = l_velocity + l_trajectory + NLL_WEIGHT * l_nll + CONTACT_WEIGHT * l_contact + STILL_WEIGHT * l_still
    return loss, {
        "L_velocity": l_velocity.item(), "L_trajectory": l_trajectory.item(), "L_contact": l_contact.item(),
    }  # fmt: skip


@torch.no_grad()
def _validate(model: TrajectoryNet, motion: MotionSet, length: int, count: int) -> tuple[RootMotion, _Windows]:
    """What the network predicts of about ``count`` windows of ``length`` frames of unseen people with 1 cm of noise."""
    rows = motion.all_windows(length + 2, step=length)
    rows = rows[:: max(len(rows) // count, 1)]
    turn = yaw_rotation(heading(motion.rotations[rows[:, length // 2], 0]))
    windows = _windows(motion.positions[rows], motion.contacts[rows], turn)
    joints = _corrupt(windows.joints, np.random.default_rng(0), noise_sd=0.01)
    windows = replace(windows, joints=joints)
    return model(joints), windows


def evaluate_trajectory(model: TrajectoryNet, motion: MotionSet) -> dict[str, float]:
    """Errors on unseen people.

    Returns:
        ``val velocity m/s``, the root mean square of the velocity's error along an axis; ``val 1 s drift cm``, that of
        the horizontal trajectory after one second; ``val feet F1`` of the contacts of heels and toes.
    """
    predicted, windows = _validate(model, motion, WINDOW, count=512)
    error = (predicted.velocity - windows.velocity)[:, WARM_UP:]
    drift = error[:, :30, :2].sum(dim=1).norm(dim=-1) * FRAME_S * 100
    touching, true = predicted.contact_logits[..., 2:6] > 0, windows.contacts[..., 2:6] > 0.5
    hits = (touching & true).sum()
    return {
        "val velocity m/s": float(error.square().mean().sqrt()),
        "val 1 s drift cm": float(drift.square().mean().sqrt()),
        "val feet F1": float(2 * hits / (touching.sum() + true.sum())),
    }


def calibrate(model: TrajectoryNet, motion: MotionSet) -> TrajectoryConfig:
    """The network's configuration with the errors that validation finds: how large they are, and how long they last.

    A second of accumulated velocity strays by sigma² · correlation_s if an error of size sigma lasts correlation_s.
    """
    predicted, windows = _validate(model, motion, WINDOW, count=2048)
    error = ((predicted.velocity - windows.velocity) * torch.exp(-predicted.log_sigma))[:, WARM_UP:]
    size = error.square().mean(dim=(0, 1))
    strayed = (error[:, :30].sum(dim=1) * FRAME_S).square().mean(dim=0)
    axes = [slice(0, 2), slice(2, 3)]
    return replace(
        model.config,
        sigma_scale=tuple(float(size[a].mean().sqrt()) for a in axes),
        correlation_s=tuple(float(strayed[a].mean() / size[a].mean()) for a in axes),
    )
