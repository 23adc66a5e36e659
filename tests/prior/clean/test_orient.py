import numpy as np
from scipy.spatial.transform import Rotation
from tests.helpers.bodies import noisy, waving
from tests.helpers.values import clean_bodies

from steadypose.msgs.types import CleanBody
from steadypose.prior.body.inverse_kinematics import solve_rotations
from steadypose.prior.body.kinematics import global_rotations, heading, rotation_matrices, rotation_matrix
from steadypose.prior.body.skeleton import PARENT, REST_OFFSETS
from steadypose.prior.sim.noise import time_correlated

FRAMES, SETTLED = 45, 20


def _bodies(positions: np.ndarray, orient: bool) -> list[CleanBody]:
    return clean_bodies(positions, orient={"enabled": orient})


def _root(bodies: list[CleanBody]) -> Rotation:
    return Rotation.from_quat([body.rotations[0] for body in bodies[SETTLED:]])


def test_positions_are_those_without_it_byte_for_byte() -> None:
    mine, plain = (_bodies(noisy(FRAMES, 0.02), on) for on in (True, False))
    for name in ("positions", "sigma", "state", "bone_lengths"):
        np.testing.assert_array_equal([getattr(b, name) for b in mine], [getattr(b, name) for b in plain])
    assert mine[-1].rotations.tobytes() != plain[-1].rotations.tobytes()


def _bones_off(bodies: list[CleanBody]) -> np.ndarray:
    """(T, 21) radians by which bones, put on by the rotations, are off those between the joints."""
    placed = global_rotations(rotation_matrices(np.array([b.rotations for b in bodies])))[:, PARENT[1:]]
    bone = (placed @ REST_OFFSETS[1:, :, None])[..., 0]
    joints = np.array([b.positions for b in bodies])
    true = joints[:, 1:] - joints[:, PARENT[1:]]
    return np.arctan2(np.linalg.norm(np.cross(bone, true), axis=-1), (bone * true).sum(axis=-1))


def test_on_a_perfect_input_bones_lie_as_the_joints_and_the_heading_stays() -> None:
    mine, plain = (_bodies(waving(FRAMES), on)[SETTLED:] for on in (True, False))
    off, before = (np.degrees(_bones_off(bodies).max(axis=0)) for bodies in (mine, plain))
    assert off.max() < 1.5
    assert (off < before + 0.2).all()
    turned, solved = (np.array([rotation_matrix(body.rotations[0]) for body in bodies]) for bodies in (mine, plain))
    assert np.abs(np.degrees(heading(turned) - heading(solved))).max() < 0.5


def test_with_noise_the_root_is_nearer_the_true_one_and_turns_less() -> None:
    truth = waving(FRAMES)
    noise = time_correlated(np.random.default_rng(0).normal(0.0, 0.02, (FRAMES, 22, 3)), 0.93)
    true = Rotation.from_matrix(solve_rotations(truth, REST_OFFSETS)[SETTLED:, 0])
    mine, plain = (_root(_bodies(truth + noise, on)) for on in (True, False))
    assert np.median((mine.inv() * true).magnitude()) < 0.7 * np.median((plain.inv() * true).magnitude())
    assert (mine[:-1].inv() * mine[1:]).magnitude().mean() < (plain[:-1].inv() * plain[1:]).magnitude().mean()
