"""The energy of a motion: a sum of terms with normalised residuals, most of them under a robust kernel.

A term has residuals of any shape in units of their standard deviation; its energy is half the sum of their squares,
each through the kernel. That is HuMoR's energy (section 4.2, appendix C), its weights written as the standard
deviations that they stand for, and the form that a Gauss-Newton solver takes too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from steadypose.prior.body.kinematics import CONTACT_HEIGHT, CONTACT_JOINTS, REST_HEIGHT
from steadypose.prior.fit.humor_state import pose_features
from steadypose.prior.fit.motion import Motion
from steadypose.prior.timing.rate import FPS

_CONTACTS = list(CONTACT_JOINTS)
_FEET = slice(2, 6)
"""of `CONTACT_JOINTS`, heels and toes"""


class Term(Protocol):
    """A part of the energy."""

    def residual(self, motion: Motion) -> Tensor:
        """In standard deviations, of any shape; NaN nowhere."""
        ...

    def kernel(self, square: Tensor) -> Tensor:
        """The cost of squared residuals, of their shape."""
        ...


class Quadratic:
    """A term without a robust kernel: its residuals are taken to be normal."""

    def kernel(self, square: Tensor) -> Tensor:
        return square


def energy(motion: Motion, terms: Sequence[Term]) -> Tensor:
    """The sum of all terms, a scalar in nats but for a constant."""
    return torch.stack([0.5 * term.kernel(term.residual(motion).square()).sum() for term in terms]).sum()


def huber(square: Tensor, scale: float) -> Tensor:
    """Quadratic up to ``scale`` standard deviations, linear beyond: no residual loses its pull (Huber 1964)."""
    return torch.where(square <= scale**2, square, 2.0 * scale * square.clamp(min=scale**2).sqrt() - scale**2)


def geman_mcclure(square: Tensor, scale: float) -> Tensor:
    """Quadratic near 0; beyond ``scale`` standard deviations it levels off (Geman and McClure 1987)."""
    return square / (1.0 + square / scale**2)


def bisquare(square: Tensor, scale: float) -> Tensor:
    """Quadratic near 0, constant from ``scale`` standard deviations on (Beaton and Tukey 1974)."""
    inside = 1.0 - (square / scale**2).clamp(max=1.0)
    return scale**2 / 3.0 * (1.0 - inside**3)


@dataclass(frozen=True)
class Transitions(Quadratic):
    """E_CVAE, and the defect of each step: how far its next state is from the decoder's.

    Attributes:
        joints_sigma: metres, the decoder's own error of a step.
        rotations_sigma: the same of the entries of rotation matrices.
        latent_sigma: standard deviations of the prior; 1 is the prior itself, more a wider one.
    """

    joints_sigma: float = 0.008
    rotations_sigma: float = 0.04
    latent_sigma: float = 1.0

    def residual(self, motion: Motion) -> Tensor:
        predicted, _ = motion.predicted
        actual = motion.states[1:]
        parts = [
            motion.variables.latents / self.latent_sigma,
            (predicted.joints - actual.joints).flatten(1) / self.joints_sigma,
            (predicted.rotations - actual.rotations).flatten(1) / self.rotations_sigma,
        ]
        return torch.cat(parts, dim=1)


@dataclass(frozen=True)
class FirstState(Quadratic):
    """E_init, by the likeliest component of the mixture (a max-mixture, Olson and Agarwal 2013).

    Attributes:
        sigma: standard deviations of the mixture; 1 is the mixture itself, more a wider one.
        all_states: whether it holds for all states, not the first alone: a prior of poses, where there is none of
            motion.
    """

    sigma: float = 1.0
    all_states: bool = False

    def residual(self, motion: Motion) -> Tensor:
        inputs = motion.inputs if self.all_states else motion.inputs[:1]
        model = motion.model
        residuals = (pose_features(inputs) - model.mixture_means.unsqueeze(1)) @ model.mixture_precisions  # (K, N, 133)
        log_peak = model.mixture_log_weights + model.mixture_precisions.diagonal(dim1=-2, dim2=-1).log().sum(dim=-1)
        best = (log_peak.unsqueeze(1) - 0.5 * residuals.detach().square().sum(dim=-1)).argmax(dim=0)
        return residuals[best, torch.arange(len(best))] / self.sigma


@dataclass(frozen=True)
class Smooth(Quadratic):
    """E_smooth, of the joints' accelerations: a prior of motion that knows no bodies.

    Attributes:
        sigma: m/s² along an axis.
    """

    sigma: float = 4.0

    def residual(self, motion: Motion) -> Tensor:
        return motion.joints.diff(n=2, dim=0) * FPS**2 / self.sigma


@dataclass(frozen=True)
class Bones(Quadratic):
    """E_shape: bones stay about as they were initially.

    Attributes:
        sigma: metres along an axis.
    """

    sigma: float = 0.01

    def residual(self, motion: Motion) -> Tensor:
        return motion.variables.bones / self.sigma


@dataclass(frozen=True)
class Ground(Quadratic):
    """E_gnd: a normal prior of the ground, level and at a height.

    Attributes:
        height: metres, world, its mean.
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
    """E_env: joints in contact do not move and are at their height of contact; no foot is below the ground.

    The decoder's contact probabilities weigh this, detached: else it were cheapest to have no contacts.

    Attributes:
        speed_sigma: m/s along an axis, of a joint in contact.
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
    """The first F frames are about where the window before left them.

    Attributes:
        joints: (F, 22, 3) metres, world.
        sigma: metres along an axis.
    """

    joints: Tensor
    sigma: float = 0.005

    def residual(self, motion: Motion) -> Tensor:
        return (motion.world_joints[: len(self.joints)] - self.joints) / self.sigma
