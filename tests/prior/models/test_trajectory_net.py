import numpy as np
import torch

from steadypose.prior.body.kinematics import yaw_matrix
from steadypose.prior.models.root_velocity import FRAME_S, LiveRootVelocity, TrajectoryConfig, velocity_features
from steadypose.training.recipes.root_velocity import TrajectoryNet, _features
from steadypose.training.weights import arrays_of


@torch.no_grad()
def test_frame_by_frame_it_predicts_as_over_a_whole_clip() -> None:
    torch.manual_seed(0)
    rng, net = np.random.default_rng(0), TrajectoryNet(TrajectoryConfig(hidden=16)).eval()
    joints, yaw = rng.normal(0.0, 0.3, (2, 9, 22, 3)), rng.uniform(-3, 3, (2, 9))
    whole = net(_features(torch.from_numpy(joints).float(), torch.from_numpy(yaw_matrix(yaw)).float()))
    live = LiveRootVelocity(net.config, arrays_of(net))
    state = live.start(2)
    for t in range(9):
        features = velocity_features(joints[:, t], joints[:, max(t - 1, 0)], FRAME_S, yaw[:, t])
        velocity, log_sigma, state = live(features, state)
        np.testing.assert_allclose(velocity, whole.velocity[:, t], atol=1e-5)
        np.testing.assert_allclose(log_sigma, whole.log_sigma[:, t], atol=1e-5)


def test_features_do_not_know_which_way_the_body_faces() -> None:
    rng = np.random.default_rng(1)
    joints, before, yaw = rng.normal(0.0, 0.3, (1, 22, 3)), rng.normal(0.0, 0.3, (1, 22, 3)), np.array([0.4])
    turn = yaw_matrix(1.1).T
    np.testing.assert_allclose(
        velocity_features(joints, before, 0.1, yaw),
        velocity_features(joints @ turn, before @ turn, 0.1, yaw + 1.1),
        atol=1e-5,
    )


def test_velocities_are_divided_by_the_time_between_frames() -> None:
    before, joints = np.zeros((1, 22, 3)), np.full((1, 22, 3), 0.2)
    once, twice = (velocity_features(joints, before, dt, np.zeros(1)).reshape(22, 6) for dt in (0.1, 0.2))
    np.testing.assert_allclose(once[:, 3:], 2.0 * twice[:, 3:])
    np.testing.assert_array_equal(once[:, :3], twice[:, :3])
