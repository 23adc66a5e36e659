"""The three stages of test-time optimisation (HuMoR, section 4.3), by L-BFGS. The last is kept only if it fits.

HuMoR's stage 3 is accurate for motion like its training data, and too stiff for other motion: for dancers, its error
exceeds that of the input. The residuals of the observations show this, so stage 3 is kept only if it explains them
nearly as well as stage 2 (the discrepancy principle, Morozov 1966).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from steadypose.prior.arrays import Floats
from steadypose.prior.body.bone_lengths import estimate_offsets
from steadypose.prior.body.inverse_kinematics import solve_rotations
from steadypose.prior.fit.energy import Anchored, Bones, FirstState, Ground, Smooth, Standing, Term, Transitions, energy
from steadypose.prior.fit.humor_network import HumorNet
from steadypose.prior.fit.motion import SCALES, Motion, Variables, float_tensor
from steadypose.prior.fit.tensors import forward_kinematics
from steadypose.prior.timing.rate import FPS

POSES = ("root", "orientation", "turns")

ROUND = 10  # number of L-BFGS steps between two convergence checks

STIFFNESS = 30.0
"""Ratio of the curvatures of the motion terms and of the observations: about the square of 4 cm over 7 mm."""

TOLERANCE = 1e-4  # relative decrease of the energy below which a round is the last
WINDOW = 7  # number of frames of which a joint's initial acceleration is the median

DISCREPANCY, NEGLIGIBLE = 1.08, 0.1
"""Stage 3 is kept if the energy of the observations is at most this many times that of stage 2, or at most this share
of the energy expected of their noise. Chosen on validation people (benchmarks/NOTEBOOK.md)."""


@dataclass(frozen=True)
class FitSettings:
    """Steps of each stage and standard deviation of each term, chosen on validation people."""

    # numbers of L-BFGS steps, with up to five evaluations each
    root_steps: int = 30
    pose_steps: int = 100
    motion_steps: int = 100
    # stages 1 and 2
    smooth_sigma: float = 4.0  # m/s², of `Smooth`
    acceleration_share: float = 2.0
    """ratio of the standard deviation of a joint's accelerations to its initial ones nearby, added to ``smooth_sigma``
    in squares; 0 if the initial poses shake"""
    pose_sigma: float = 12.0  # of `FirstState` as a prior of all states
    # stage 3
    transitions: Transitions = field(default_factory=Transitions)
    first_sigma: float = 6.0  # of `FirstState` as a prior of all states
    motion_smooth_sigma: float = 8.0  # m/s², of `Smooth`, against jitter that the motion model allows
    standing: Standing = field(default_factory=Standing)
    discrepancy: float = DISCREPANCY  # as there; infinite to keep this stage always
    # all stages
    bones_sigma: float = 0.01  # metres, of `Bones`
    ground_height_sigma: float = 0.05  # metres, of `Ground` if the ground is unknown
    ground_tilt_sigma: float = 0.03  # radians, likewise


PICTURES = FitSettings(bones_sigma=0.03, pose_steps=120, motion_steps=200, acceleration_share=0.0, pose_sigma=4.0)
"""Settings for key points of an image, which determine size less well and start farther from the solution."""


@dataclass(frozen=True)
class Start:
    """Initial poses of T frames, in the world."""

    root: Tensor  # (T, 3) metres
    rotations: Tensor  # (T, 22, 3, 3) local
    offsets: Tensor  # (22, 3) metres, bones
    ground: float = 0.0  # metres, height of the floor
    ground_known: bool = False
    """whether the height is certain, as for a calibrated camera; if not, it is the mean of a prior"""

    @classmethod
    def of(
        cls, root: Floats, rotations: Floats, offsets: Floats, ground: float = 0.0, *, ground_known: bool = False
    ) -> Start:
        """Build the start from arrays of the same shapes."""
        return cls(float_tensor(root), float_tensor(rotations), float_tensor(offsets), ground, ground_known)

    @classmethod
    def of_joints(
        cls, positions: Floats, ground: float = 0.0, *, rotations: Floats | None = None, ground_known: bool = False
    ) -> Start:
        """Build the start from joints (T, 22, 3) metres, and local rotations (T, 22, 3, 3), by default aimed bones."""
        offsets = estimate_offsets(positions)
        turned = solve_rotations(positions, offsets) if rotations is None else rotations
        return cls.of(positions[:, 0], turned, offsets, ground, ground_known=ground_known)


@dataclass(frozen=True)
class Fitted:
    """The fit of a window."""

    motion: Motion  # motion of least energy, without gradients, of the last stage or the one before
    energies: tuple[float, ...]  # (stages,) nats, energy of a stage's terms at its end
    kept: bool = True  # whether the last stage was kept


def fit_window(
    model: HumorNet,
    start: Start,
    observed: Sequence[Term],
    settings: FitSettings,
    *,
    anchor: Anchored | None = None,
    stages: int = 3,
) -> Fitted:
    """Fit a window of a few seconds, at least three frames, from initial poses to terms of observations, with a model
    in evaluation mode.

    ``anchor`` has the frames shared with the window before. With 2 ``stages`` it stops before the motion model, which
    is HuMoR's VPoser-t.
    """
    model.requires_grad_(False)
    variables = Variables.initial(start.root, start.rotations, start.offsets, start.ground, model.config.latent)
    given = [*observed, *([anchor] if anchor else [])]
    found: list[float] = []
    before, chosen = variables, _stages(start, given, settings)[:stages]
    for stage in chosen:
        if "latents" in stage.free:
            variables = replace(variables, latents=Motion(model, variables).encoded_latents())
        before = variables
        variables, value = minimise(model, variables, stage.free, stage.terms, stage.steps)
        found.append(value)
    with torch.no_grad():
        motion, earlier = Motion(model, variables), Motion(model, before)
        kept = "latents" not in chosen[-1].free or _explains(motion, earlier, observed, settings.discrepancy)
        return Fitted(motion if kept else earlier, tuple(found), kept)


def _explains(motion: Motion, before: Motion, observed: Sequence[Term], discrepancy: float) -> bool:
    """Whether ``motion`` explains the observations nearly as well as ``before`` it."""
    noise = sum(0.5 * term.residual(motion).numel() for term in observed)
    return float(energy(motion, observed)) <= max(discrepancy * float(energy(before, observed)), NEGLIGIBLE * noise)


class _Stage(NamedTuple):
    """Free variables, terms, and largest number of steps of a stage."""

    free: tuple[str, ...]
    terms: list[Term]
    steps: int


def _stages(start: Start, given: Sequence[Term], settings: FitSettings) -> list[_Stage]:
    """Return the stages: the root's pose; all poses with smoothness; all poses and latents with the motion model."""
    shape: list[Term] = [Bones(settings.bones_sigma)]
    body: tuple[str, ...] = (*POSES, "bones")
    if not start.ground_known:
        shape.append(Ground(start.ground, settings.ground_height_sigma, settings.ground_tilt_sigma))
        body = (*body, "ground")
    moving = settings.acceleration_share * _accelerations(start)
    smooth = Smooth(torch.hypot(torch.tensor(settings.smooth_sigma), moving))
    poses = [*given, *shape, smooth, FirstState(settings.pose_sigma, all_states=True)]
    motion = [
        *given, *shape, settings.transitions, FirstState(settings.first_sigma, all_states=True), settings.standing,
        Smooth(settings.motion_smooth_sigma),
    ]  # fmt: skip
    return [
        _Stage(("root", "orientation"), [*given, smooth], settings.root_steps),
        _Stage(body, poses, settings.pose_steps),
        _Stage((*body, "latents"), motion, settings.motion_steps),
    ]


