"""The root filter against a textbook Kalman filter, and what standing feet do to it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from steadypose.prior.body.kinematics import yaw_matrix
from steadypose.prior.world.root_filter import RootFilter, RootNoise

DT = 1 / 30


def at_origin(noise: RootNoise, jitter: float, bias: float = 0.0) -> RootFilter:
    return RootFilter(noise, np.zeros(3), jitter, bias, np.zeros(3), feet=1)


class Textbook:
    """All three axes in one state of (4 + feet) * 3, with dense matrices and a vector update."""

    def __init__(self, noise, position, jitter, bias, velocity, feet):
        self.noise, self.size, self.standing = noise, 4 + feet, set()
        self.x = np.r_[position, velocity, np.zeros(6 + 3 * feet)]
        self.p = self.block({(0, 0): jitter**2 + bias**2, (0, 2): -bias, (2, 0): -bias, (2, 2): 1.0, (3, 3): 1.0})
        self.p += self.block({(1, 1): noise.first_speed**2})

    def block(self, entries):
        m = np.zeros((self.size, self.size))
        for place, value in entries.items():
            m[place] = value
        return np.kron(m, np.eye(3))

    def predict(self, dt):
        n = self.noise
        speed = np.linalg.norm(self.x[3:5])
        sensor = np.exp(-dt * (1 / n.sensor_memory_s + speed / n.sensor_memory_m))
        network = np.exp(-dt / n.network_memory_s)
        f = np.eye(3 * self.size) + self.block({(0, 1): dt, (2, 2): sensor - 1, (3, 3): network - 1})
        a = n.acceleration**2
        q = self.block({(0, 0): a * dt**3 / 3, (0, 1): a * dt**2 / 2, (1, 0): a * dt**2 / 2, (1, 1): a * dt})
        q += self.block({(2, 2): 1 - sensor**2, (3, 3): 1 - network**2})
        q += self.block({(4 + k, 4 + k): n.slip**2 * dt for k in self.standing})
        self.x, self.p = f @ self.x, f @ self.p @ f.T + q

    def correct(self, entries, z, sigma):
        h = np.zeros((3, 3 * self.size))
        for k, value in entries.items():
            h[:, 3 * k : 3 * k + 3] = np.diag(np.broadcast_to(value, 3))
        s = h @ self.p @ h.T + np.diag(np.broadcast_to(sigma, 3) ** 2.0)
        k = self.p @ h.T @ np.linalg.inv(s)
        self.x = self.x + k @ (z - h @ self.x)
        self.p = (np.eye(len(self.x)) - k @ h) @ self.p

    def plant(self, k, from_root, sigma):
        """A foot seen once stands where the root is, plus an error of its own: the limit of a vague prior."""
        block = slice(12 + 3 * k, 15 + 3 * k)
        self.x[block] = self.x[:3] + from_root
        self.p[block], self.p[:, block] = self.p[:3], self.p[:, :3]
        self.p[block, block] = self.p[:3, :3] + sigma**2 * np.eye(3)
        self.standing.add(k)


def test_agrees_with_a_textbook_filter():
    rng = np.random.default_rng(0)
    start, noise = rng.normal(size=3), RootNoise(3.0, 0.01, sensor_memory_s=0.5, network_memory_s=0.2)
    velocity = np.array([1.0, 0.0, 0.0])
    ours = RootFilter(noise, start, 0.02, 0.05, velocity, feet=2)
    theirs = Textbook(noise, start, 0.02, 0.05, velocity, feet=2)
    for step in range(60):
        for each in (ours, theirs):
            each.predict(DT)
        velocity, position, foot = rng.normal(size=(3, 3))
        jitter, bias = np.array([0.1, 0.1, 0.05]), np.array([0.3, 0.3, 0.1])
        ours.observe_velocity(velocity, jitter, bias)
        theirs.correct({1: 1.0, 3: bias}, velocity, jitter)
        if step % 3 == 0:
            ours.observe_position(position, 0.02, bias=0.05)
            theirs.correct({0: 1.0, 2: 0.05}, position, 0.02)
        if step == 5:
            ours.plant(1, foot, 0.02)
            theirs.plant(1, foot, 0.02)
        if step > 5:
            ours.observe_foot(1, foot, 0.03)
            theirs.correct({5: 1.0, 0: -1.0}, foot, 0.03)
    np.testing.assert_allclose(np.r_[ours.position, ours.velocity], theirs.x[:6], atol=1e-6)
    np.testing.assert_allclose(ours.covariance, theirs.p[:6, :6], atol=1e-7)


def test_a_slow_error_is_not_averaged_away():
    """A root seen a hundred times is no better known than the sensor's slow error allows."""
    f = at_origin(RootNoise(acceleration=0.01, sensor_memory_s=100.0), jitter=0.02, bias=0.05)
    for _ in range(100):
        f.predict(DT)
        f.observe_position(np.zeros(3), 0.02, bias=0.05)
    assert (f.position_sigma > 0.045).all()


