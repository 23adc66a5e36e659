from functools import lru_cache

import numpy as np
import pytest
import torch

from steadypose.prior.body.kinematics import CONTACT_JOINTS, LOAD_SPEED, label_contacts, yaw_matrix
from steadypose.prior.models.contacts import FEATURES, OF_JOINT, LiveContacts, contact_features
from steadypose.prior.models.root_velocity import FRAME_S, LiveRootVelocity, TrajectoryConfig, velocity_features
from steadypose.prior.sim.scripts import walk_turn
from steadypose.training.recipes.contacts import ContactConfig, ContactNet
from steadypose.training.recipes.root_velocity import TrajectoryNet, _features
from steadypose.training.weights import arrays_of

DT = 1 / 30
FEET = slice(2, 6)


@lru_cache
def walk() -> tuple[np.ndarray, np.ndarray]:
    """Positions (T, 22, 3) and headings (T,) of a simulated walk of 10 s."""
    motion = walk_turn(np.random.default_rng(0))[0]
    motion = motion.at(np.arange(motion.times[0], motion.times[0] + 10.0, DT))
    left = motion.rotations[:, 0, :, 1]
    return motion.positions, np.arctan2(-left[:, 0], left[:, 1])


def features(positions, yaw, sigma=0.001, root_observed=1.0, ground=0.0) -> np.ndarray:
    count = len(positions) - 1
    return contact_features(
        positions[1:], positions[:-1], DT, yaw[1:], np.full((count, 22), sigma), np.full(count, root_observed),
        np.full((count, 8), ground),
    )  # fmt: skip


def test_what_is_not_known_is_nought():
    positions, yaw = walk()
    known = features(positions, yaw).reshape(-1, FEATURES)
    unplaced = features(positions, yaw, root_observed=0.0, ground=np.nan)
    assert (unplaced[:, -2:] == 0).all()
    each = unplaced[:, :-2].reshape(len(unplaced), 8, OF_JOINT)
    assert (each[..., 6:10] == 0).all()
    np.testing.assert_allclose(each[..., :6], known[:, :-2].reshape(len(known), 8, OF_JOINT)[..., :6])
    hidden = positions.copy()
    hidden[:, CONTACT_JOINTS[3]] = np.nan
    each = features(hidden, yaw)[:, :-2].reshape(len(known), 8, OF_JOINT)
    assert (each[:, 3] == 0).all()
    assert np.isfinite(each).all()


def test_a_frame_rate_changes_nothing_but_the_step():
    positions, yaw = walk()
    args = yaw[2:3], np.full((1, 22), 0.001), np.ones(1), np.zeros((1, 8))
    steady = positions[:1] + np.arange(3)[:, None, None] * [0.01, 0.0, 0.0]
    once = contact_features(steady[1:2], steady[:1], DT, *args)
    twice = contact_features(steady[2:3], steady[:1], 2 * DT, *args)
    velocities = [
        c
        for k in range(8)
        for c in (*range(OF_JOINT * k + 3, OF_JOINT * k + 6), *range(OF_JOINT * k + 7, OF_JOINT * k + 10))
    ]
    np.testing.assert_allclose(once[:, velocities], twice[:, velocities], atol=1e-5)


@torch.no_grad()
def test_frame_by_frame_it_says_the_same():
    torch.manual_seed(0)
    net = ContactNet(ContactConfig(hidden=16)).eval()
    frames = torch.randn(3, 12, FEATURES)
    load, rest = net(frames)
    live = LiveContacts(arrays_of(net))
    state = np.zeros((3, live.hidden), dtype=np.float32)
    for t in range(12):
        said = live(frames[:, t].numpy(), state)
        state = said.state
        np.testing.assert_allclose(said.load, torch.sigmoid(load[:, t]), atol=1e-5)
        np.testing.assert_allclose(said.rest, torch.sigmoid(rest[:, t]), atol=1e-5)


@pytest.mark.parametrize(("root_observed", "ground", "least"), [(1.0, 0.0, 0.9), (0.0, np.nan, 0.8)])
def test_the_shipped_weights_know_a_walk(root_observed: float, ground: float, least: float):
    """Bounds a little under what was measured; without root and ground, from the body's own motion alone."""
    positions, yaw = walk()
    live = LiveContacts.load("default")
    state, said = np.zeros((1, live.hidden), dtype=np.float32), []
    for row in features(positions, yaw, root_observed=root_observed, ground=ground):
        answer = live(row[None], state)
        state = answer.state
        said.append(answer.load[0, FEET] > 0.5)
    label = label_contacts(positions, 30.0, LOAD_SPEED)[1:, FEET]
    hits = (np.array(said) & label).sum()
    assert 2 * hits / (np.array(said).sum() + label.sum()) > least


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


def test_velocities_are_divided_by_the_time_between_frames() -> None:
    before, joints = np.zeros((1, 22, 3)), np.full((1, 22, 3), 0.2)
    once, twice = (velocity_features(joints, before, dt, np.zeros(1)).reshape(22, 6) for dt in (0.1, 0.2))
    np.testing.assert_allclose(once[:, 3:], 2.0 * twice[:, 3:])
    np.testing.assert_array_equal(once[:, :3], twice[:, :3])
