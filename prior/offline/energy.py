"""The energy of a motion, as a sum of terms: each has residuals in deviations, and most a robust kernel.

A term says ``residual(motion)``, a tensor of any shape, in units of its sigma; its energy is half the sum of their
squares, each through the kernel. That is HuMoR's energy (section 4.2, appendix C) with its weights as the deviations
that they stand for, and the form that a Gauss-Newton solver takes too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from steadypose.prior.body.kinematics import CONTACT_HEIGHT, CONTACT_JOINTS, REST_HEIGHT
from steadypose.prior.models.humor.state import pose_features
from steadypose.prior.offline.motion import Motion
from steadypose.prior.timing.rate import FPS

Kernel = Callable[[Tensor], Tensor]
"""Of squared residuals."""

_CONTACTS = list(CONTACT_JOINTS)
_FEET = slice(2, 6)
"""of `CONTACT_JOINTS`, heels and toes"""


class Term(Protocol):
    """A part of the energy."""

    def residual(self, motion: Motion) -> Tensor:
        """Deviations, of any shape; NaN nowhere."""
        ...

    def kernel(self, square: Tensor) -> Tensor:
        """What a squared residual costs."""
        ...


class Quadratic:
    """A term whose residuals are normal."""

    def kernel(self, square: Tensor) -> Tensor:
        return square


def energy(motion: Motion, terms: Sequence[Term]) -> Tensor:
    """The sum of all terms, a scalar in nats but for a constant."""
    return torch.stack([0.5 * term.kernel(term.residual(motion).square()).sum() for term in terms]).sum()


def huber(square: Tensor, scale: float) -> Tensor:
    """Quadratic up to ``scale`` deviations, then linear: an error costs less, but none is given up (Huber 1964)."""
    return torch.where(square <= scale**2, square, 2.0 * scale * square.clamp(min=scale**2).sqrt() - scale**2)


def geman_mcclure(square: Tensor, scale: float) -> Tensor:
    """Quadratic near 0; beyond ``scale`` deviations an error hardly costs more (Geman and McClure 1987)."""
    return square / (1.0 + square / scale**2)


def bisquare(square: Tensor, scale: float) -> Tensor:
    """Quadratic near 0, constant from ``scale`` deviations on (Beaton and Tukey 1974)."""
    inside = 1.0 - (square / scale**2).clamp(max=1.0)
    return scale**2 / 3.0 * (1.0 - inside**3)


@dataclass(frozen=True)
class Transitions(Quadratic):
    """E_CVAE, and what a step is off from what the decoder makes of its latent.

    Attributes:
        joints_sigma: metres, the decoder's own error of a step.
        turns_sigma: of entries of rotation matrices.
        latent_sigma: deviations: 1 takes the prior at its word.
    """

    joints_sigma: float = 0.008
    turns_sigma: float = 0.04
    latent_sigma: float = 1.0

    def residual(self, motion: Motion) -> Tensor:
        said, _ = motion.predicted
        is_ = motion.states[1:]
        parts = [
            motion.variables.latents / self.latent_sigma,
            (said.joints - is_.joints).flatten(1) / self.joints_sigma,
            (said.rotations - is_.rotations).flatten(1) / self.turns_sigma,
        ]
        return torch.cat(parts, dim=1)


@dataclass(frozen=True)
class FirstState(Quadratic):
    """E_init, by the likeliest component of the mixture (a max-mixture, Olson and Agarwal 2013).

    Attributes:
        sigma: deviations: 1 takes the mixture at its word.
        always: whether all states are asked, not the first alone: a prior of poses, where there is none of motion.
    """

    sigma: float = 1.0
    always: bool = False

    def residual(self, motion: Motion) -> Tensor:
        told = motion.told if self.always else motion.told[:1]
        model = motion.model
        off = (pose_features(told) - model.mixture_means.unsqueeze(1)) @ model.mixture_precisions  # (K, N, 133)
        height = model.mixture_log_weights + model.mixture_precisions.diagonal(dim1=-2, dim2=-1).log().sum(dim=-1)
        best = (height.unsqueeze(1) - 0.5 * off.detach().square().sum(dim=-1)).argmax(dim=0)
        return off[best, torch.arange(len(best))] / self.sigma


@dataclass(frozen=True)
class Smooth(Quadratic):
    """E_smooth, of accelerations: what joints do when nothing is known of how bodies move.

    Attributes:
        sigma: m/s² along an axis.
    """

    sigma: float = 4.0

    def residual(self, motion: Motion) -> Tensor:
        return motion.joints.diff(n=2, dim=0) * FPS**2 / self.sigma


@dataclass(frozen=True)
class Bones(Quadratic):
    """E_shape: bones are about those that they started as, and alike on both sides.

    Attributes:
        sigma: metres along an axis.
    """

    sigma: float = 0.01

    def residual(self, motion: Motion) -> Tensor:
        return motion.variables.bones / self.sigma


@dataclass(frozen=True)
class Ground(Quadratic):
    """E_gnd: the ground is about where it was believed to be.

    Attributes:
        height: metres, of the world.
        height_sigma: metres.
        tilt_sigma: radians.
    """

    height: float
    height_sigma: float
    tilt_sigma: float

    def residual(self, motion: Motion) -> Tensor:
        ground = motion.variables.ground
        return torch.cat([(ground[:1] - self.height) / self.height_sigma, ground[1:] / self.tilt_sigma])


@dataclass(frozen=True)
class Standing(Quadratic):
    """E_env: what rests does not move, and is as high as it is when it rests; no foot goes into the ground.

    The decoder's contacts weigh this and are not moved by it: else the cheapest way were to have none.

    Attributes:
        speed_sigma: m/s of what rests.
        height_sigma: metres beyond `CONTACT_HEIGHT`, and below the ground.
    """

    speed_sigma: float = 0.1
    height_sigma: float = 0.02

    def residual(self, motion: Motion) -> Tensor:
        joints = motion.joints[:, _CONTACTS]
        depth = torch.relu(joints.new_tensor(REST_HEIGHT)[_FEET] - joints[:, _FEET, 2]) / self.height_sigma
        logits = motion.predicted[1].detach()
        if not logits.shape[-1]:
            return depth.flatten()
        resting = torch.sigmoid(logits[:, len(_CONTACTS) :]).sqrt()
        moved = joints.diff(dim=0)[1:] * FPS / self.speed_sigma * resting.unsqueeze(-1)
        off = (joints[2:, :, 2] - joints.new_tensor(REST_HEIGHT)).abs() - joints.new_tensor(CONTACT_HEIGHT)
        return torch.cat([depth.flatten(), moved.flatten(), (torch.relu(off) / self.height_sigma * resting).flatten()])


@dataclass(frozen=True)
class Anchored(Quadratic):
    """The first frames are about where the window before left them.

    Attributes:
        joints: (F, 22, 3) metres, world.
        sigma: metres along an axis.
    """

    joints: Tensor
    sigma: float = 0.005

    def residual(self, motion: Motion) -> Tensor:
        return (motion.world_joints[: len(self.joints)] - self.joints) / self.sigma