def test_covariance_grows_while_nothing_is_measured():
    f = at_origin(RootNoise(), jitter=0.01)
    spreads = []
    for _ in range(30):
        f.predict(DT)
        spreads.append(f.position_sigma)
    assert (np.diff(spreads, axis=0) > 0).all()


def test_standing_foot_holds_the_root_and_stops_it():
    f = at_origin(RootNoise(acceleration=1.0, slip=0.01), jitter=0.01)
    foot = np.array([0.1, 0.2, -0.9])
    f.plant(0, foot, 0.003)
    for _ in range(60):
        f.predict(DT)
        f.observe_velocity(np.array([0.3, 0.0, 0.0]), 0.1, bias=0.3)  # a network that is wrong
        f.observe_foot(0, foot, 0.003)
    assert np.linalg.norm(f.position) < 0.03
    assert np.linalg.norm(f.velocity) < 0.1


def test_standing_foot_carries_the_root_over_it():
    """The foot passes backwards under the root at 1 m/s: the root moves forward at 1 m/s."""
    f = at_origin(RootNoise(), jitter=0.01)
    f.plant(0, np.array([0.3, 0.0, -0.9]), 0.01)
    for step in range(1, 19):
        f.predict(DT)
        f.observe_foot(0, np.array([0.3 - step * DT, 0.0, -0.9]), 0.01)
    assert f.position[0] == pytest.approx(18 * DT, abs=0.02)
    assert f.velocity[0] == pytest.approx(1.0, abs=0.1)


def test_a_foot_planted_by_a_lost_root_does_not_find_it():
    f = at_origin(RootNoise(), jitter=0.5)
    f.plant(0, np.zeros(3), 0.01)
    for _ in range(100):
        f.observe_foot(0, np.zeros(3), 0.01)
    assert (f.position_sigma > 0.49).all()


def test_foot_height_tells_only_the_height():
    f = at_origin(RootNoise(), jitter=0.5)
    f.plant(0, np.array([0.0, 0.0, -0.9]), 0.01)
    f.observe_foot_height(0, 0.08, 0.02)
    assert f.position[2] == pytest.approx(0.98, abs=0.01)
    assert f.position_sigma[2] < 0.03
    assert (f.position_sigma[:2] > 0.49).all()


def test_surprise_counts_standard_deviations():
    f = at_origin(RootNoise(), jitter=0.1)
    f.plant(0, np.zeros(3), 0.01)
    assert f.foot_surprise(0, np.array([0.01, 0.0, 0.0]), 0.01) == pytest.approx(2**-0.5, rel=0.01)


@settings(max_examples=30)
@given(yaw=st.floats(-np.pi, np.pi), seed=st.integers(0, 1000))
def test_turns_with_the_world(yaw: float, seed: int):
    turn = yaw_matrix(yaw)
    ends = []
    for r in (np.eye(3), turn):
        rng = np.random.default_rng(seed)
        f = RootFilter(RootNoise(), r @ rng.normal(size=3), 0.1, 0.05, r @ rng.normal(size=3), feet=1)
        f.plant(0, r @ rng.normal(size=3), 0.02)
        for _ in range(10):
            f.predict(DT)
            f.observe_velocity(r @ rng.normal(size=3), 0.1, bias=np.array([0.2, 0.2, 0.1]))
            f.observe_foot(0, r @ rng.normal(size=3), 0.02)
        ends.append(np.stack([f.position, f.velocity]))
    np.testing.assert_allclose(ends[1], ends[0] @ turn.T, atol=1e-9)
