"""Motions from an initial state and latents (the rollout), futures, and the latents of a motion."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from steadypose.prior.fit.humor_network import Gaussian, HumorNet
from steadypose.prior.fit.humor_state import State, canonical, features, stack


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