def _accelerations(start: Start) -> Tensor:
    """(T - 2, 22) m/s² along an axis, median over `WINDOW` frames of the initial poses' accelerations.

    A jump at the beginning or end of a joint's observations is no motion; the median ignores it.
    """
    joints = forward_kinematics(start.rotations, start.offsets, start.root)[0]
    size = (joints.diff(n=2, dim=0) * FPS**2).square().mean(dim=-1).sqrt()
    around = pad(size.mT.unsqueeze(0), (WINDOW // 2, WINDOW // 2), mode="replicate")[0]
    return around.unfold(-1, WINDOW, 1).median(dim=-1).values.mT


def minimise(
    model: HumorNet, variables: Variables, names: Sequence[str], terms: Sequence[Term], steps: int
) -> tuple[Variables, float]:
    """Minimise the energy of the terms by L-BFGS in at most ``steps``, over the variables of these names; the others
    are fixed.

    Returns the variables of least energy, and that energy, nats.
    """
    initial = [getattr(variables, name) for name in names]
    conditioned = preconditioner(len(variables.root)).to(variables.root.dtype)
    moves = [torch.zeros_like(value, requires_grad=True) for value in initial]
    optimiser = torch.optim.LBFGS(
        moves, max_iter=ROUND, max_eval=5 * ROUND, history_size=30, tolerance_change=1e-7, line_search_fn="strong_wolfe"
    )

    def moved() -> Variables:
        found = {}
        for name, value, move in zip(names, initial, moves, strict=True):
            if name in POSES:
                move = torch.einsum("ts,s...->t...", conditioned, move)
            found[name] = value + SCALES[name] * move
        return replace(variables, **found)

    def closure() -> Tensor:
        optimiser.zero_grad()
        value = energy(Motion(model, moved()), terms)
        value.backward()
        return value

    before = torch.inf
    for _ in range(0, steps, ROUND):
        now = float(optimiser.step(closure).detach())  # the energy before these steps
        if before - now < TOLERANCE * abs(now):
            break
        before = now
    with torch.no_grad():
        last = moved()
        return last, float(energy(Motion(model, last), terms))


@cache
def preconditioner(frames: int) -> Tensor:
    """(T, T) preconditioner of the poses: the inverse square root of 1 + `STIFFNESS` times squared second differences.

    Observations constrain each frame separately. Motion terms constrain accelerations over three frames, far more
    strongly, so the energy is ill-conditioned. With this matrix, L-BFGS needs a fraction of the steps.
    """
    second = torch.eye(frames, dtype=torch.float64).diff(n=2, dim=0)
    values, vectors = torch.linalg.eigh(torch.eye(frames) + STIFFNESS * (second.mT @ second))
    return vectors @ torch.diag(values.rsqrt()) @ vectors.mT
