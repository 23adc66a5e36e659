from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from steadypose.prior.body.kinematics import forward_kinematics, heading, yaw_matrix
from steadypose.prior.body.skeleton import REST_OFFSETS
from steadypose.prior.fit import tensors
from steadypose.prior.fit.humor_network import HumorConfig, HumorNet, transitions
from steadypose.prior.fit.motion import Motion, Variables
from steadypose.prior.models.completer_features import rotations_of_6d

FRAMES = 7


def some(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).normal(size=shape))


def turns(*shape: int, size: float = 0.4) -> np.ndarray:
    vectors = size * some(*shape, 3).numpy()
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*shape, 3, 3)


def test_joints_and_orientations_are_those_of_plain_kinematics() -> None:
    rotations, offsets, root = turns(2, FRAMES, 22), REST_OFFSETS + 0.01 * some(22, 3).numpy(), some(2, FRAMES, 3)
    given = torch.from_numpy(rotations), torch.from_numpy(offsets)
    for at, place in ((root, root.numpy()), (None, np.zeros((2, FRAMES, 3)))):
        for found, expected in zip(
            tensors.forward_kinematics(*given, at), forward_kinematics(rotations, offsets, place), strict=True
        ):
            np.testing.assert_allclose(found.numpy(), expected, atol=1e-9)


def test_six_numbers_are_the_first_two_columns_and_any_six_are_a_rotation() -> None:
    matrix = torch.from_numpy(turns(5))
    six = tensors.to_6d(matrix)
    torch.testing.assert_close(six, torch.cat([matrix[..., 0], matrix[..., 1]], dim=-1))
    torch.testing.assert_close(tensors.from_6d(six), matrix)
    found = tensors.from_6d(some(5, 6))
    np.testing.assert_allclose(found.numpy(), rotations_of_6d(some(5, 6).numpy()), atol=1e-9)
    torch.testing.assert_close(found @ found.mT, torch.eye(3).double().expand(5, 3, 3))
    torch.testing.assert_close(torch.linalg.det(found), torch.ones(5).double())
    first = some(5, 6)[:, :3]
    torch.testing.assert_close(found[..., 0], first / first.norm(dim=-1, keepdim=True))


def test_a_window_without_its_heading_faces_ahead_in_its_frame_and_is_turned_back() -> None:
    rotations = turns(4, FRAMES, 22)
    rotations[:, :, 0] = yaw_matrix(np.linspace(-3.0, 3.0, 4 * FRAMES).reshape(4, FRAMES)) @ rotations[:, :, 0]
    given = torch.from_numpy(rotations)
    turned, back = tensors.remove_heading(given, 3)
    np.testing.assert_allclose(heading(turned[:, 3, 0].numpy()), 0.0, atol=1e-9)
    np.testing.assert_allclose(tensors.heading(given[:, :, 0]).numpy(), heading(rotations[:, :, 0]))
    np.testing.assert_allclose(back.numpy(), yaw_matrix(heading(rotations[:, 3, 0])), atol=1e-9)
    torch.testing.assert_close(back[:, None] @ turned[:, :, 0], given[:, :, 0])
    torch.testing.assert_close(turned[:, :, 1:], given[:, :, 1:])


@pytest.fixture
def motion() -> Motion:
    """A body that turns and bends off its start, with bones of its own, over a floor that is low and tilted."""
    torch.manual_seed(0)
    net = HumorNet(HumorConfig(hidden=64, latent=6, components=2)).double().eval().requires_grad_(False)
    start = Variables.initial(
        some(FRAMES, 3), torch.from_numpy(turns(FRAMES, 22)), torch.from_numpy(REST_OFFSETS), -0.2, 6
    )
    off = {
        "root": 0.1 * some(FRAMES, 3, seed=1), "orientation": 0.3 * some(FRAMES, 3, seed=2),
        "turns": 0.3 * some(FRAMES, 21, 3, seed=3), "bones": 0.02 * some(22, 3, seed=4),
        "ground": torch.tensor([-0.2, 0.1, -0.2]).double(), "latents": some(FRAMES - 2, 6, seed=5),
    }  # fmt: skip
    return Motion(net, replace(start, **off))


def test_a_motion_is_its_start_and_all_that_it_is_off(motion: Motion) -> None:
    v = motion.variables
    changes = torch.cat([v.orientation[:, None], v.turns], dim=1).numpy().reshape(-1, 3)
    rotations = Rotation.from_rotvec(changes).as_matrix().reshape(FRAMES, 22, 3, 3) @ v.start_rotations.numpy()
    np.testing.assert_allclose(motion.rotations.numpy(), rotations, atol=1e-9)
    np.testing.assert_allclose(motion.offsets.numpy(), REST_OFFSETS + v.bones.numpy())
    root = some(FRAMES, 3).numpy() + [0.0, 0.0, 0.2] + v.root.numpy()
    joints = forward_kinematics(rotations, motion.offsets.numpy(), root)[0]
    np.testing.assert_allclose(motion.joints.numpy(), joints, atol=1e-9)
    tilt = Rotation.from_rotvec([0.1, -0.2, 0.0]).as_matrix()
    np.testing.assert_allclose(motion.world_joints.numpy(), joints @ tilt.T - [0.0, 0.0, 0.2], atol=1e-7)
    np.testing.assert_allclose(motion.states.velocity.numpy(), np.diff(joints, axis=0) * 30.0, atol=1e-7)


def test_each_step_is_decoded_from_its_state_with_a_latent_beside_the_priors_mean(motion: Motion) -> None:
    following, logits = motion.predicted
    posterior, prior = transitions(motion.model, motion.states)
    latents = prior.mean + prior.sigma * motion.variables.latents
    expected, chances = motion.model.step(motion.states[:-1], latents, motion.offsets)
    torch.testing.assert_close(following.joints, expected.joints)
    torch.testing.assert_close(logits, chances)
    said = ((posterior.mean - prior.mean) / prior.sigma).clamp(-3.0, 3.0)
    torch.testing.assert_close(motion.encoded_latents(), said)
