from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import block_diag, expm

from steadypose.prior.body.kinematics import yaw_matrix
from steadypose.prior.world.kalman import BodyFilter, BodyNoise

DT = 1 / 30
RESTS, SWINGS = np.ones(1), np.zeros(1)


def spring(rate: float, dt: float) -> NDArray[np.float64]:
    """Of an error and its rate in units of ``rate``: x'' = -2 w x' - w² x."""
    return np.asarray(expm(rate * dt * np.array([[0.0, 1.0], [-1.0, -2.0]])), dtype=np.float64)


def diagonal(*blocks: Any) -> NDArray[np.float64]:
    return np.asarray(block_diag(*blocks), dtype=np.float64)


class Textbook:
    """One axis, dense matrices."""

    def __init__(self, noise: BodyNoise, position, jitter, bias, velocity, feet):
        self.noise, self.feet = noise, feet
        self.x = np.r_[position, velocity, np.zeros(3 + 3 * feet)]
        self.p = np.diag([jitter**2 + bias**2, noise.first_speed**2, 1.0, 1.0, 1.0] + [0.0, 1.0, 1.0] * feet)
        self.p[0, 2] = self.p[2, 0] = -bias

    def predict(self, dt, load, rest, speed):
        n = self.noise
        root = spring(n.sensor_rate + speed / n.sensor_memory_m, dt)
        foot = spring(n.sensor_rate, dt)
        kept = np.exp(-dt / n.network_memory_s)
        f = diagonal([[1, dt], [0, 1]], root, kept, *[diagonal(1, foot)] * self.feet)
        a = (n.acceleration + n.acceleration_at_speed * speed) ** 2
        q = [a * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), np.eye(2) - root @ root.T, 1 - kept**2]
        for bears, r in zip(load, rest, strict=True):
            rolls = max(bears - r, 0.0)
            slip = 1 + n.slip_at_speed * speed
            walk = (slip * n.rest) ** (2 * r) * (slip * n.load) ** (2 * rolls) * n.swing ** (2 * (1 - r - rolls)) * dt
            q += [walk, np.eye(2) - foot @ foot.T]
        self.x, self.p = f @ self.x, f @ self.p @ f.T + diagonal(*q)

    def correct(self, entries, z, sigma):
        h = np.zeros(len(self.x))
        h[list(entries)] = list(entries.values())
        k = self.p @ h / (h @ self.p @ h + sigma**2)
        self.x = self.x + k * (z - h @ self.x)
        self.p = self.p - np.outer(k, h) @ self.p

    def place(self, at, z, jitter, bias, from_root):
        """A foot seen once is where it is seen, less two errors of its own: the limit of a vague prior."""
        self.x[at : at + 3] = z + from_root * self.x[0], 0.0, 0.0
        self.p[at : at + 3], self.p[:, at : at + 3] = 0.0, 0.0
        self.p[at], self.p[:, at] = from_root * self.p[0], from_root * self.p[:, 0]
        self.p[at, at] = from_root * self.p[0, 0] + jitter**2 + bias**2
        self.p[at, at + 1] = self.p[at + 1, at] = -bias
        self.p[at + 1, at + 1] = self.p[at + 2, at + 2] = 1.0


