import numpy as np
from scipy.spatial.transform import Rotation
from tests.helpers.bodies import fk, random_pose

from steadypose.prior.body.skeleton import REST_OFFSETS
from steadypose.prior.models.posture import rigid_covariance, rigid_pelvis

COUNT = 4000


def test_a_rigid_pelvis_is_turned_as_its_bones_are() -> None:
    turns = random_pose(np.random.default_rng(0), 50, 0.4)
    bones = np.broadcast_to(REST_OFFSETS, (50, 22, 3))
    np.testing.assert_allclose(rigid_pelvis(fk(turns), bones), turns[:, 0], atol=1e-9)


def test_its_covariance_is_the_spread_of_noisy_pelvises() -> None:
    rng = np.random.default_rng(1)
    turns = np.repeat(random_pose(rng, 1, 0.4), COUNT, axis=0)
    sigma = np.full((COUNT, 22), 0.002)
    sigma[:, [0, 3]] = 0.004
    bones = np.broadcast_to(REST_OFFSETS, (COUNT, 22, 3))
    noisy = rigid_pelvis(fk(turns) + rng.normal(0.0, 1.0, (COUNT, 22, 3)) * sigma[..., None], bones)
    spread = np.cov(Rotation.from_matrix(turns[:, 0].swapaxes(-1, -2) @ noisy).as_rotvec().T)
    stated = rigid_covariance(sigma[:1], bones[:1])[0]
    np.testing.assert_allclose(stated, spread, atol=0.06 * np.trace(spread))
