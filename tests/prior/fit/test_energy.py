"""The energy's terms: their derivatives, and what each is least for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from steadypose.prior.body.skeleton import REST_OFFSETS, J
from steadypose.prior.fit.energy import Standing, energy
from steadypose.prior.fit.humor_network import HumorConfig, HumorNet
from steadypose.prior.fit.motion import Motion, Variables
from steadypose.prior.fit.observations import SurfacePoints, thinned

FRAMES = 6


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


def test_what_stands_is_weighed_by_contacts_that_it_does_not_move(model: HumorNet, variables: Variables) -> None:
    latents = variables.latents.clone().requires_grad_()
    value = energy(Motion(model, replace(variables, latents=latents)), [Standing()])
    assert value > 0
    assert not value.requires_grad or torch.autograd.grad(value, latents, allow_unused=True)[0] is None


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
