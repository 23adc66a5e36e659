"""The three stages of test-time optimisation (HuMoR, section 4.3), by L-BFGS."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache

import torch
from torch import Tensor

from steadypose.prior.models.humor.network import HumorNet
from steadypose.prior.offline.energy import (
    Anchored,
    Bones,
    FirstState,
    Ground,
    Smooth,
    Standing,
    Term,
    Transitions,
    energy,
)
from steadypose.prior.offline.motion import SCALES, Motion, Variables

POSES = ("root", "orientation", "turns")

ROUND = 10
"""Steps of L-BFGS between two looks at whether it still gains."""

STIFFNESS = 30.0
"""How much more firmly motion holds than observations do: the square of about 4 cm over 7 mm."""

STILL = 1e-4
"""Of the energy: a round that gains less is the last."""


@dataclass(frozen=True)
class FitSettings:
    """How long each stage may take, and how far each term is believed; chosen on validation people.

    Attributes:
        root_steps, pose_steps, motion_steps: of L-BFGS, of up to five evaluations each.
        smooth_sigma: m/s², of stage 2.
        pose_sigma: deviations of the mixture as a prior of poses, in stage 2.
        transitions: of stage 3.
        first_sigma: deviations of the mixture as a prior of all states, in stage 3.
        motion_smooth_sigma: m/s², of stage 3: what model and latents leave of a shake.
        standing: of stage 3.
        bones_sigma: metres.
        ground_height_sigma: metres, where the ground is not known.
        ground_tilt_sigma: radians, as well.
    """

    root_steps: int = 30
    pose_steps: int = 60
    motion_steps: int = 100
    smooth_sigma: float = 4.0
    pose_sigma: float = 4.0
    transitions: Transitions = field(default_factory=Transitions)
    first_sigma: float = 6.0
    motion_smooth_sigma: float = 8.0
    standing: Standing = field(default_factory=Standing)
    bones_sigma: float = 0.01
    ground_height_sigma: float = 0.05
    ground_tilt_sigma: float = 0.03


@dataclass(frozen=True)
class Start:
    """Poses to start from, (T, ...), in the world.

    Attributes:
        root: (T, 3) metres.
        rotations: (T, 22, 3, 3) local.
        offsets: (22, 3) metres, bones.
        ground: metres, where the floor is believed to lie.
        ground_known: whether that is so: a calibrated camera, say.
    """

    root: Tensor
    rotations: Tensor
    offsets: Tensor
    ground: float = 0.0
    ground_known: bool = False


@dataclass(frozen=True)
class Fitted:
    """What came of a window.

    Attributes:
        motion: the last, without gradients.
        energies: nats at the end of each stage, of that stage's terms.
    """

    motion: Motion
    energies: tuple[float, ...]


def fit_window(
    model: HumorNet,
    start: Start,
    observed: Sequence[Term],
    settings: FitSettings,
    *,
    anchor: Anchored | None = None,
    stages: int = 3,
    advanced: Callable[[], None] = lambda: None,
) -> Fitted:
    """Fit a window of some seconds, three frames at least.

    Args:
        model: of transitions, in evaluation.
        start: as above.
        observed: terms of what was seen.
        settings: as above.
        anchor: where the window before ends.
        stages: 2 stops at poses and smoothness: what HuMoR calls VPoser-t, without a model of motion.
        advanced: called after each stage.
    """
    model.requires_grad_(False)
    variables = Variables.starting(start.root, start.rotations, start.offsets, start.ground, model.config.latent)
    known = start.ground_known
    shape: list[Term] = [Bones(settings.bones_sigma)]
    if not known:
        shape.append(Ground(start.ground, settings.ground_height_sigma, settings.ground_tilt_sigma))
    given = [*observed, *([anchor] if anchor else [])]
    free = ("bones",) if known else ("bones", "ground")
    poses: list[Term] = [
        *given, *shape, Smooth(settings.smooth_sigma), FirstState(settings.pose_sigma, always=True),
    ]  # fmt: skip
    motions: list[Term] = [
        *given, *shape, settings.transitions, FirstState(settings.first_sigma, always=True), settings.standing,
        Smooth(settings.motion_smooth_sigma),
    ]  # fmt: skip
    plan = [
        (("root", "orientation"), [*given, Smooth(settings.smooth_sigma)], settings.root_steps),
        ((*POSES, *free), poses, settings.pose_steps),
        ((*POSES, *free, "latents"), motions, settings.motion_steps),
    ]
    found: list[float] = []
    for number, (names, terms, steps) in enumerate(plan[:stages]):
        if number == 2:
            variables = variables.varied(latents=Motion(model, variables).inferred_latents())
        variables, value = minimise(model, variables, names, terms, steps)
        found.append(value)
        advanced()
    with torch.no_grad():
        return Fitted(Motion(model, variables), tuple(found))


def minimise(
    model: HumorNet, variables: Variables, names: Sequence[str], terms: Sequence[Term], steps: int
) -> tuple[Variables, float]:
    """The variables of least energy near these, of which those of these names are moved; and that energy."""
    whole = [getattr(variables, name) for name in names]
    mixing = smoothing_root(len(variables.root)).to(variables.root.dtype)
    moves = [torch.zeros_like(value, requires_grad=True) for value in whole]
    optimiser = torch.optim.LBFGS(
        moves, max_iter=ROUND, max_eval=5 * ROUND, history_size=30, tolerance_change=1e-7, line_search_fn="strong_wolfe"
    )

    def moved() -> Variables:
        found = {}
        for name, value, move in zip(names, whole, moves, strict=True):
            if name in POSES:
                move = torch.einsum("ts,s...->t...", mixing, move)
            found[name] = value + SCALES[name] * move
        return variables.varied(**found)

    def closure() -> Tensor:
        optimiser.zero_grad()
        value = energy(Motion(model, moved()), terms)
        value.backward()
        return value

    before = torch.inf
    for _ in range(0, steps, ROUND):
        now = float(optimiser.step(closure).detach())  # the energy before these steps
        if before - now < STILL * abs(now):
            break
        before = now
    with torch.no_grad():
        last = moved()
        return last, float(energy(Motion(model, last), terms))


@cache
def smoothing_root(frames: int) -> Tensor:
    """(T, T) what the poses' moves are made of: the inverse root of 1 + `STIFFNESS` times squared second differences.

    Observations hold each frame by itself, motion holds three by their acceleration, and far more firmly, so that the
    energy is a long narrow valley. Seen through this matrix it is about as wide as long, and takes a fraction of the
    steps.
    """
    second = torch.eye(frames, dtype=torch.float64).diff(n=2, dim=0)
    values, vectors = torch.linalg.eigh(torch.eye(frames) + STIFFNESS * (second.mT @ second))
    return vectors @ torch.diag(values.rsqrt()) @ vectors.mT
