"""A fit with HuMoR's own variables: the first state and the latents of all steps, from which the rest is rolled out.

`prior.fit` optimises all poses and ties them to the decoder by a term. Here the decoder is a hard constraint, as in the
paper (section 4.1). The search is that of the official code: one L-BFGS for all clips, first over 15 frames, then over
the latents of all frames, then over everything.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from steadypose.prior.fit.energy import Bones, FirstState, Quadratic, Smooth, Term, energy
from steadypose.prior.fit.humor_network import HumorNet, roll_out, transitions
from steadypose.prior.fit.humor_state import small_exp, states_of
from steadypose.prior.fit.motion import SCALES, Motion, Variables
from steadypose.prior.fit.observations import Observed
from steadypose.prior.fit.solve import FitSettings, Start, fit_window

PREFIX, ITERATIONS = 15, 20
"""Number of frames of the first phase, and of L-BFGS iterations of a step."""
PHASES = ((30, True), (25, False), (15, True))
"""Number of steps of each phase, and whether the first two poses are free in it."""


class RolledOut(Motion):
    """A motion whose poses have been rolled out.

    Args:
        model: the transition model.
        variables: bones and ground.
        root: (T, 3) metres.
        rotations: (T, 22, 3, 3) local.
        latents: (T - 2, latent).
        contacts: (T - 2, 16) logits.
    """

    def __init__(
        self, model: HumorNet, variables: Variables, root: Tensor, rotations: Tensor, latents: Tensor, contacts: Tensor
    ) -> None:
        super().__init__(model, variables)
        self.root, self.rotations, self.latents = root, rotations, latents
        self.predicted = self.states[1:], contacts


class Likely(Quadratic):
    """E_CVAE of a motion that has been rolled out."""

    def residual(self, motion: Motion) -> Tensor:
        assert isinstance(motion, RolledOut)
        prior = motion.model.prior_latent(motion.inputs[:-1])
        return (motion.latents - prior.mean) / prior.sigma


def fit_rolled_out(
    model: HumorNet, starts: Sequence[Start], observed: Sequence[Sequence[Observed]], settings: FitSettings,
    phases: Sequence[tuple[int, bool]] = PHASES,
) -> list[RolledOut]:  # fmt: skip
    """Fit C clips of equal length, whose ground is known, with the energy of stage 3.

    Args:
        model: the transition model.
        starts: (C,) initial poses, for stages 1 and 2.
        observed: (C,) terms of the observations of each clip.
        settings: settings of stages and terms.
        phases: as `PHASES`.
    """
    fitted = [fit_window(model, *one, settings, stages=2).motion for one in zip(starts, observed, strict=True)]
    with torch.no_grad():
        start = _Start(
            model,
            [motion.variables for motion in fitted],
            torch.stack([motion.root[:2] for motion in fitted]),
            torch.stack([motion.rotations[:2] for motion in fitted]),
            torch.stack([motion.offsets for motion in fitted]),
        )
        latents = torch.stack([transitions(model, motion.states)[0].mean for motion in fitted])
    values = {
        "root": torch.zeros_like(start.root), "turns": start.root.new_zeros(*start.rotations.shape[:3], 3),
        "bones": torch.zeros_like(start.offsets), "latents": latents,
    }  # fmt: skip
    for number, (steps, poses) in enumerate(phases):
        frames = latents.shape[1] + 2 if number else min(PREFIX, latents.shape[1] + 2)
        terms = [[*(seen.between(0, frames) for seen in one), *_terms(settings)] for one in observed]
        free = tuple(values) if poses else ("bones", "latents")
        values = _minimised(start, values, free, terms, frames, steps)
    with torch.no_grad():
        return start.motions(values, latents.shape[1] + 2)


def _terms(settings: FitSettings) -> list[Term]:
    return [
        Bones(settings.bones_sigma), Likely(), FirstState(settings.first_sigma, all_states=True), settings.standing,
        Smooth(settings.motion_smooth_sigma),
    ]  # fmt: skip


@dataclass(frozen=True)
class _Start:
    """C clips to start from.

    Attributes:
        model: the transition model.
        variables: (C,) of stage 2.
        root: (C, 2, 3) metres, of the first two frames.
        rotations: (C, 2, 22, 3, 3) local.
        offsets: (C, 22, 3) metres, bones.
    """

    model: HumorNet
    variables: Sequence[Variables]
    root: Tensor
    rotations: Tensor
    offsets: Tensor

    def motions(self, values: Mapping[str, Tensor], frames: int) -> list[RolledOut]:
        """Roll out the first frames of all clips."""
        root, rotations = self.root + values["root"], small_exp(values["turns"]) @ self.rotations
        offsets, latents = self.offsets + values["bones"], values["latents"][:, : frames - 2]
        rolled = roll_out(self.model, states_of(root, rotations, offsets)[:, 0], latents, offsets)
        root = torch.cat([root, rolled.states.root], dim=1)
        rotations = torch.cat([rotations, rolled.states.rotations], dim=1)
        return [
            RolledOut(self.model, replace(given, bones=given.bones + bones), *one)
            for given, bones, *one in zip(
                self.variables, values["bones"], root, rotations, latents, rolled.contacts, strict=True
            )
        ]


def _minimised(
    start: _Start, values: Mapping[str, Tensor], free: Sequence[str], terms: Sequence[Sequence[Term]], frames: int,
    steps: int,
) -> dict[str, Tensor]:  # fmt: skip
    """Minimise the sum of all clips' energies by L-BFGS."""
    moves = {name: torch.zeros_like(values[name], requires_grad=True) for name in free}
    optimiser = torch.optim.LBFGS(
        [*moves.values()], max_iter=ITERATIONS, history_size=30, tolerance_change=1e-7, line_search_fn="strong_wolfe"
    )

    def moved() -> dict[str, Tensor]:
        return {**values} | {name: values[name] + SCALES[name] * move for name, move in moves.items()}

    def closure() -> Tensor:
        optimiser.zero_grad()
        motions = start.motions(moved(), frames)
        value = torch.stack([energy(*one) for one in zip(motions, terms, strict=True)]).sum()
        value.backward()
        return value

    for _ in range(steps):
        optimiser.step(closure)
    return {name: value.detach() for name, value in moved().items()}
