import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steadypose.prior.body import kinematics
from steadypose.prior.body.inverse_kinematics import place_joints
from steadypose.prior.body.kinematics import CONTACT_JOINTS, LOAD_SPEED, label_contacts, quaternions, rotation_matrix
from steadypose.prior.body.skeleton import PARENTS, REST_POSITIONS, J


def naive_fk(rotations: np.ndarray, offsets: np.ndarray, root: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    positions, world = np.zeros((22, 3)), np.zeros((22, 3, 3))
    for joint, parent in enumerate(PARENTS):
        if parent < 0:
            positions[joint], world[joint] = root, rotations[joint]
        else:
            positions[joint] = positions[parent] + world[parent] @ offsets[joint]
            world[joint] = world[parent] @ rotations[joint]
    return positions, world


def test_forward_kinematics_agrees_with_a_walk_down_the_tree() -> None:
    rng = np.random.default_rng(0)
    rotations = Rotation.random(6 * 22, rng=rng).as_matrix().reshape(2, 3, 22, 3, 3)
    offsets = rng.normal(size=(2, 3, 22, 3))
    root = rng.normal(size=(2, 3, 3))
    got, orientations = kinematics.forward_kinematics(rotations, offsets, root)
    for index in np.ndindex(2, 3):
        positions, world = naive_fk(rotations[index], offsets[index], root[index])
        assert np.allclose(got[index], positions)
        assert np.allclose(orientations[index], world)
    offsets[..., 0, :] = 0.0
    assert np.allclose(place_joints(rotations, offsets), got - root[..., None, :])


def test_the_rest_pose_stands_in_a_t_and_faces_x() -> None:
    assert REST_POSITIONS[J["left_wrist"], 1] > 0.5
    assert REST_POSITIONS[J["right_wrist"], 1] < -0.5
    assert REST_POSITIONS[J["head"], 2] > 0.5 > -0.8 > REST_POSITIONS[J["left_ankle"], 2]
    assert REST_POSITIONS[J["left_foot"], 0] > REST_POSITIONS[J["left_ankle"], 0] + 0.1


def test_contacts_do_not_depend_on_the_frame_rate() -> None:
    heel = CONTACT_JOINTS.index(J["left_ankle"])
    for fps in (30.0, 60.0, 120.0):
        time = np.arange(0, 2, 1 / fps)
        positions = np.tile(REST_POSITIONS, (len(time), 1, 1)) + [0, 0, 0.96]
        positions[:, J["left_ankle"], 0] += np.where(time > 1, (time - 1) * 0.3, 0)  # slides at 0.3 m/s after 1 s
        contacts = label_contacts(positions, fps)
        assert contacts[time < 0.9, heel].all()
        assert not contacts[time > 1.1, heel].any()
    assert not label_contacts(positions + [0, 0, 0.2], fps).any()
    assert label_contacts(positions[:1], fps).shape == (1, 8)
    assert label_contacts(positions, fps, LOAD_SPEED).sum() >= label_contacts(positions, fps).sum()


def test_quaternions_are_scipys() -> None:
    turns = Rotation.random(200, rng=np.random.default_rng(0))
    matrices = turns.as_matrix().reshape(10, 20, 3, 3)
    half_turns = Rotation.from_rotvec(np.pi * np.eye(3)).as_matrix()
    assert np.abs((quaternions(matrices).reshape(-1, 4) * turns.as_quat()).sum(axis=-1)) == pytest.approx(1.0)
    assert np.array_equal(np.abs(quaternions(half_turns)).round(9), np.eye(3, 4))
    for matrix, quaternion in zip(turns.as_matrix(), turns.as_quat(), strict=True):
        assert rotation_matrix(3.0 * quaternion) == pytest.approx(matrix)


def test_rotation_vectors_are_scipys() -> None:
    vectors = np.random.default_rng(0).normal(size=(40, 3))
    vectors[0], vectors[1] = 0.0, 1e-7
    turned = kinematics.from_rotation_vectors(vectors)
    np.testing.assert_allclose(turned, Rotation.from_rotvec(vectors).as_matrix(), atol=1e-12)
    expected = Rotation.from_matrix(turned).as_rotvec()
    np.testing.assert_allclose(kinematics.to_rotation_vectors(turned), expected, atol=1e-9)
