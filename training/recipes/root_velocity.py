"""The trajectory network and its training: root velocity from the body's own motion (HM-VAE, section 3.3).

The paper convolves joint positions over the skeleton and time. Here, a recurrent network reads each frame's positions
and velocities, turned to the body's heading; the official code lets the network learn this. It reads no future frames,
so it adds no delay. It also predicts the velocity's standard deviation and, in training only, HuMoR's eight contacts.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import roma
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from steadypose.prior.body.kinematics import CONTACT_JOINTS
from steadypose.prior.body.skeleton import MIRROR, limbs
from steadypose.prior.fit.tensors import heading, yaw_rotation
from steadypose.prior.models.root_velocity import FASTEST, FEATURES, FRAME_S, FROM_ROOT, SPEED, TrajectoryConfig
from steadypose.prior.sim.noise import time_correlated
from steadypose.training.data.dataset import MotionSet, describe_data
from steadypose.training.loop import Recipe, Rng, TrainingOptions


class RootMotion(NamedTuple):
    """The network's predictions for each frame, in the frame of the body's heading."""

    velocity: Tensor  # (B, T, 3) m/s, velocity of the root
    log_sigma: Tensor  # (B, T, 3) logarithm of the velocity's standard deviation along each axis, in m/s
    contact_logits: Tensor  # (B, T, 8) logits of contact of `CONTACT_JOINTS`


class TrajectoryNet(nn.Module):
    """A gated recurrent unit (Cho et al. 2014) and a linear layer."""

    def __init__(self, config: TrajectoryConfig) -> None:
        super().__init__()
        self.config = config
        self.motion = nn.GRU(FEATURES, config.hidden, batch_first=True)
        self.head = nn.Linear(config.hidden, 3 + 3 + len(CONTACT_JOINTS))

    def forward(self, features: Tensor) -> RootMotion:
        """Predict for every frame of `velocity_features` (B, T, FEATURES) from a body's first frame on."""
        return RootMotion(*self.head(self.motion(features)[0]).split([3, 3, len(CONTACT_JOINTS)], dim=-1))


def _features(joints: Tensor, turn: Tensor) -> Tensor:
    """`velocity_features` (B, T, FEATURES) of joints (B, T, 22, 3) metres from the root, turned by ``turn``."""
    before = torch.cat([joints[:, :1], joints[:, :-1]], dim=1)
    velocity = ((joints - before) / FRAME_S @ turn).clamp(-FASTEST, FASTEST) / SPEED
    return torch.cat([joints @ turn / FROM_ROOT, velocity], dim=-1).flatten(2)


ITERATIONS, BATCH, LEARNING_RATE = 6_000, 64, 4e-3  # number of steps; windows per step; initial learning rate
WINDOW = 72  # length of a training window, frames (2.4 s)
WARM_UP = 12  # number of first frames of a window without a loss, because they contain too little motion
RATES = (0.6, 2.0)  # range of factors on the speed of training motion
SCALES = (0.8, 1.15)  # range of factors on people's sizes in training
MIN_SPEED = 0.15  # least speed in the sampling weight of a window, which is proportional to the speed of its root, m/s

TILT_SD, YAW_SD, YAW_STEP_SD = np.deg2rad(3.0), np.deg2rad(6.0), np.deg2rad(1.0)
"""Standard deviations of the errors of gravity and of a window's heading, and of the heading error's change per frame,
radians."""

NOISE_SD = 0.02
"""Largest noise of a window's joints, on average half of it, metres: the noise that remains after the prior."""

OFFSET_SD = 0.015
"""Standard deviation of the offset between a sensor's and motion capture's definition of a joint in a window,
metres."""

IMPUTED_SHARE = 0.3  # share of windows in which a limb is hidden for a while and held at its last position

VELOCITY_WEIGHT, DRIFT_WEIGHT, NLL_WEIGHT, CONTACT_WEIGHT = 2.0, 0.5, 0.05, 0.1
"""Weights of the velocity's error, the path's error, the likelihood, and the contacts' cross-entropy."""

SMALL = 0.3  # velocity error up to which the loss is quadratic, and beyond which it is linear, m/s

_LIMBS = limbs(("elbow", "wrist"), ("shoulder", "elbow", "wrist"), ("knee", "ankle", "foot"))
_MIRRORED_CONTACTS = [1, 0, 3, 2, 5, 4, 7, 6]


