"""A motion under optimisation: the variables, and what follows from them.

HuMoR varies the first state and the latents of all steps, and rolls the rest out of them: ninety passes one after the
other for an evaluation, in which an early latent moves everything after it. Here the poses of all frames are varied
beside the latents, and a term ties each pose to what the decoder makes of the one before and its latent, as firmly as
the decoder is right (`energy.Transitions`; weak-constraint 4D-Var, or multiple shooting with soft defects). All steps
are then evaluated at once, and a model that errs bends a motion less than it would as a law.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from steadypose.prior.fit.humor_network import HumorNet, transitions
from steadypose.prior.fit.humor_state import JOINT_COUNT, State, canonical, features, placed, small_exp, states_of

SCALES: Mapping[str, float] = {
    "root": 0.02, "orientation": 0.05, "turns": 0.05, "bones": 0.01, "ground": 0.02, "latents": 1.0,
}  # fmt: skip
"""Metres, radians and standard deviations that a step of 1 of the optimiser stands for."""

MAX_LATENT = 3.0
"""Standard deviations of the prior from its mean, beyond which no latent starts."""


def float_tensor(values: NDArray[np.floating]) -> Tensor:
    """The same values in single precision, as models take them; a copy where the array is not contiguous."""
    return torch.from_numpy(np.ascontiguousarray(values)).float()


@dataclass(frozen=True)
class Variables:
    """The variables of T frames: the initial poses, which are fixed, and the offset of each from there.

    Attributes:
        start_root: (T, 3) metres, in the frame of the ground: z up, the floor at 0.
        start_rotations: (T, 22, 3, 3) local.
        start_offsets: (22, 3) metres, bones.
        root: (T, 3) metres.
        orientation: (T, 3) rotation vectors of the root, applied from the left.
        turns: (T, 21, 3) the same of the other joints.
        bones: (22, 3) metres.
        ground: (3,) metres by which the floor lies above 0 of the world, and radians by which it is turned about x and
            y there.
        latents: (T - 2, latent) from the prior's mean, in its standard deviations.
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
    def initial(cls, root: Tensor, rotations: Tensor, offsets: Tensor, height: float, latent: int) -> Variables:
        """Poses (T, ...) in a world whose floor lies at ``height`` metres, with latents at the prior's mean."""
        down = root.new_tensor([0.0, 0.0, height])
        zero = torch.zeros_like(root)
        turns, latents = zero.unsqueeze(1).repeat(1, JOINT_COUNT - 1, 1), zero.new_zeros(len(root) - 2, latent)
        return cls(root - down, rotations, offsets, zero, zero, turns, torch.zeros_like(offsets), down.flip(0), latents)


class Motion:
    """What follows from variables, each computed once, for all terms of the energy.

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
        # a state takes two frames: the first frame is doubled, so that it has one, at rest
        root = torch.cat([self.root[:1], self.root])
        return states_of(root, torch.cat([self.rotations[:1], self.rotations]), self.offsets)

    @property
    def joints(self) -> Tensor:
        """(T, 22, 3) metres in the frame of the ground."""
        return self._all.joints

    @property
    def states(self) -> State:
        """(T - 1) states, from the second frame on: the first has no velocity."""
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
    def _canonical(self) -> State:
        return canonical(self.states, self.states)

    @cached_property
    def inputs(self) -> Tensor:
        """(T - 1, `FEATURES`) standardised features of the states in their canonical frames."""
        return self.model.standardise(features(self._canonical))

    @cached_property
    def predicted(self) -> tuple[State, Tensor]:
        """(T - 2) the decoder's next state of each state but the last, and logits of contacts (T - 2, 16)."""
        inputs = self.inputs[:-1]
        prior = self.model.prior_latent(inputs)
        latents = prior.mean + prior.sigma * self.variables.latents
        following, logits = self.model.decode(self._canonical[:-1], inputs, latents, self.offsets)
        return placed(following, self.states[:-1]), logits

    @torch.no_grad()
    def encoded_latents(self) -> Tensor:
        """(T - 2, latent) the encoder's means, from the prior's, in standard deviations of the prior."""
        posterior, prior = transitions(self.model, self.states)
        return ((posterior.mean - prior.mean) / prior.sigma).clamp(-MAX_LATENT, MAX_LATENT)
