from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from torch import Tensor

from steadypose.prior.body.kinematics import CONTACT_HEIGHT, CONTACT_JOINTS, REST_HEIGHT
from steadypose.prior.body.skeleton import REST_OFFSETS, J
from steadypose.prior.fit import energy
from steadypose.prior.fit.energy import FirstState, Standing, Term, Transitions, bisquare, geman_mcclure, huber
from steadypose.prior.fit.humor_network import HumorConfig, HumorNet
from steadypose.prior.fit.humor_state import FEATURES
from steadypose.prior.fit.motion import Motion, Variables
from steadypose.prior.fit.observations import KeyPoints, Pinhole, SeenJoints, SurfacePoints, thinned

FRAMES, LATENT = 6, 4
STEPS = FRAMES - 2
JOINTS, CONTACTS = 22, len(CONTACT_JOINTS)


def nats(term: Term, **parts: Any) -> float:
    """The energy of one term, of a motion of which no more is given than the term may read."""
    return float(energy.energy(cast(Motion, SimpleNamespace(**parts)), [term]))


def zeros(*shape: int) -> Tensor:
    return torch.zeros(*shape, dtype=torch.float64)


def transitions_of(latents: Tensor, off: float = 0.0, turned: float = 0.0) -> dict[str, Any]:
    """Steps with these latents, whose next joints and rotations are off what the decoder predicted."""
    states = SimpleNamespace(joints=zeros(STEPS, JOINTS, 3) + off, rotations=zeros(STEPS, JOINTS, 3, 3) + turned)
    predicted = SimpleNamespace(joints=zeros(STEPS, JOINTS, 3), rotations=zeros(STEPS, JOINTS, 3, 3))

    class States:
        def __getitem__(self, rows: slice) -> SimpleNamespace:
            assert rows == slice(1, None)
            return states

    variables = SimpleNamespace(latents=latents)
    return {"variables": variables, "predicted": (predicted, None), "states": States()}


def test_a_latent_costs_what_the_prior_says_of_it() -> None:
    latents = torch.arange(STEPS * LATENT, dtype=torch.float64).reshape(STEPS, LATENT)
    assert nats(Transitions(), **transitions_of(latents)) == pytest.approx(0.5 * float(latents.square().sum()))
    assert nats(Transitions(latent_sigma=2.0), **transitions_of(latents)) == pytest.approx(
        0.5 * float(latents.square().sum()) / 4.0
    )


def test_a_step_costs_its_distance_from_the_decoders() -> None:
    still = zeros(STEPS, LATENT)
    assert nats(Transitions(), **transitions_of(still)) == 0.0
    off = nats(Transitions(joints_sigma=0.01), **transitions_of(still, off=0.03))
    assert off == pytest.approx(0.5 * 9.0 * STEPS * JOINTS * 3)
    turned = nats(Transitions(rotations_sigma=0.1), **transitions_of(still, turned=0.2))
    assert turned == pytest.approx(0.5 * 4.0 * STEPS * JOINTS * 9)


def first_states(values: tuple[float, ...]) -> dict[str, Any]:
    """States whose features are all one number each; components N(0, 1) and N(0, 10²) in every feature."""
    width = 1 + FEATURES - 3 - 6 * JOINTS
    identity = torch.eye(width, dtype=torch.float64)
    model = SimpleNamespace(
        mixture_log_weights=torch.full((2,), 0.5, dtype=torch.float64).log(),
        mixture_means=zeros(2, width),
        mixture_precisions=torch.stack([identity, 0.1 * identity]),
    )
    inputs = torch.stack([torch.full((FEATURES,), value, dtype=torch.float64) for value in values])
    return {"model": model, "inputs": inputs, "width": width}


@pytest.mark.parametrize(("value", "sigma"), [(0.0, 1.0), (0.5, 1.0), (50.0, 10.0)])
def test_a_first_state_costs_what_its_likeliest_component_says(value: float, sigma: float) -> None:
    motion = first_states((value, 3.0, 3.0))
    each = motion.pop("width") * 0.5
    assert nats(FirstState(), **motion) == pytest.approx(each * (value / sigma) ** 2)
    assert nats(FirstState(sigma=2.0), **motion) == pytest.approx(each * (value / sigma) ** 2 / 4.0)
    # 3.0 is likelier of the wide component: 0.5 · 9 nats against 0.5 · 0.09 + log 10
    every = each * ((value / sigma) ** 2 + 2 * 0.3**2)
    assert nats(FirstState(all_states=True), **motion) == pytest.approx(every)


