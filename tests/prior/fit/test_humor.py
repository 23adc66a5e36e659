from dataclasses import fields

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch.distributions import Normal, kl_divergence

from steadypose.benchmarks.motion import as_set, simulated_clips
from steadypose.prior.body.bone_lengths import estimate_offsets
from steadypose.prior.body.inverse_kinematics import solve_rotations
from steadypose.prior.body.kinematics import CONTACT_JOINTS, forward_kinematics, heading, yaw_matrix
from steadypose.prior.body.skeleton import REST_OFFSETS
from steadypose.prior.fit import humor_state
from steadypose.prior.fit.hmvae_network import Posterior
from steadypose.prior.fit.humor_network import Gaussian, HumorConfig, HumorNet, roll_out, sample, transitions
from steadypose.prior.fit.humor_state import CHANGE, State, canonical, facing, moved_by, placed, small_exp, states_of
from steadypose.prior.fit.tensors import load_network
from steadypose.prior.timing.rate import FPS
from steadypose.training.recipes.humor import Sequences, transition_loss

TOLD_MM, NATS = 68.0, 27.0
"""Of the weights that ship, on simulated people."""

SEEDS = st.integers(0, 2**32 - 1)


def some_states(seed: int, count: int = 3) -> State:
    """Of people who stand anyhow, but on no side."""
    rng = np.random.default_rng(seed)
    turns = Rotation.from_rotvec(0.4 * rng.standard_normal((count * 2 * 22, 3))).as_matrix().reshape(count, 2, 22, 3, 3)
    turns[:, :, 0] = yaw_matrix(rng.uniform(-np.pi, np.pi, count))[:, None] @ turns[:, :, 0]
    root = rng.standard_normal((count, 2, 3))
    return states_of(*(torch.from_numpy(x) for x in (root, turns, np.tile(REST_OFFSETS, (count, 1, 1)))))[:, 0]


def bones(count: int) -> torch.Tensor:
    return torch.from_numpy(np.tile(REST_OFFSETS, (count, 1, 1)))


def assert_same(a: State, b: State, tolerance: float = 1e-9) -> None:
    for field in fields(State):
        torch.testing.assert_close(getattr(a, field.name), getattr(b, field.name), atol=tolerance, rtol=0)


@pytest.fixture(scope="module")
def model() -> HumorNet:
    torch.manual_seed(0)
    return HumorNet(HumorConfig(hidden=64, latent=8)).double().eval()


@pytest.fixture(scope="module")
def shipped() -> HumorNet:
    return load_network(HumorNet, HumorConfig.from_dict, "default", "humor")


@given(SEEDS)
@settings(max_examples=20, deadline=None)
def test_to_a_frame_and_back_is_nothing(seed: int) -> None:
    state, origin = some_states(seed), some_states(seed + 1)
    assert_same(placed(canonical(state, origin), origin), state)
    own = canonical(state, state)
    torch.testing.assert_close(own.root[:, :2], torch.zeros(3, 2).double())
    torch.testing.assert_close(torch.from_numpy(heading(own.rotations[:, 0].numpy())), torch.zeros(3).double())


def test_facing_is_the_heading_and_has_a_derivative_where_the_body_faces_along_the_axis() -> None:
    state = some_states(0)
    expected = yaw_matrix(heading(state.rotations[:, 0].numpy()))
    np.testing.assert_allclose(facing(state.rotations[:, 0]).numpy(), expected, atol=1e-7)
    vector = torch.zeros(1, 3, dtype=torch.float64, requires_grad=True)
    facing(small_exp(vector)).square().sum().backward()
    assert vector.grad is not None
    assert torch.isfinite(vector.grad).all()


