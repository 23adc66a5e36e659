"""The transition model: a conditional VAE of the next state given this one (HuMoR, section 3, equations 1 to 4).

The module also has its rollouts: motions from an initial state and latents, futures, and the latents of a motion.

Encoder and prior are Gaussians of a step's latent; the decoder maps a state and a latent to the next state. There are
four differences from the paper: joints and velocities follow from root, rotations and bones (`humor_state`), features
are standardised, networks are half as wide, and contacts have two labels, load and rest.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from steadypose.prior.body.kinematics import CONTACT_JOINTS
from steadypose.prior.fit.humor_state import (
    CHANGE,
    FEATURES,
    JOINT_COUNT,
    State,
    canonical,
    features,
    moved_by,
    placed,
    posed,
    stack,
)
from steadypose.prior.fit.tensors import from_6d

GROUPS = 16  # number of groups of the group normalisation

STEP_SCALE = 0.02
"""Unit of the decoder's output, metres and radians: about the standard deviation of the change in one frame."""

LOG_VARIANCES = (-10.0, 6.0)
"""Range of log-variances. The official code has no bounds, and silently drops steps with NaN."""

POSE = 3 + 6 * JOINT_COUNT
"""Number of outputs of a decoder that predicts the next pose instead of the change: root, two columns per rotation."""


@dataclass(frozen=True)
class HumorConfig:
    """Sizes, and switches of the ablations."""

    latent: int = 48  # dimensions of a transition's latent
    hidden: int = 512  # width of the hidden layers
    learned_prior: bool = True  # whether the prior depends on the state; if not, it is N(0, I), as in a Motion VAE
    residual: bool = True  # whether the decoder outputs the change of the state; if not, it outputs the next pose
    contacts: bool = True  # whether it predicts contacts
    components: int = 12  # number of components of the mixture of initial states

    @classmethod
    def from_dict(cls, config: dict[str, Any]) -> HumorConfig:
        """Build the configuration from the JSON of a weights file."""
        return cls(**config)


@dataclass(frozen=True)
class Gaussian:
    """A diagonal Gaussian of latents."""

    mean: Tensor  # (..., latent)
    log_variance: Tensor  # the same shape

    @property
    def sigma(self) -> Tensor:
        """(..., latent) standard deviations."""
        return (0.5 * self.log_variance).exp()

    def sample(self, generator: torch.Generator | None = None) -> Tensor:
        """Draw a sample of each."""
        return self.mean + self.sigma * torch.randn(self.mean.shape, generator=generator)

    def kl(self, other: Gaussian) -> Tensor:
        """(...) nats, KL(self || other)."""
        ratio = (self.log_variance - other.log_variance).exp()
        distance = (self.mean - other.mean).square() * (-other.log_variance).exp()
        return 0.5 * (ratio + distance - 1.0 - (self.log_variance - other.log_variance)).sum(dim=-1)