@dataclass(frozen=True)
class _Motion:
    """True motion in B windows of T frames. Positions have one more frame at each end, for central differences."""

    positions: Tensor  # (B, T + 2, 22, 3) metres, world
    yaw: Tensor  # (B, T) radians, heading of the body
    contacts: Tensor  # (B, T, 8) labels


@dataclass(frozen=True)
class _Windows:
    features: Tensor  # (B, T, FEATURES) input
    turn: Tensor  # (B, T, 3, 3) rotations from a frame's heading to the world
    velocity: Tensor  # (B, T, 3) m/s, velocity of the root, world
    contacts: Tensor  # (B, T, 8) labels


def train_trajectory(options: TrainingOptions) -> Path:
    train, val = options.motion(flat=True)
    starts, chances = _chances(train)

    def loss_of(model: TrajectoryNet, count: int, _: float, rng: Rng) -> tuple[Tensor, dict[str, float]]:
        windows = _windows(_mirror_half(_sample(train, starts, chances, count, rng)), rng)
        return _loss(model(windows.features), windows)

    recipe = Recipe(
        "trajectory", lambda: TrajectoryNet(TrajectoryConfig()), loss_of,
        lambda model: evaluate_trajectory(model, val), ITERATIONS, BATCH, LEARNING_RATE,
    )  # fmt: skip
    described = f"root velocity and contacts, a recurrent network of {TrajectoryConfig().hidden} units, 22 joints"
    data = describe_data(options.weights, train, val)
    return recipe.train(options, described, data, calibrated=lambda model: calibrate(model, val))


_SPAN = int(np.ceil((WINDOW + 1) * RATES[1])) + 2


def _chances(motion: MotionSet) -> tuple[np.ndarray, np.ndarray]:
    """Return possible starts of windows, and their probabilities, which grow with the root's speed."""
    rows = motion.all_windows(_SPAN, step=2)
    coarse = motion.positions[rows[:, ::4], 0, :2]
    weights = MIN_SPEED + coarse.diff(dim=1).norm(dim=-1).sum(dim=1).numpy() / (_SPAN * FRAME_S)
    return rows[:, 0], weights / weights.sum()


def _sample(motion: MotionSet, starts: np.ndarray, chances: np.ndarray, count: int, rng: Rng) -> _Motion:
    rows = rng.choice(starts, size=count, p=chances)[:, None] + np.arange(_SPAN)
    times = np.exp(rng.uniform(np.log(RATES[0]), np.log(RATES[1]), (count, 1))) * np.arange(WINDOW + 2)
    frames = torch.from_numpy(np.take_along_axis(rows, times.astype(np.int64), axis=1))
    positions = torch.lerp(
        motion.positions[frames], motion.positions[frames + 1], _tensor(times % 1.0)[..., None, None]
    )
    positions = positions * _tensor(rng.uniform(*SCALES, (count, 1, 1, 1)))
    return _Motion(positions, heading(motion.rotations[frames[:, 1:-1], 0]), motion.contacts[frames[:, 1:-1]].float())


def _tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(values).float()


def _mirror_half(motion: _Motion) -> _Motion:
    """Exchange left and right, across the world's xz plane, in the first half of the windows."""
    half = len(motion.positions) // 2
    mirrored = motion.positions[:half][:, :, MIRROR.tolist()] * torch.tensor([1.0, -1.0, 1.0])
    return _Motion(
        torch.cat([mirrored, motion.positions[half:]]),
        torch.cat([-motion.yaw[:half], motion.yaw[half:]]),
        torch.cat([motion.contacts[:half][..., _MIRRORED_CONTACTS], motion.contacts[half:]]),
    )


def _windows(motion: _Motion, rng: Rng, noise_sd: float | None = None) -> _Windows:
    """Simulate the prior's output: noisy, tilted, with an approximate heading; ``noise_sd`` as in `_corrupt`."""
    positions, count = motion.positions, len(motion.positions)
    velocity = (positions[:, 2:, 0] - positions[:, :-2, 0]) / (2 * FRAME_S)
    wrong = rng.normal(0.0, YAW_SD, (count, 1))
    wrong = wrong + np.cumsum(rng.normal(0.0, YAW_STEP_SD, tuple(motion.yaw.shape)), axis=1)
    tilt = roma.rotvec_to_rotmat(_tensor(rng.normal(0.0, TILT_SD, (count, 3)) * [1.0, 1.0, 0.0]))
    joints = _corrupt((positions - positions[:, :, :1])[:, 1:-1], rng, noise_sd)
    turn = yaw_rotation(motion.yaw + _tensor(wrong))
    return _Windows(_features(joints @ tilt[:, None], turn), turn, velocity, motion.contacts)