@given(SEEDS)
@settings(max_examples=20, deadline=None)
def test_rotation_vectors_are_scipys(seed: int) -> None:
    vector = np.random.default_rng(seed).uniform(-1.0, 1.0, (8, 3))  # well under half a turn
    matrix = small_exp(torch.from_numpy(vector))
    np.testing.assert_allclose(matrix.numpy(), Rotation.from_rotvec(vector).as_matrix(), atol=1e-6)
    expected = Rotation.from_matrix(matrix.numpy()).as_rotvec()
    np.testing.assert_allclose(humor_state.small_log(matrix).numpy(), expected, atol=1e-5)


def test_a_step_is_that_of_plain_kinematics() -> None:
    state = some_states(3)
    change = 0.05 * torch.randn(3, CHANGE, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    after = moved_by(state, change, bones(3))
    root = torch.stack((state.root, after.root), dim=1)
    rotations = torch.stack((state.rotations, after.rotations), dim=1)
    assert_same(states_of(root, rotations, bones(3))[:, 0], after)
    for body in range(3):
        turns = Rotation.from_rotvec(change[body, 3:].numpy().reshape(22, 3)).as_matrix()
        rotations = turns @ state.rotations[body].numpy()
        root = state.root[body].numpy() + change[body, :3].numpy()
        joints = forward_kinematics(rotations, REST_OFFSETS, root)[0]
        np.testing.assert_allclose(after.joints[body].numpy(), joints, atol=1e-7)
        np.testing.assert_allclose(after.velocity[body].numpy(), (joints - state.joints[body].numpy()) * FPS, atol=1e-5)
        turning = Rotation.from_matrix(turns[0]).as_rotvec() * FPS
        np.testing.assert_allclose(after.turning[body].numpy(), turning, atol=1e-4)


def test_a_rollout_is_step_after_step_of_each_alone(model: HumorNet) -> None:
    first = some_states(5)
    latents = torch.randn(3, 6, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    found = roll_out(model, first, latents, bones(3))
    for body in range(3):
        # a reference that turns everything by hand: to the origin and +x, one step, and back
        root, rotations = first.root[body].numpy(), first.rotations[body].numpy()
        velocity, turning = first.velocity[body].numpy(), first.turning[body].numpy()
        joints = first.joints[body].numpy()
        for t in range(6):
            turn = yaw_matrix(heading(rotations[0]))
            own = rotations.copy()
            own[0] = turn.T @ own[0]
            told = np.concatenate([
                [0.0, 0.0, root[2]], own[:, :, :2].swapaxes(1, 2).ravel(), ((joints - root) @ turn)[1:].ravel(),
                (velocity @ turn).ravel(), turning @ turn,
            ])  # fmt: skip
            read = model.standardise(torch.from_numpy(told))
            prior = model.prior_latent(read[None])
            assert torch.isfinite(prior.mean).all()
            said = model.decoder(read[None], latents[body, t][None])[0, :CHANGE].detach().numpy() * 0.02
            turns = Rotation.from_rotvec(said[3:].reshape(22, 3)).as_matrix()
            after = turns @ own
            after[0] = turn @ after[0]
            turning = turn @ Rotation.from_matrix(turns[0]).as_rotvec() * FPS
            root, rotations = root + turn @ said[:3], after
            moved = forward_kinematics(rotations, REST_OFFSETS, root)[0]
            velocity, joints = (moved - joints) * FPS, moved
            np.testing.assert_allclose(found.states.joints[body, t].detach().numpy(), joints, atol=1e-6)


def test_the_likeliest_future_has_no_chance_in_it_and_samples_have(model: HumorNet) -> None:
    first = some_states(2)
    likeliest = [sample(model, first, 3, bones(3), None).states.root for _ in range(2)]
    torch.testing.assert_close(*likeliest)
    drawn = [sample(model, first, 3, bones(3), torch.Generator().manual_seed(seed)).states.root for seed in (0, 0, 1)]
    torch.testing.assert_close(drawn[0], drawn[1])
    assert not torch.allclose(drawn[0], drawn[2])


VARIANTS = [
    HumorConfig(hidden=64), HumorConfig(hidden=64, learned_prior=False), HumorConfig(hidden=64, residual=False),
    HumorConfig(hidden=64, contacts=False),
]  # fmt: skip


@pytest.mark.parametrize("config", VARIANTS, ids=["whole", "standard prior", "no delta", "no contacts"])
@pytest.mark.parametrize("done", [0.0, 0.25, 0.9])
def test_every_variant_learns_at_every_stage(config: HumorConfig, done: float) -> None:
    torch.manual_seed(0)
    sequences = Sequences.of(as_set(simulated_clips(30, 4, seed=0)))
    net, rng = HumorNet(config), np.random.default_rng(0)
    loss, terms = transition_loss(net, sequences.draw(8, 5, rng), done, rng)
    loss.backward()
    assert torch.isfinite(loss)
    assert ("L_contact" in terms) == config.contacts
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in net.parameters())


def test_sequences_are_mirrored_bodies_that_are_consistent() -> None:
    sequences = Sequences.of(as_set(simulated_clips(30, 4, seed=0)))
    batch = sequences.draw(8, 5, np.random.default_rng(0))
    assert batch.states.root.shape == (8, 6, 3)
    assert batch.contacts.shape == (8, 5, 2 * len(CONTACT_JOINTS))
    torch.testing.assert_close(batch.states.joints.diff(dim=1) * FPS, batch.states.velocity[:, 1:], atol=1e-3, rtol=0)
    lengths = (batch.states.joints[:, :, 4] - batch.states.joints[:, :, 1]).norm(dim=-1)
    torch.testing.assert_close(lengths, batch.offsets[:, None, 4].norm(dim=-1).expand_as(lengths), atol=1e-5, rtol=0)


@torch.no_grad()
def test_what_ships_tells_motion_of_people_it_has_not_seen(shipped: HumorNet) -> None:
    """Simulated people, half a second rolled out by the latents that the encoder finds; golden figures."""
    positions = simulated_clips(32, 24, seed=1).positions.swapaxes(0, 1)
    offsets = np.stack([estimate_offsets(clip) for clip in positions])
    # rotations as the solver has them: what else people call the pose of a spine, it was not taught
    rotations = np.stack([solve_rotations(clip, bones) for clip, bones in zip(positions, offsets, strict=True)])
    root, rotations, offsets = (torch.from_numpy(x).float() for x in (positions[:, :, 0], rotations, offsets))
    states = states_of(root, rotations, offsets)
    posterior, prior = transitions(shipped, states)
    told = roll_out(shipped, states[:, 0], posterior.mean[:, :15], offsets).states.joints[:, -1]
    error = 1e3 * float((told - states.joints[:, 15]).norm(dim=-1).mean())
    nats = float(posterior.kl(prior).mean())
    assert error == pytest.approx(TOLD_MM, rel=0.15)
    assert nats == pytest.approx(NATS, rel=0.15)


def test_latents_are_normal_with_means_and_log_variances() -> None:
    def some(seed: int) -> torch.Tensor:
        return torch.randn(5, 4, generator=torch.Generator().manual_seed(seed))

    first, second = Gaussian(some(0), some(1)), Gaussian(some(2), some(3))
    normals = [Normal(each.mean, (0.5 * each.log_variance).exp()) for each in (first, second)]
    torch.testing.assert_close(first.sigma, normals[0].scale)
    torch.testing.assert_close(first.kl(second), kl_divergence(*normals).sum(dim=-1))
    draw = first.sample(torch.Generator().manual_seed(2))
    torch.testing.assert_close(draw, first.mean + first.sigma * some(2))
    local, deep = Posterior(first.mean, first.log_variance, second.mean, second.log_variance).kl()
    unit = [kl_divergence(normal, Normal(0.0, 1.0)).sum(dim=-1).mean() for normal in normals]
    torch.testing.assert_close([local, deep], unit)
