"""A motion as the optimisation moves it: what it varies, and what follows from that.

HuMoR varies the first state and the latents of all steps, and rolls the rest out of them: ninety passes one after the
other for an evaluation, in which an early latent moves everything after it. Here the poses of all frames are varied
beside the latents, and a term ties each pose to what the decoder makes of the one before and its latent, as firmly as
the decoder is right (`energy.Transitions`; weak-constraint 4D-Var, or multiple shooting with soft defects). All steps
are then evaluated at once, and a model that errs bends a motion less than it would as a law.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from steadypose.prior.models.humor.network import HumorNet
from steadypose.prior.models.humor.rollout import transitions
from steadypose.prior.models.humor.state import JOINT_COUNT, State, canonical, features, placed, small_exp, states_of

SCALES: Mapping[str, float] = {
    "root": 0.02, "orientation": 0.05, "turns": 0.05, "bones": 0.01, "ground": 0.02, "latents": 1.0,
}  # fmt: skip
"""Metres and radians that count as 1 in the optimiser's steps."""

FURTHEST_LATENT = 3.0
"""deviations from what the prior expects, beyond which no latent starts"""


@dataclass(frozen=True)
class Variables:
    """What is varied, of T frames; the poses as they start, and how far each is from there.

    Attributes:
        start_root: (T, 3) metres, in the frame of the ground: z up, the floor at 0.
        start_rotations: (T, 22, 3, 3) local.
        start_offsets: (22, 3) metres, bones.
        root: (T, 3) metres.
        orientation: (T, 3) rotation vectors of the root, from the left.
        turns: (T, 21, 3) of the other joints.
        bones: (22, 3) metres.
        ground: (3,) metres by which the floor lies above 0 of the world, and radians by which it is turned about x and
            y there.
        latents: (T - 2, latent) deviations from what the prior expects.
    """

    start_root: Tensor
    start_rotations: Tensor
    start_offsets: Tensor
    root: Tensor
    orientation: Tensor
    turns: Tensor
    bones: Tensor
    ground: Tensor
    latents: Tensor

    @classmethod
    def starting(cls, root: Tensor, rotations: Tensor, offsets: Tensor, height: float, latent: int) -> Variables:
        """From poses (T, ...) in a world whose floor is believed to lie at ``height``, with unremarkable latents."""
        down = root.new_tensor([0.0, 0.0, height])
        zero = torch.zeros_like(root)
        turns, latents = zero.unsqueeze(1).repeat(1, JOINT_COUNT - 1, 1), zero.new_zeros(len(root) - 2, latent)
        return cls(root - down, rotations, offsets, zero, zero, turns, torch.zeros_like(offsets), down.flip(0), latents)

    def varied(self, **values: Tensor) -> Variables:
        """With other values of some."""
        return replace(self, **values)


class Motion:
    """What follows from variables, each computed once, for all terms that ask.

    Args:
        model: of transitions.
        variables: as above.
    """

    def __init__(self, model: HumorNet, variables: Variables) -> None:
        self.model, self.variables = model, variables

    @cached_property
    def root(self) -> Tensor:
        """(T, 3) metres above the ground."""
        return self.variables.start_root + self.variables.root

    @cached_property
    def rotations(self) -> Tensor:
        """(T, 22, 3, 3) local."""
        turns = torch.cat([self.variables.orientation.unsqueeze(1), self.variables.turns], dim=1)
        return small_exp(turns) @ self.variables.start_rotations

    @property
    def offsets(self) -> Tensor:
        """(22, 3) metres, this person's bones."""
        return self.variables.start_offsets + self.variables.bones

    @cached_property
    def _all(self) -> State:
        # before the first frame stands another like it, so that it has a state, if one at rest
        root = torch.cat([self.root[:1], self.root])
        return states_of(root, torch.cat([self.rotations[:1], self.rotations]), self.offsets)

    @property
    def joints(self) -> Tensor:
        """(T, 22, 3) metres in the frame of the ground."""
        return self._all.joints

    @property
    def states(self) -> State:
        """(T - 1) from the second frame on: the first has no velocity."""
        return self._all[1:]

    @cached_property
    def world_joints(self) -> Tensor:
        """(T, 22, 3) metres in the world that observations are in."""
        return self.joints @ self.tilt.mT + self.ground_height

    @property
    def tilt(self) -> Tensor:
        """The rotation (3, 3) from the frame of the ground to the world."""
        ground = self.variables.ground
        return small_exp(torch.cat([ground[1:], ground.new_zeros(1)]))

    @property
    def ground_height(self) -> Tensor:
        """(3,) metres: where the floor is under 0 of the world."""
        return self.variables.ground[:1] * self.variables.ground.new_tensor([0.0, 0.0, 1.0])

    @cached_property
    def _own(self) -> tuple[State, Tensor]:
        own = canonical(self.states, self.states)
        return own, self.model.standardised(features(own))

    @property
    def told(self) -> Tensor:
        """(T - 1, `FEATURES`) of the states in their own frames, standardised."""
        return self._own[1]

    @cached_property
    def predicted(self) -> tuple[State, Tensor]:
        """The states (T - 2) that the decoder makes of each but the last, and logits of contacts (T - 2, 16)."""
        own, told = self._own[0][:-1], self.told[:-1]
        prior = self.model.expected(told)
        latents = prior.mean + prior.sigma * self.variables.latents
        following, logits = self.model.decoded(own, told, latents, self.offsets)
        return placed(following, self.states[:-1]), logits

    @torch.no_grad()
    def inferred_latents(self) -> Tensor:
        """(T - 2, latent) what the encoder says of the steps, as deviations from what the prior expects."""
        posterior, prior = transitions(self.model, self.states)
        return ((posterior.mean - prior.mean) / prior.sigma).clamp(-FURTHEST_LATENT, FURTHEST_LATENT)
