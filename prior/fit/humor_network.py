"""The transition model: a conditional VAE of the next state given this one (HuMoR, section 3, equations 1 to 4).

Beside it its rollouts: motions from an initial state and latents, futures, and the latents of a motion.

Encoder and prior are Gaussians of a step's latent, the decoder takes a state and a latent to the next state. Unlike in
the paper, joints and velocities follow from root, rotations and bones (`humor_state`), features are standardised,
networks are half as wide, and contact has two labels, load and rest.
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

GROUPS = 16
"""of the group normalisation"""

STEP_SCALE = 0.02
"""Metres and radians, unit of the decoder's output: about the standard deviation of the change in one frame."""

LOG_VARIANCES = (-10.0, 6.0)
"""The official code bounds them not at all, and drops steps that are not numbers without a word."""

POSE = 3 + 6 * JOINT_COUNT
"""Outputs of a decoder of the next pose, not of its change: root, and two columns of each rotation."""


@dataclass(frozen=True)
class HumorConfig:
    """Sizes, and what the ablations leave out.

    Attributes:
        latent: numbers of a transition.
        hidden: width of the hidden layers.
        learned_prior: whether the prior reads the state; else it is N(0, I), as in a Motion VAE.
        residual: whether the decoder's output is the change of the state; else the next pose itself.
        contacts: whether it predicts contacts.
        components: of the mixture of initial states.
    """

    latent: int = 48
    hidden: int = 512
    learned_prior: bool = True
    residual: bool = True
    contacts: bool = True
    components: int = 12

    @classmethod
    def from_dict(cls, config: dict[str, Any]) -> HumorConfig:
        """From the JSON of a weights file."""
        return cls(**config)


@dataclass(frozen=True)
class Gaussian:
    """Diagonal, of latents.

    Attributes:
        mean: (..., latent).
        log_variance: the same shape.
    """

    mean: Tensor
    log_variance: Tensor

    @property
    def sigma(self) -> Tensor:
        """(..., latent) standard deviations."""
        return (0.5 * self.log_variance).exp()

    def sample(self, generator: torch.Generator | None = None) -> Tensor:
        """One draw of each."""
        return self.mean + self.sigma * torch.randn(self.mean.shape, generator=generator)

    def kl(self, other: Gaussian) -> Tensor:
        """(...) nats, KL(self || other)."""
        ratio = (self.log_variance - other.log_variance).exp()
        distance = (self.mean - other.mean).square() * (-other.log_variance).exp()
        return 0.5 * (ratio + distance - 1.0 - (self.log_variance - other.log_variance)).sum(dim=-1)


class HumorNet(nn.Module):
    """Prior, encoder and decoder, and the mixture of initial states beside them (`initial`).

    Buffers:
        mean, scale: (`FEATURES`,) what features are standardised by.
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
        """`features` (..., `FEATURES`) as the networks take them."""
        return (inputs - self.mean) / self.scale

    def prior_latent(self, inputs: Tensor) -> Gaussian:
        """p(z | x), of standardised features (..., `FEATURES`) of states in their canonical frames."""
        if self.prior is None:
            zero = inputs.new_zeros(*inputs.shape[:-1], self.config.latent)
            return Gaussian(zero, zero)
        return _gaussian(self.prior(inputs))

    def posterior_latent(self, inputs: Tensor, next_inputs: Tensor) -> Gaussian:
        """q(z | x, x'), of the same and of the next states, as seen from the canonical frames of the first."""
        return _gaussian(self.encoder(torch.cat([inputs, next_inputs], dim=-1)))

    def decode(self, state: State, inputs: Tensor, latent: Tensor, offsets: Tensor) -> tuple[State, Tensor]:
        """The next states, in the canonical frames of these, and logits of contacts (..., 16): load, then rest.

        Args:
            state: (...) canonical.
            inputs: (..., `FEATURES`) their features, standardised.
            latent: (..., latent).
            offsets: (..., 22, 3) metres, bones.
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
        """The next states of any states (...) with these latents (..., latent), and logits of contacts (..., 16)."""
        own = canonical(state, state)
        following, logits = self.decode(own, self.standardise(features(own)), latent, offsets)
        return placed(following, state), logits


class Decoder(nn.Module):
    """A perceptron that has the latent as an input of every layer, against posterior collapse."""

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
    """T steps on.

    Attributes:
        states: (..., T), without the initial one.
        latents: (..., T, latent).
        contacts: (..., T, 16) logits of load, then of rest; (..., T, 0) of a model without.
    """

    states: State
    latents: Tensor
    contacts: Tensor


def roll_out(model: HumorNet, initial: State, latents: Tensor, offsets: Tensor) -> Rollout:
    """x_T = f(x_0, z_1..T), section 3.

    Args:
        model: trained.
        initial: (...) states.
        latents: (..., T, latent).
        offsets: (..., 22, 3) metres, bones.
    """
    return _rolled(model, initial, offsets, list(latents.unbind(dim=-2)))


def sample(model: HumorNet, initial: State, steps: int, offsets: Tensor, generator: torch.Generator | None) -> Rollout:
    """A future: latents drawn from the prior at each state, or its means, the likeliest, if ``generator`` is None."""
    return _rolled(model, initial, offsets, [generator] * steps)


def _rolled(
    model: HumorNet, state: State, offsets: Tensor, steps: list[Tensor] | list[torch.Generator | None]
) -> Rollout:
    states: list[State] = []
    latents: list[Tensor] = []
    contacts: list[Tensor] = []
    for step in steps:
        latent = step if isinstance(step, Tensor) else _drawn(model, state, step)
        state, logits = model.step(state, latent, offsets)
        states.append(state)
        latents.append(latent)
        contacts.append(logits)
    dim = state.root.dim() - 1
    return Rollout(stack(states, dim), torch.stack(latents, dim), torch.stack(contacts, dim))


def _drawn(model: HumorNet, state: State, generator: torch.Generator | None) -> Tensor:
    prior = model.prior_latent(model.standardise(features(canonical(state, state))))
    return prior.mean if generator is None else prior.sample(generator)


def transitions(model: HumorNet, states: State) -> tuple[Gaussian, Gaussian]:
    """Posterior and prior of the latents (..., T - 1) of the steps between states (..., T)."""
    dim = states.root.dim() - 2
    index = (slice(None),) * dim
    before, after = states[(*index, slice(None, -1))], states[(*index, slice(1, None))]
    inputs = model.standardise(features(canonical(before, before)))
    next_inputs = model.standardise(features(canonical(after, before)))
    return model.posterior_latent(inputs, next_inputs), model.prior_latent(inputs)
