"""The energy of a motion: a sum of terms with normalised residuals, most of them with a robust kernel.

A term has residuals of any shape in units of their standard deviations. Its energy is half the sum of the kernel of
their squares. This is HuMoR's energy (section 4.2, appendix C) with weights written as standard deviations. A
Gauss-Newton solver can use the same form.
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
"""Heels and toes among `CONTACT_JOINTS`."""


class Term(Protocol):
    """A term of the energy."""

    def residual(self, motion: Motion) -> Tensor:
        """Residuals in standard deviations, of any shape, without NaN."""
        ...

    def kernel(self, square: Tensor) -> Tensor:
        """Cost of squared residuals, of the same shape."""
        ...


class Quadratic:
    """A term without a robust kernel, for normally distributed residuals."""

    def kernel(self, square: Tensor) -> Tensor:
        return square


def energy(motion: Motion, terms: Sequence[Term]) -> Tensor:
    """Return the sum of all terms: a scalar in nats, up to a constant."""
    return torch.stack([0.5 * term.kernel(term.residual(motion).square()).sum() for term in terms]).sum()


def huber(square: Tensor, scale: float) -> Tensor:
    """Quadratic up to ``scale`` standard deviations, linear beyond, so that no residual is ignored (Huber 1964)."""
    return torch.where(square <= scale**2, square, 2.0 * scale * square.clamp(min=scale**2).sqrt() - scale**2)


def geman_mcclure(square: Tensor, scale: float) -> Tensor:
    """Quadratic near 0, levelling off beyond ``scale`` standard deviations (Geman and McClure 1987)."""
    return square / (1.0 + square / scale**2)


def bisquare(square: Tensor, scale: float) -> Tensor:
    """Quadratic near 0, constant from ``scale`` standard deviations on (Beaton and Tukey 1974)."""
    inside = 1.0 - (square / scale**2).clamp(max=1.0)
    return scale**2 / 3.0 * (1.0 - inside**3)


@dataclass(frozen=True)
class Transitions(Quadratic):
    """E_CVAE, and the defect of each step: the difference of its next state from the decoder's."""

    joints_sigma: float = 0.008  # metres, the decoder's error of joints in a step
    rotations_sigma: float = 0.04  # the decoder's error of entries of rotation matrices
    latent_sigma: float = 1.0  # scale of the prior's standard deviation: 1 is the prior, more is wider

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
    """E_init, by the most likely component of the mixture (max-mixture, Olson and Agarwal 2013)."""

    sigma: float = 1.0  # scale of the mixture's standard deviations: 1 is the mixture, more is wider
    all_states: bool = False
    """whether it applies to all states and not only the first: a pose prior for stages without a motion prior"""

    def residual(self, motion: Motion) -> Tensor:
        inputs = motion.inputs if self.all_states else motion.inputs[:1]
        model = motion.model
        residuals = (pose_features(inputs) - model.mixture_means.unsqueeze(1)) @ model.mixture_precisions  # (K, N, 133)
        log_peak = model.mixture_log_weights + model.mixture_precisions.diagonal(dim1=-2, dim2=-1).log().sum(dim=-1)
        best = (log_peak.unsqueeze(1) - 0.5 * residuals.detach().square().sum(dim=-1)).argmax(dim=0)
        return residuals[best, torch.arange(len(best))] / self.sigma


@dataclass(frozen=True)
class Smooth(Quadratic):
    """E_smooth, of the joints' accelerations: a motion prior without a body model."""

    sigma: float | Tensor = 4.0
    """m/s² along an axis; one for all, or one for each joint of each frame but the first and last, (T - 2, 22)"""

    def residual(self, motion: Motion) -> Tensor:
        sigma = self.sigma.unsqueeze(-1) if isinstance(self.sigma, Tensor) else self.sigma
        return motion.joints.diff(n=2, dim=0) * FPS**2 / sigma


@dataclass(frozen=True)
class Bones(Quadratic):
    """E_shape: bones stay near their initial values."""

    sigma: float = 0.01  # metres along an axis

    def residual(self, motion: Motion) -> Tensor:
        return motion.variables.bones / self.sigma


@dataclass(frozen=True)
class Ground(Quadratic):
    """E_gnd: a normal prior of the ground's height and tilt."""

    height: float  # metres, world, mean height
    height_sigma: float  # metres, standard deviation of the height
    tilt_sigma: float  # radians, standard deviation of the tilt

    def residual(self, motion: Motion) -> Tensor:
        ground = motion.variables.ground
        return torch.cat([(ground[:1] - self.height) / self.height_sigma, ground[1:] / self.tilt_sigma])


@dataclass(frozen=True)
class Standing(Quadratic):
    """E_env: joints in contact do not move and are at their contact height; no foot is below the ground.

    The term is weighted by the decoder's contact probabilities, detached. With a gradient, the least energy would be
    that without contacts.
    """

    speed_sigma: float = 0.1  # m/s along an axis, standard deviation of the velocity of a joint in contact
    height_sigma: float = 0.02  # metres, standard deviation of heights beyond `CONTACT_HEIGHT` and below the ground

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
    """The first F frames stay near the result of the window before."""

    joints: Tensor  # (F, 22, 3) metres, world
    sigma: float = 0.005  # metres along an axis

    def residual(self, motion: Motion) -> Tensor:
        return (motion.world_joints[: len(self.joints)] - self.joints) / self.sigma