class HumorNet(nn.Module):
    """Prior, encoder and decoder, and the mixture of initial states (`initial`).

    Buffers:
        mean, scale: (`FEATURES`,) mean and scale that standardise features.
        mixture_log_weights (K,), mixture_means (K, 133), mixture_precisions (K, 133, 133): of standardised
            `pose_features`, the last the Cholesky factors of the inverse covariances.
    """

    mean: Tensor
    scale: Tensor
    mixture_log_weights: Tensor
    mixture_means: Tensor
    mixture_precisions: Tensor

    def __init__(self, config: HumorConfig) -> None:
        super().__init__()
        self.config = config
        latent, hidden = config.latent, config.hidden
        self.encoder = _perceptron([2 * FEATURES, hidden, hidden, 2 * latent])
        self.prior = _perceptron([FEATURES, hidden, hidden, 2 * latent]) if config.learned_prior else None
        outputs = (CHANGE if config.residual else POSE) + 2 * len(CONTACT_JOINTS) * config.contacts
        self.decoder = Decoder([FEATURES, hidden, hidden, hidden // 2, outputs], latent)
        known = 1 + FEATURES - 3 - 6 * JOINT_COUNT
        self.register_buffer("mean", torch.zeros(FEATURES))
        self.register_buffer("scale", torch.ones(FEATURES))
        self.register_buffer("mixture_log_weights", torch.zeros(config.components))
        self.register_buffer("mixture_means", torch.zeros(config.components, known))
        self.register_buffer("mixture_precisions", torch.eye(known).expand(config.components, -1, -1).clone())

    def standardise(self, inputs: Tensor) -> Tensor:
        """Standardise `features` (..., `FEATURES`) for the networks."""
        return (inputs - self.mean) / self.scale

    def prior_latent(self, inputs: Tensor) -> Gaussian:
        """p(z | x), from standardised features (..., `FEATURES`) of states in their canonical frames."""
        if self.prior is None:
            zero = inputs.new_zeros(*inputs.shape[:-1], self.config.latent)
            return Gaussian(zero, zero)
        return _gaussian(self.prior(inputs))

    def posterior_latent(self, inputs: Tensor, next_inputs: Tensor) -> Gaussian:
        """q(z | x, x'), from these features and those of the next states in the canonical frames of the first."""
        return _gaussian(self.encoder(torch.cat([inputs, next_inputs], dim=-1)))

    def decode(self, state: State, inputs: Tensor, latent: Tensor, offsets: Tensor) -> tuple[State, Tensor]:
        """Return the next states, in the canonical frames of these (...), and contact logits (..., 16): load, then
        rest.

        ``inputs`` (..., `FEATURES`) are the states' features, standardised; ``offsets`` (..., 22, 3) metres are bones.
        """
        output = self.decoder(inputs, latent)
        if self.config.residual:
            step, logits = output[..., :CHANGE] * STEP_SCALE, output[..., CHANGE:]
            return moved_by(state, step, offsets), logits
        pose, logits = output[..., :POSE], output[..., POSE:]
        mean, scale = self.mean[:POSE], self.scale[:POSE]
        pose = pose * scale + mean
        return posed(state, pose[..., :3], from_6d(pose[..., 3:].unflatten(-1, (JOINT_COUNT, 6))), offsets), logits

    def step(self, state: State, latent: Tensor, offsets: Tensor) -> tuple[State, Tensor]:
        """Return the next states of any states (...) with latents (..., latent), and contact logits (..., 16)."""
        own = canonical(state, state)
        following, logits = self.decode(own, self.standardise(features(own)), latent, offsets)
        return placed(following, state), logits


class Decoder(nn.Module):
    """A perceptron with the latent as an input of every layer, to prevent posterior collapse."""

    def __init__(self, widths: list[int], latent: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(nn.Linear(a + latent, b) for a, b in itertools.pairwise(widths))
        self.norms = nn.ModuleList(nn.GroupNorm(GROUPS, b) for b in widths[1:-1])

    def forward(self, inputs: Tensor, latent: Tensor) -> Tensor:
        x = inputs.reshape(-1, inputs.shape[-1])
        z = latent.reshape(-1, latent.shape[-1])
        for layer, norm in zip(self.layers, self.norms, strict=False):
            x = torch.relu(norm(layer(torch.cat([x, z], dim=-1))))
        x = self.layers[-1](torch.cat([x, z], dim=-1))
        return x.reshape(*inputs.shape[:-1], -1)


def _perceptron(widths: list[int]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for a, b in itertools.pairwise(widths[:-1]):
        layers += [nn.Linear(a, b), _Groups(b), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(widths[-2], widths[-1]))


class _Groups(nn.GroupNorm):
    """Group normalisation of the last dimension of (..., C)."""

    def __init__(self, channels: int) -> None:
        super().__init__(GROUPS, channels)

    def forward(self, input: Tensor) -> Tensor:
        return super().forward(input.reshape(-1, input.shape[-1])).reshape(input.shape)


def _gaussian(output: Tensor) -> Gaussian:
    mean, log_variance = output.chunk(2, dim=-1)
    return Gaussian(mean, log_variance.clamp(*LOG_VARIANCES))


@dataclass(frozen=True)
class Rollout:
    """T predicted steps."""

    states: State  # (..., T) states, without the initial one
    contacts: Tensor  # (..., T, 16) logits of load, then of rest; (..., T, 0) if the model has none


def roll_out(model: HumorNet, initial: State, latents: Tensor, offsets: Tensor) -> Rollout:
    """Compute x_T = f(x_0, z_1..T), section 3, from states (...), latents (..., T, latent) and bones (..., 22, 3)
    metres."""
    return _rolled(model, initial, offsets, list(latents.unbind(dim=-2)))


def sample(model: HumorNet, initial: State, steps: int, offsets: Tensor, generator: torch.Generator | None) -> Rollout:
    """Predict a future, with latents drawn from the prior at each state, or its means if ``generator`` is None."""
    return _rolled(model, initial, offsets, [generator] * steps)


def _rolled(
    model: HumorNet, state: State, offsets: Tensor, steps: list[Tensor] | list[torch.Generator | None]
) -> Rollout:
    states: list[State] = []
    contacts: list[Tensor] = []
    for step in steps:
        latent = step if isinstance(step, Tensor) else _drawn(model, state, step)
        state, logits = model.step(state, latent, offsets)
        states.append(state)
        contacts.append(logits)
    dim = state.root.dim() - 1
    return Rollout(stack(states, dim), torch.stack(contacts, dim))


def _drawn(model: HumorNet, state: State, generator: torch.Generator | None) -> Tensor:
    prior = model.prior_latent(model.standardise(features(canonical(state, state))))
    return prior.mean if generator is None else prior.sample(generator)


def transitions(model: HumorNet, states: State) -> tuple[Gaussian, Gaussian]:
    """Return posterior and prior of the latents (..., T - 1) of the steps between states (..., T)."""
    dim = states.root.dim() - 2
    index = (slice(None),) * dim
    before, after = states[(*index, slice(None, -1))], states[(*index, slice(1, None))]
    inputs = model.standardise(features(canonical(before, before)))
    next_inputs = model.standardise(features(canonical(after, before)))
    return model.posterior_latent(inputs, next_inputs), model.prior_latent(inputs)
