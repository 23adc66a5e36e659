"""A motion under optimisation: its variables, and the quantities that follow from them.

HuMoR optimises the first state and the latents of all steps, and rolls out the rest. An evaluation takes ninety
sequential passes, and an early latent moves everything after it. Here, the poses of all frames are variables as well. A
term ties each pose to the decoder's prediction from the pose before and its latent, weighted by the decoder's accuracy
(`energy.Transitions`; weak-constraint 4D-Var, or multiple shooting with soft defects). All steps are then evaluated at
once, and errors of the model distort a motion less than a hard constraint would.
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
"""Sizes of an optimiser step of 1, metres, radians and standard deviations."""

MAX_LATENT = 3.0  # largest distance of an initial latent from the prior's mean, standard deviations of the prior


def float_tensor(values: NDArray[np.floating]) -> Tensor:
    """Convert values to single precision for models; a copy if the array is not contiguous."""
    return torch.from_numpy(np.ascontiguousarray(values)).float()


@dataclass(frozen=True)
class Variables:
    """The variables of T frames: the initial poses, which are fixed, and offsets from them."""

    start_root: Tensor  # (T, 3) metres, in the frame of the ground: z up, floor at 0
    start_rotations: Tensor  # (T, 22, 3, 3) local
    start_offsets: Tensor  # (22, 3) metres, bones
    root: Tensor  # (T, 3) metres, offsets of the root
    orientation: Tensor  # (T, 3) rotation vectors of the root, applied from the left
    turns: Tensor  # (T, 21, 3) rotation vectors of the other joints, applied from the left
    bones: Tensor  # (22, 3) metres, offsets of the bones
    ground: Tensor  # (3,) height of the floor above 0 of the world, metres, and its tilts about x and y, radians
    latents: Tensor  # (T - 2, latent) relative to the prior's mean, in its standard deviations

    @classmethod
    def initial(cls, root: Tensor, rotations: Tensor, offsets: Tensor, height: float, latent: int) -> Variables:
        """Start from poses (T, ...) in a world with the floor at ``height`` metres, and latents at the prior's mean."""
        down = root.new_tensor([0.0, 0.0, height])
        zero = torch.zeros_like(root)
        turns, latents = zero.unsqueeze(1).repeat(1, JOINT_COUNT - 1, 1), zero.new_zeros(len(root) - 2, latent)
        return cls(root - down, rotations, offsets, zero, zero, turns, torch.zeros_like(offsets), down.flip(0), latents)


class Motion:
    """Quantities that follow from variables, each computed once for all terms of the energy."""

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
        """(22, 3) metres, the person's bones."""
        return self.variables.start_offsets + self.variables.bones

    @cached_property
    def _all(self) -> State:
        # a state needs two frames, so the first frame is doubled and is at rest
        root = torch.cat([self.root[:1], self.root])
        return states_of(root, torch.cat([self.rotations[:1], self.rotations]), self.offsets)

    @property
    def joints(self) -> Tensor:
        """(T, 22, 3) metres in the frame of the ground."""
        return self._all.joints

    @property
    def states(self) -> State:
        """(T - 1) states, from the second frame on; the first has no velocity."""
        return self._all[1:]

    @cached_property
    def world_joints(self) -> Tensor:
        """(T, 22, 3) metres in the world of the observations."""
        return self.joints @ self.tilt.mT + self.ground_height

    @property
    def tilt(self) -> Tensor:
        """The rotation (3, 3) from the frame of the ground to the world."""
        ground = self.variables.ground
        return small_exp(torch.cat([ground[1:], ground.new_zeros(1)]))

    @property
    def ground_height(self) -> Tensor:
        """(3,) metres, the point of the floor at the world's origin."""
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
        """(T - 2) the decoder's next state for each state except the last, and contact logits (T - 2, 16)."""
        inputs = self.inputs[:-1]
        prior = self.model.prior_latent(inputs)
        latents = prior.mean + prior.sigma * self.variables.latents
        following, logits = self.model.decode(self._canonical[:-1], inputs, latents, self.offsets)
        return placed(following, self.states[:-1]), logits

    @torch.no_grad()
    def encoded_latents(self) -> Tensor:
        """(T - 2, latent) the encoder's means relative to the prior's, in standard deviations of the prior."""
        posterior, prior = transitions(self.model, self.states)
        return ((posterior.mean - prior.mean) / prior.sigma).clamp(-MAX_LATENT, MAX_LATENT)
