"""The energy's terms: their derivatives, and what each is least for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from steadypose.prior.body.kinematics import REST_HEIGHT
from steadypose.prior.body.skeleton import REST_OFFSETS, REST_POSITIONS, J
from steadypose.prior.fit.energy import (
    Anchored,
    Bones,
    FirstState,
    Ground,
    Smooth,
    Standing,
    Term,
    Transitions,
    bisquare,
    energy,
    geman_mcclure,
    huber,
)
from steadypose.prior.fit.humor_network import HumorConfig, HumorNet
from steadypose.prior.fit.motion import Motion, Variables
from steadypose.prior.fit.observations import KeyPoints, Pinhole, SeenJoints, SurfacePoints, thinned

FRAMES = 6
NAMES = ("root", "orientation", "turns", "bones", "ground", "latents")


def of(values: object) -> Tensor:
    return torch.tensor(np.asarray(values), dtype=torch.float64)


@pytest.fixture(scope="module")
def model() -> HumorNet:
    torch.manual_seed(0)
    return HumorNet(HumorConfig(hidden=64, latent=6, components=2)).double().eval().requires_grad_(False)


@pytest.fixture
def variables() -> Variables:
    """Somebody who sways above a floor that lies 10 cm low, all of it a little off from where it starts."""
    generator = torch.Generator().manual_seed(0)
    root = of([[0.1 * t, 0.0, 0.95] for t in range(FRAMES)])
    start = Variables.initial(root, torch.eye(3).double().expand(FRAMES, 22, 3, 3), of(REST_OFFSETS), -0.1, 6)

    def off(like: Tensor, by: float) -> Tensor:
        return like + by * torch.randn(like.shape, generator=generator, dtype=torch.float64)

    sizes = {"root": 0.02, "orientation": 0.2, "turns": 0.2, "bones": 0.01, "ground": 0.03, "latents": 0.5}
    return replace(start, **{name: off(getattr(start, name), size) for name, size in sizes.items()})


def camera() -> Pinhole:
    optical = of([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    return Pinhole(of([900.0, 900.0]), of([320.0, 240.0]), optical, of([0.0, -4.0, 1.0]))


def terms() -> dict[str, Term]:
    rng = np.random.default_rng(0)
    seen = of(REST_POSITIONS + [0.0, 0.0, 0.9] + 0.05 * rng.standard_normal((FRAMES, 22, 3)))
    seen[2, 5] = torch.nan
    pixels = camera().project(seen + 0.05)
    sure = of(rng.uniform(0.0, 1.0, (FRAMES, 22)))
    points = of(rng.uniform(-0.5, 0.5, (FRAMES, 9, 3)) + [0.2, 0.0, 0.9])
    points[1, 3] = torch.nan
    return {
        "seen joints": SeenJoints(seen, torch.full((FRAMES, 22), 0.04, dtype=torch.float64)),
        "key points": KeyPoints(pixels, sure, camera(), 5.0),
        "surface": SurfacePoints(points, camera().position, 0.05),
        "transitions": Transitions(),
        "first state": FirstState(),
        "all states": FirstState(all_states=True),
        "smooth": Smooth(),
        "bones": Bones(),
        "ground": Ground(-0.1, 0.02, 0.05),
        "anchored": Anchored(seen[:2].nan_to_num(0.5)),
    }


@pytest.mark.parametrize("name", terms())
def test_derivatives_are_those_of_finite_differences(name: str, model: HumorNet, variables: Variables) -> None:
    term = terms()[name]

    def value(at: Variables) -> Tensor:
        return energy(Motion(model, at), [term])

    leaves = {n: getattr(variables, n).clone().requires_grad_() for n in NAMES}
    value(replace(variables, **leaves)).backward()
    generator = torch.Generator().manual_seed(1)
    found = 0
    for n, leaf in leaves.items():
        if (name, n) == ("surface", "bones"):  # how stout a body is follows its bones, but is not what moves them
            continue
        way = torch.randn(leaf.shape, generator=generator, dtype=torch.float64)
        ends = [float(value(replace(variables, **{n: leaf.detach() + step * way}))) for step in (-1e-8, 1e-8)]
        expected = (ends[1] - ends[0]) / 2e-8
        given = 0.0 if leaf.grad is None else float((leaf.grad * way).sum())
        assert given == pytest.approx(expected, rel=1e-3, abs=1e-3 * max(1.0, abs(ends[0]) * 1e-3))
        found += given != 0.0
    assert found, "it says something of a motion"


def test_what_stands_is_weighed_by_contacts_that_it_does_not_move(model: HumorNet, variables: Variables) -> None:
    latents = variables.latents.clone().requires_grad_()
    value = energy(Motion(model, replace(variables, latents=latents)), [Standing()])
    assert value > 0
    assert not value.requires_grad or torch.autograd.grad(value, latents, allow_unused=True)[0] is None


def test_a_foot_under_the_floor_costs_and_one_on_it_does_not(model: HumorNet) -> None:
    rest = REST_POSITIONS[J["left_foot"], 2]

    def depth(height: float) -> float:
        root = of([[0.0, 0.0, height - rest + REST_HEIGHT[4]]] * FRAMES)
        start = Variables.initial(root, torch.eye(3).double().expand(FRAMES, 22, 3, 3), of(REST_OFFSETS), 0.0, 6)
        plain = HumorNet(HumorConfig(hidden=64, latent=6, contacts=False)).double().requires_grad_(False)
        return float(energy(Motion(plain, start), [Standing(height_sigma=0.02)]))

    assert depth(0.05) == 0.0
    assert depth(-0.02) > 2 * FRAMES * 0.5 * 0.99


@pytest.mark.parametrize("kernel", [geman_mcclure, bisquare])
def test_kernels_are_quadratic_near_nothing_and_bounded_far_away(kernel) -> None:
    small, far = of([1e-6, 1e-4]), of([1e4, 1e6])
    torch.testing.assert_close(kernel(small, 5.0), small, rtol=1e-3, atol=0)
    assert (kernel(far, 5.0) <= 25.0).all()
    grid = torch.linspace(0, 200, 400, dtype=torch.float64)
    assert (kernel(grid, 5.0).diff() >= 0).all()


def test_hubers_kernel_goes_on_growing() -> None:
    grid = torch.linspace(0, 20, 200, dtype=torch.float64)
    value = huber(grid.square(), 3.0)
    torch.testing.assert_close(value[grid < 3], grid[grid < 3].square())
    torch.testing.assert_close(value[grid > 3].diff() / grid.diff()[0], torch.full_like(value[grid > 3][1:], 6.0))


def test_points_on_the_side_that_is_seen_cost_nothing(model: HumorNet) -> None:
    root = of([[0.0, 0.0, 1.0]] * FRAMES)
    start = Variables.initial(root, torch.eye(3).double().expand(FRAMES, 22, 3, 3), of(REST_OFFSETS), 0.0, 6)
    motion = Motion(model, start)
    knee, ankle = motion.world_joints[:, J["left_knee"]], motion.world_joints[:, J["left_ankle"]]
    skin = (0.5 * (knee + ankle) + of([0.05, 0.0, 0.0])).unsqueeze(1)
    ahead = skin[0, 0] + of([3.0, 0.0, 0.0])
    moving = ahead.expand(FRAMES, 3)
    for camera in (ahead, moving):
        assert SurfacePoints(skin, camera, 0.01).misfit(motion).max() < 2e-3
    for off in ([0.1, 0.0, 0.0], [-0.02, 0.0, 0.0], [-0.1, 0.0, 0.0]):
        # behind the bone too, where the far side of a closed capsule would be near
        found = SurfacePoints(skin + of(off), ahead, 0.01)
        assert found.misfit(motion)[0, 0] == pytest.approx(abs(off[0]), abs=5e-3)
        assert found.residual(motion)[0, 0].sign() == -np.sign(off[0])
    part = SurfacePoints(skin, moving, 0.01).between(1, 3)
    assert len(part.points) == len(part.camera) == 2


@pytest.mark.parametrize(("given", "kept"), [(0, 0), (150, 150), (399, 399), (400, 200), (5000, 200)])
def test_a_cloud_is_thinned_evenly(given: int, kept: int) -> None:
    points = np.arange(2 * given * 3, dtype=float).reshape(2, given, 3)
    found = thinned(points)
    assert found.shape == (2, kept, 3)
    steps = np.diff(found[0, :, 0])
    assert (steps == steps[:1]).all()


def test_the_floor_is_moved_and_tilted_with_all_that_stands_on_it(model: HumorNet, variables: Variables) -> None:
    level = replace(variables, ground=of([0.0, 0.0, 0.0]))
    raised = replace(variables, ground=of([0.3, 0.0, 0.0]))
    lifted = Motion(model, raised).world_joints - Motion(model, level).world_joints
    torch.testing.assert_close(lifted, of([0.0, 0.0, 0.3]).expand_as(lifted))
    tilted = Motion(model, replace(variables, ground=of([0.0, 0.1, 0.0])))
    torch.testing.assert_close(tilted.world_joints @ tilted.tilt, Motion(model, level).joints)