def test_agrees_with_a_textbook_filter():
    rng = np.random.default_rng(0)
    start = rng.normal(size=3)
    noise = BodyNoise(3.0, 2.0, sensor_rate=5.0, network_memory_s=0.2)
    velocity = np.array([1.0, 0.2, 0.0])
    ours = BodyFilter(noise, start, 0.02, 0.05, velocity, feet=2)
    theirs = [Textbook(noise, start[a], 0.02, 0.05, velocity[a], feet=2) for a in range(3)]
    for step in range(40):
        load, rest = np.sort(rng.random((2, 2)), axis=0)[::-1]
        speed = np.hypot(*ours.velocity[:2])
        ours.predict(DT, load, rest)
        seen, at_root, network, foot = rng.normal(size=(4, 3))
        ours.observe_velocity(network, 0.1, 0.3)
        if step < 20:
            ours.observe_position(seen, 0.02, 0.05)
        ours.observe_foot(0, foot, 0.01, 0.03, from_root=False)
        ours.observe_foot(1, at_root, 0.01, 0.03, from_root=True)
        for a, each in enumerate(theirs):
            each.predict(DT, load, rest, speed)
            each.correct({1: 1.0, 4: 0.3}, network[a], 0.1)
            if step < 20:
                each.correct({0: 1.0, 2: 0.05}, seen[a], 0.02)
            if step == 0:
                each.place(5, foot[a], 0.01, 0.03, from_root=0.0)
                each.place(8, at_root[a], 0.01, 0.03, from_root=1.0)
            else:
                each.correct({5: 1.0, 6: 0.03}, foot[a], 0.01)
                each.correct({8: 1.0, 9: 0.03, 0: -1.0}, at_root[a], 0.01)
    for a, each in enumerate(theirs):
        np.testing.assert_allclose([ours.position[a], ours.velocity[a]], each.x[:2], atol=1e-8)
        np.testing.assert_allclose(ours.feet[:, a], each.x[[5, 8]], atol=1e-8)
        np.testing.assert_allclose(ours.covariance[a::3, a::3], each.p[:2, :2], atol=1e-8)


def test_foot_height_tells_only_the_height_of_root_and_foot():
    f = BodyFilter(BodyNoise(), np.zeros(3), 0.5, 0.0, np.zeros(3), feet=2)
    f.observe_foot(1, np.array([0.0, 0.0, -0.9]), 0.01, 0.0, from_root=True)
    f.observe_foot_height(1, 0.08, 0.02)
    assert f.position[2] == pytest.approx(0.98, abs=0.01)
    assert f.feet[:, 2] == pytest.approx([0.0, 0.08], abs=0.01)
    assert f.position_sigma[2] < 0.03
    assert (f.position_sigma[:2] > 0.49).all()
    assert f.placed.tolist() == [False, True]
    f.lose(1)
    assert not f.placed.any()


@pytest.mark.parametrize(("speed", "slips"), [(0.0, 1.0), (2.0, 2.0)])
def test_feet_walk_and_the_root_accelerates_more_the_faster_the_root_moves(speed: float, slips: float):
    load, rest = np.array([1.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])
    expected = np.array([0.006 * slips, 0.2 * slips, 4.0]) ** 2
    np.testing.assert_allclose(BodyNoise().walk(load, rest, speed), expected)
    assert BodyNoise().density(speed) == pytest.approx((3.0 + speed) ** 2)
    f = BodyFilter(BodyNoise(), np.zeros(3), 0.01, 0.0, np.array([0.6 * speed, -0.8 * speed, 9.0]), feet=3)
    for foot in range(3):
        f.observe_foot(foot, np.zeros(3), 0.01, 0.0, from_root=False)
    f.predict(DT, load, rest)
    np.testing.assert_allclose(f.feet_sigma**2, np.tile((0.01**2 + expected * DT)[:, None], (1, 3)))


@settings(max_examples=30)
@given(yaw=st.floats(-np.pi, np.pi), seed=st.integers(0, 1000))
def test_turns_with_the_world(yaw: float, seed: int):
    turn = yaw_matrix(yaw)
    ends = []
    for r in (np.eye(3), turn):
        rng = np.random.default_rng(seed)
        f = BodyFilter(BodyNoise(), r @ rng.normal(size=3), 0.1, 0.05, r @ rng.normal(size=3), feet=1)
        for _ in range(10):
            f.predict(DT, RESTS, 0.5 * RESTS)
            f.observe_velocity(r @ rng.normal(size=3), 0.1, bias=np.array([0.2, 0.2, 0.1]))
            f.observe_foot(0, r @ rng.normal(size=3), 0.02, 0.02, from_root=True)
        ends.append(np.stack([f.position, f.velocity]))
    np.testing.assert_allclose(ends[1], ends[0] @ turn.T, atol=1e-9)