def test_smooth_is_of_accelerations_in_metres_a_second_squared() -> None:
    t = torch.arange(FRAMES, dtype=torch.float64)[:, None, None] / 30.0
    joints = (0.5 * 8.0 * t**2 + 3.0 * t + 1.0) * torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    joints = joints.expand(FRAMES, JOINTS, 3)
    assert nats(energy.Smooth(sigma=4.0), joints=joints) == pytest.approx(0.5 * 4.0 * STEPS * JOINTS)


def test_bones_cost_their_change() -> None:
    variables = SimpleNamespace(bones=zeros(JOINTS, 3) + 0.02)
    assert nats(energy.Bones(sigma=0.01), variables=variables) == pytest.approx(0.5 * 4.0 * JOINTS * 3)


def test_the_ground_costs_height_and_both_tilts() -> None:
    def cost(*ground: float) -> float:
        return nats(energy.Ground(0.1, 0.02, 0.05), variables=SimpleNamespace(ground=torch.tensor(ground)))

    assert cost(0.1, 0.0, 0.0) == 0.0
    assert cost(0.16, 0.0, 0.0) == pytest.approx(0.5 * 9.0, rel=1e-5)
    assert cost(0.1, 0.1, 0.0) == pytest.approx(cost(0.1, 0.0, -0.1), rel=1e-5) == pytest.approx(0.5 * 4.0, rel=1e-5)


def standing(above: float = 0.0, speed: float = 0.0, rests: float = 1.0, loads: float = 0.5) -> dict[str, Any]:
    """All contact joints so many metres above their heights of rest and sliding at so many m/s; chances of contact."""
    joints = zeros(FRAMES, JOINTS, 3)
    joints[:, list(CONTACT_JOINTS), 2] = torch.tensor(REST_HEIGHT, dtype=torch.float64) + above
    joints[..., 0] = speed / 30.0 * torch.arange(FRAMES)[:, None]
    chances = torch.tensor([loads] * CONTACTS + [rests] * CONTACTS, dtype=torch.float64)
    return {"joints": joints, "predicted": (None, torch.logit(chances, eps=1e-12).expand(STEPS, -1))}


def test_a_joint_in_contact_does_not_slide() -> None:
    assert nats(Standing(), **standing()) == 0.0
    sliding = nats(Standing(speed_sigma=0.1), **standing(speed=0.3))
    assert sliding == pytest.approx(0.5 * 9.0 * STEPS * CONTACTS, rel=1e-6)
    # the chance that it rests weighs the energy, not the residual; that it bears load has no part in it
    for loads in (0.01, 0.99):
        unsure = nats(Standing(speed_sigma=0.1), **standing(speed=0.3, rests=0.25, loads=loads))
        assert unsure == pytest.approx(0.25 * sliding, rel=1e-6)


@pytest.mark.parametrize("rests", [1.0, 0.25])
def test_a_joint_in_contact_is_at_its_height(rests: float) -> None:
    height = np.asarray(CONTACT_HEIGHT)
    within = 0.9 * float(height.min())
    assert nats(Standing(), **standing(above=within, rests=rests)) == 0.0
    above = float(height.max()) + 0.04
    off = np.broadcast_to(above - height, (CONTACTS,)) / 0.02
    expected = rests * 0.5 * STEPS * float((off**2).sum())
    assert nats(Standing(height_sigma=0.02), **standing(above=above, rests=rests)) == pytest.approx(expected, rel=1e-6)


def test_a_foot_under_the_ground_costs_in_every_frame() -> None:
    motion = standing(above=-0.01)
    motion["predicted"] = (None, zeros(STEPS, 0))
    assert nats(Standing(height_sigma=0.02), **motion) == pytest.approx(0.5 * 0.25 * FRAMES * 4)


