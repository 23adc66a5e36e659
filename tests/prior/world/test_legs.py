"""Legs on their bones: what moves, and the rotations that go with it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steadypose.prior.body.kinematics import forward_kinematics
from steadypose.prior.body.skeleton import PARENTS, REST_OFFSETS, J
from steadypose.prior.world.compose import fit_legs, turn_legs

LENGTHS = np.linalg.norm(REST_OFFSETS, axis=1)
LEGS = [J[f"{side}_{part}"] for side in ("left", "right") for part in ("hip", "knee", "ankle", "foot")]


def pose(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Local rotations (22, 4) and positions (22, 3) of a body somewhere."""
    turns = Rotation.from_rotvec(0.4 * np.random.default_rng(seed).normal(size=(22, 3)))
    return turns.as_quat(), forward_kinematics(turns.as_matrix(), REST_OFFSETS, np.array([1.0, 2.0, 0.9]))[0]


def lengths(positions: np.ndarray) -> np.ndarray:
    return np.linalg.norm(positions - positions[list(PARENTS)], axis=1)


def test_the_answer_is_the_most_likely_one():
    """The gradient of the energy, sum of (x - x0)² / s² + (|bone| - length)² / s_l², is all but gone."""
    rng = np.random.default_rng(2)
    _, positions = pose(2)
    sigma = 0.02 * np.exp(0.3 * rng.normal(size=22))
    seen = positions + 0.01 * rng.normal(size=(22, 3))

    def energy(p: np.ndarray) -> float:
        bones = [j for j in LEGS if j not in (J["left_hip"], J["right_hip"])]
        lengths_off = (lengths(p) - LENGTHS)[bones] / 0.025
        return float((((p - seen) / sigma[:, None]) ** 2).sum() + (lengths_off**2).sum())

    fitted = fit_legs(seen, sigma, LENGTHS)
    least = min(
        energy(fitted + 0.0005 * rng.normal(size=(22, 3)) * (np.isin(range(22), LEGS))[:, None]) for _ in range(200)
    )
    assert energy(fitted) < energy(seen)
    assert energy(fitted) < least + 0.01


def test_joints_and_lengths_that_are_not_known_are_left_out():
    _, positions = pose(3)
    positions[J["left_knee"]] = np.nan
    fitted = fit_legs(positions + 0.01, np.full(22, 0.02), np.zeros(22))
    np.testing.assert_array_equal(fitted, positions + 0.01)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_rotations_go_with_the_legs(sign: float):
    """A quaternion and its negative are the same rotation."""
    rotations, positions = pose(4)
    rotations *= sign
    moved = positions.copy()
    for side in ("left", "right"):
        moved[J[f"{side}_knee"]] += [0.02, 0.01, 0.0]
        moved[J[f"{side}_ankle"]] += [0.03, -0.02, 0.01]
        moved[J[f"{side}_foot"]] += [0.03, 0.0, 0.0]
    turned = turn_legs(rotations, positions, moved)
    offsets = REST_OFFSETS * (lengths(moved) / np.maximum(LENGTHS, 1e-9))[:, None]
    placed = forward_kinematics(Rotation.from_quat(turned).as_matrix(), offsets, moved[0])[0]
    np.testing.assert_allclose(placed[LEGS], moved[LEGS], atol=1e-9)
    others = sorted(set(range(22)) - set(LEGS))
    np.testing.assert_array_equal(turned[others], rotations[others])


def test_rotations_that_are_none_are_left_alone():
    rotations, positions = pose(5)
    rotations[J["left_knee"]] = np.nan
    rotations[J["right_ankle"]] = 0.0
    np.testing.assert_array_equal(turn_legs(rotations, positions, positions + 0.01), rotations)
