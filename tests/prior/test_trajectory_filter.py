"""The root filter against a textbook Kalman filter, and what standing feet do to it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prior.kinematics import yaw_matrix
from prior.trajectory_filter import RootFilter

DT = 1 / 30


class Textbook:
    """All three axes in one state of (2 + feet) * 3, with dense matrices and a vector update."""

    def __init__(self, position, sigma, speed, feet):
        self.size = 2 + feet
        self.x = np.zeros(3 * self.size)
        self.x[:3] = position
        self.p = np.diag([sigma**2] * 3 + [speed**2] * 3 + [0.0] * 3 * feet)
        self.standing = set()

    def predict(self, dt, acceleration, drift, slip):
        f = np.eye(3 * self.size)
        f[:3, 3:6] = dt * np.eye(3)
        q = np.zeros((3 * self.size, 3 * self.size))
        eye = np.eye(3)
        q[:3, :3] = (acceleration**2 * dt**3 / 3 + drift**2 * dt) * eye
        q[:3, 3:6] = q[3:6, :3] = acceleration**2 * dt**2 / 2 * eye
        q[3:6, 3:6] = acceleration**2 * dt * eye
        for k in self.standing:
            q[6 + 3 * k : 9 + 3 * k, 6 + 3 * k : 9 + 3 * k] = slip**2 * dt * eye
        self.x, self.p = f @ self.x, f @ self.p @ f.T + q

    def correct(self, h, z, sigma):
        s = h @ self.p @ h.T + np.diag(np.broadcast_to(sigma, 3) ** 2.0)
        k = self.p @ h.T @ np.linalg.inv(s)
        self.x = self.x + k @ (z - h @ self.x)
        self.p = (np.eye(len(self.x)) - k @ h) @ self.p

    def rows(self, *blocks):
        h = np.zeros((3, 3 * self.size))
        for sign, block in blocks:
            h[:, 3 * block : 3 * block + 3] = sign * np.eye(3)
        return h

    def plant(self, k, from_root, sigma):
        block = slice(6 + 3 * k, 9 + 3 * k)
        self.x[block] = self.x[:3] + from_root
        self.p[block], self.p[:, block] = 0.0, 0.0
        # A foot seen once stands where the root is, plus an error of its own: the limit of a vague prior.
        self.p[block] = self.p[:3]
        self.p[:, block] = self.p[:, :3]
        self.p[block, block] = self.p[:3, :3] + sigma**2 * np.eye(3)
        self.standing.add(k)


def test_agrees_with_a_textbook_filter():
    rng = np.random.default_rng(0)
    start = rng.normal(size=3)
    ours, theirs = RootFilter(start, 0.05, np.zeros(3), 1.0, feet=2), Textbook(start, 0.05, 1.0, feet=2)
    for step in range(60):
        for each in (ours, theirs):
            each.predict(DT, 3.0, 0.02, 0.01)
        velocity, position, foot = rng.normal(size=(3, 3))
        ours.observe_velocity(velocity, np.array([0.1, 0.1, 0.05]))
        theirs.correct(theirs.rows((1, 1)), velocity, np.array([0.1, 0.1, 0.05]))
        if step % 3 == 0:
            ours.observe_position(position, 0.02)
            theirs.correct(theirs.rows((1, 0)), position, 0.02)
        if step == 5:
            ours.plant(1, foot, 0.02)
            theirs.plant(1, foot, 0.02)
        if step > 5:
            ours.observe_foot(1, foot, 0.03)
            theirs.correct(theirs.rows((1, 3), (-1, 0)), foot, 0.03)
    np.testing.assert_allclose(np.r_[ours.position, ours.velocity], theirs.x[:6], atol=1e-6)
    np.testing.assert_allclose(ours.covariance, theirs.p[:6, :6], atol=1e-7)


def test_covariance_grows_while_nothing_is_measured():
    f = RootFilter(np.zeros(3), 0.01, np.zeros(3), 0.1, feet=1)
    spreads = []
    for _ in range(30):
        f.predict(DT, 3.0, 0.0, 0.01)
        spreads.append(f.position_sigma)
    assert (np.diff(spreads, axis=0) > 0).all()


def test_standing_foot_holds_the_root_and_stops_it():
    f = RootFilter(np.zeros(3), 0.01, np.zeros(3), 0.1, feet=1)
    foot = np.array([0.1, 0.2, -0.9])
    f.plant(0, foot, 0.003)
    for _ in range(60):
        f.predict(DT, 1.0, 0.0, 0.01)
        f.observe_velocity(np.array([0.3, 0.0, 0.0]), 0.3)  # a network that is wrong
        f.observe_foot(0, foot, 0.003)
    assert np.linalg.norm(f.position) < 0.03
    assert np.linalg.norm(f.velocity) < 0.1


def test_standing_foot_carries_the_root_over_it():
    """The foot passes backwards under the root at 1 m/s: the root moves forward at 1 m/s."""
    f = RootFilter(np.zeros(3), 0.01, np.zeros(3), 1.0, feet=1)
    f.plant(0, np.array([0.3, 0.0, -0.9]), 0.01)
    for step in range(1, 19):
        f.predict(DT, 3.0, 0.0, 0.005)
        f.observe_foot(0, np.array([0.3 - step * DT, 0.0, -0.9]), 0.01)
    assert f.position[0] == pytest.approx(18 * DT, abs=0.02)
    assert f.velocity[0] == pytest.approx(1.0, abs=0.1)


def test_a_foot_planted_by_a_lost_root_does_not_find_it():
    f = RootFilter(np.zeros(3), 0.5, np.zeros(3), 0.1, feet=1)
    f.plant(0, np.zeros(3), 0.01)
    for _ in range(100):
        f.observe_foot(0, np.zeros(3), 0.01)
    assert (f.position_sigma > 0.49).all()


def test_foot_height_tells_only_the_height():
    f = RootFilter(np.zeros(3), 0.5, np.zeros(3), 0.1, feet=1)
    f.plant(0, np.array([0.0, 0.0, -0.9]), 0.01)
    f.observe_foot_height(0, 0.08, 0.02)
    assert f.position[2] == pytest.approx(0.98, abs=0.01)
    assert f.position_sigma[2] < 0.03
    assert (f.position_sigma[:2] > 0.49).all()


def test_surprise_counts_standard_deviations():
    f = RootFilter(np.zeros(3), 0.1, np.zeros(3), 0.1, feet=1)
    f.plant(0, np.zeros(3), 0.01)
    assert f.foot_surprise(0, np.array([0.01, 0.0, 0.0]), 0.01) == pytest.approx(2**-0.5, rel=0.01)


@settings(max_examples=30, deadline=None)
@given(yaw=st.floats(-np.pi, np.pi), seed=st.integers(0, 1000))
def test_turns_with_the_world(yaw: float, seed: int):
    turn = yaw_matrix(yaw)
    ends = []
    for r in (np.eye(3), turn):
        rng = np.random.default_rng(seed)
        f = RootFilter(r @ rng.normal(size=3), 0.1, np.zeros(3), 1.0, feet=1)
        f.plant(0, r @ rng.normal(size=3), 0.02)
        for _ in range(10):
            f.predict(DT, 3.0, 0.01, 0.01)
            f.observe_velocity(r @ rng.normal(size=3), np.array([0.2, 0.2, 0.1]))
            f.observe_foot(0, r @ rng.normal(size=3), 0.02)
        ends.append(np.stack([f.position, f.velocity]))
    np.testing.assert_allclose(ends[1], ends[0] @ turn.T, atol=1e-9)