def _corrupt(joints: Tensor, rng: Rng, noise_sd: float | None = None) -> Tensor:
    """Add time-correlated noise (AR(1)) to joints (B, T, 22, 3), including the root, and hold a limb in some windows.

    ``noise_sd`` is the noise of every window, metres; random up to `NOISE_SD` if omitted.
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


def _errors(predicted: RootMotion, windows: _Windows) -> tuple[Tensor, Tensor]:
    """(B, T, 3) m/s, velocity errors after `WARM_UP`, in each frame's heading and in the world."""
    off = predicted.velocity - (windows.velocity[:, :, None] @ windows.turn)[:, :, 0]
    turned = (off[:, :, None] @ windows.turn.mT)[:, :, 0]
    return off[:, WARM_UP:], turned[:, WARM_UP:]


def _loss(predicted: RootMotion, windows: _Windows) -> tuple[Tensor, dict[str, float]]:
    """Equation 9 with linear cost of large errors, the likelihood of the error, and contacts; each term is a mean."""
    off, in_world = _errors(predicted, windows)
    log_sigma = predicted.log_sigma[:, WARM_UP:].clamp(-5.0, 2.0)
    l_velocity = F.smooth_l1_loss(off, torch.zeros_like(off), beta=SMALL)
    l_trajectory = (in_world.cumsum(dim=1) * FRAME_S).square().mean()
    l_nll = (0.5 * (off.detach().square() * torch.exp(-2.0 * log_sigma)) + log_sigma).mean()
    l_contact = F.binary_cross_entropy_with_logits(predicted.contact_logits, windows.contacts)
    loss = VELOCITY_WEIGHT * l_velocity + DRIFT_WEIGHT * l_trajectory + NLL_WEIGHT * l_nll + CONTACT_WEIGHT * l_contact
    return loss, {
        "L_velocity": l_velocity.item(), "L_trajectory": l_trajectory.item(), "L_contact": l_contact.item(),
    }  # fmt: skip


@torch.no_grad()
def _validate(model: TrajectoryNet, motion: MotionSet, count: int) -> tuple[RootMotion, _Windows]:
    """Predict about ``count`` windows of unseen people with 1 cm of noise."""
    rows = motion.all_windows(WINDOW + 2, step=WINDOW)
    rows = rows[:: max(len(rows) // count, 1)]
    inner = rows[:, 1:-1]
    true = _Motion(motion.positions[rows], heading(motion.rotations[inner, 0]), motion.contacts[inner].float())
    windows = _windows(true, np.random.default_rng(0), noise_sd=0.01)
    return model(windows.features), windows


def evaluate_trajectory(model: TrajectoryNet, motion: MotionSet) -> dict[str, float]:
    """Evaluate the errors on unseen people. Returns ``val velocity m/s``, the RMS velocity error along an axis; ``val 1
    s drift cm``, that of the horizontal trajectory after one second."""
    off, in_world = _errors(*_validate(model, motion, count=512))
    drift = in_world[:, :30, :2].sum(dim=1).norm(dim=-1) * FRAME_S * 100
    return {
        "val velocity m/s": float(off.square().mean().sqrt()),
        "val 1 s drift cm": float(drift.square().mean().sqrt()),
    }


def calibrate(model: TrajectoryNet, motion: MotionSet) -> TrajectoryConfig:
    """Return the network's configuration with the size and correlation time of its errors on validation.

    The position variance after one second is sigma² · correlation_s for errors of size sigma and this correlation time.
    """
    predicted, windows = _validate(model, motion, count=2048)
    error = _errors(predicted, windows)[0] * torch.exp(-predicted.log_sigma[:, WARM_UP:])
    size = error.square().mean(dim=(0, 1))
    strayed = (error[:, :30].sum(dim=1) * FRAME_S).square().mean(dim=0)
    axes = [slice(0, 2), slice(2, 3)]
    return replace(
        model.config,
        sigma_scale=tuple(float(size[a].mean().sqrt()) for a in axes),
        correlation_s=tuple(float(strayed[a].mean() / size[a].mean()) for a in axes),
    )