def test_a_window_is_anchored_where_the_one_before_ended() -> None:
    joints = zeros(FRAMES, JOINTS, 3)
    joints[2:] = 7.0
    assert nats(energy.Anchored(joints[:2] + 0.01, sigma=0.005), world_joints=joints) == pytest.approx(
        0.5 * 4.0 * 2 * JOINTS * 3
    )


@pytest.mark.parametrize(("kernel", "residual", "expected"), [
    (huber, 2.0, 4.0),
    (huber, 5.0, 2 * 3 * 5 - 9.0),
    (geman_mcclure, 3.0, 4.5),
    (geman_mcclure, 6.0, 36 / 5.0),
    (bisquare, 3.0, 3.0),
    (bisquare, 9.0, 3.0),
    (bisquare, 1.5, 3.0 * (1 - 0.75**3)),
])  # fmt: skip
def test_kernels_at_a_scale_of_three(kernel, residual: float, expected: float) -> None:
    assert float(kernel(torch.tensor(residual**2, dtype=torch.float64), 3.0)) == pytest.approx(expected)


def test_joints_that_are_seen_cost_their_distance_up_to_three_sigma_squared_and_linearly_beyond() -> None:
    joints = zeros(FRAMES, JOINTS, 3)
    positions = torch.full_like(joints, torch.nan)
    positions[0, 3] = torch.tensor([0.04, 0.0, 0.0])
    positions[1, 5] = torch.tensor([0.0, 0.0, 0.20])
    seen = SeenJoints(positions, torch.full((FRAMES, JOINTS), 0.02, dtype=torch.float64))
    assert nats(seen, world_joints=joints) == pytest.approx(0.5 * 4.0 + 0.5 * (2 * 3 * 10 - 9), rel=1e-5)
    assert float(seen.misfit(cast(Motion, SimpleNamespace(world_joints=joints)))[1, 5]) == pytest.approx(0.2)
    assert nats(seen.between(1, 2), world_joints=joints[1:2]) == pytest.approx(0.5 * (2 * 3 * 10 - 9), rel=1e-5)


def test_key_points_cost_pixels_by_confidence_under_geman_and_mcclure() -> None:
    optical = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]], dtype=torch.float64)
    focal, centre = (torch.tensor(v, dtype=torch.float64) for v in ((800.0, 600.0), (320.0, 240.0)))
    camera = Pinhole(focal, centre, optical, torch.tensor([0.0, -4.0, 1.0], dtype=torch.float64))
    at = camera.project(torch.tensor([1.0, 0.0, 2.0], dtype=torch.float64))
    torch.testing.assert_close(at, torch.tensor([320.0 + 200.0, 240.0 - 150.0], dtype=torch.float64))
    joints = zeros(1, JOINTS, 3) + torch.tensor([1.0, 0.0, 2.0])
    pixels, confidence = torch.full((1, JOINTS, 2), torch.nan, dtype=torch.float64), zeros(1, JOINTS)
    pixels[0, 3], confidence[0, 3] = at + torch.tensor([10.0, 0.0]), 0.6
    pixels[0, 4] = at + 100.0  # without confidence it is not seen
    expected = 0.5 * 0.6 * 4.0 / (1 + 4.0 / 25.0)
    told = KeyPoints(pixels, confidence, camera, 5.0)
    assert nats(told, world_joints=joints) == pytest.approx(expected)
    misfit = told.misfit(cast(Motion, SimpleNamespace(world_joints=joints)))
    assert misfit.shape == (1, JOINTS)
    assert float(misfit[0, 3]) == pytest.approx(10.0)
    assert int(misfit.isnan().sum()) == JOINTS - 1


def test_points_of_the_surface_are_bisquare_of_both_residuals_together() -> None:
    points = SurfacePoints(zeros(1, 1, 3), zeros(3), weight=0.03)
    square = torch.tensor([[4.0, 5.0], [400.0, 0.0]], dtype=torch.float64)
    expected = 0.03 * 25 / 3 * np.array([1 - (1 - 9 / 25) ** 3, 1.0])
    np.testing.assert_allclose(points.kernel(square).numpy(), expected)


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
    value = energy.energy(Motion(model, replace(variables, latents=latents)), [Standing()])
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
