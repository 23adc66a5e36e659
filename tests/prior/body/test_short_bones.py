import numpy as np
from scipy.spatial.transform import Rotation

from steadypose.prior.body.rotation_filters import follow_short_bones, unknown_turns
from steadypose.prior.body.skeleton import REST_OFFSETS, J

SHORT = [J[name] for name in ("spine2", "neck", "left_collar", "right_collar")]
FRAMES, SIGMA = 900, 0.02
BONES = REST_OFFSETS[None]


def _followed(turned: np.ndarray, sigma: float) -> np.ndarray:
    """Orientations (T, 22, 3, 3), one after the other."""
    state, answers = unknown_turns(1), turned.copy()
    for frame in answers:
        follow_short_bones(frame[None], BONES, np.full((1, 22), sigma), state)
    return answers


def _turned(vectors: np.ndarray) -> np.ndarray:
    """(T, 22, 3, 3) of a body of which only short bones are turned, by vectors (T, 4, 3) about those above."""
    turned = np.broadcast_to(Rotation.from_rotvec([0.3, -0.8, 1.9]).as_matrix(), (len(vectors), 22, 3, 3)).copy()
    turned[:, SHORT] = turned[:, SHORT] @ Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(-1, 4, 3, 3)
    return turned


def _off(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    apart = found[:, SHORT].swapaxes(-1, -2) @ true[:, SHORT]
    return Rotation.from_matrix(apart.reshape(-1, 3, 3)).magnitude().reshape(-1, 4)


def test_a_perfect_bone_stays_and_so_do_all_others() -> None:
    rng = np.random.default_rng(0)
    true = _turned(rng.normal(0.0, 0.3, (60, 4, 3)))
    found = _followed(true, 1e-5)
    assert np.degrees(_off(found, true)).max() < 0.05
    noisy = _followed(true, SIGMA)
    others = np.setdiff1d(np.arange(22), SHORT)
    np.testing.assert_array_equal(noisy[:, others], true[:, others])


def test_noisy_bones_come_nearer_to_how_this_body_holds_them() -> None:
    rng = np.random.default_rng(1)
    usual = rng.normal(0.0, 0.3, (1, 4, 3)) + np.zeros((FRAMES, 1, 1))
    true, noisy = _turned(usual), _turned(usual + rng.normal(0.0, 0.15, usual.shape))
    off, before = (np.median(_off(answer, true)[FRAMES // 2 :], axis=0) for answer in (_followed(noisy, SIGMA), noisy))
    assert (off < 0.85 * before).all()
    assert off[0] < 0.4 * before[0]  # the spine hardly turns


def test_a_bone_that_is_turned_far_is_followed() -> None:
    """A head that looks down for a second is not held up."""
    vectors = np.zeros((FRAMES, 4, 3))
    vectors[-30:, 1, 1] = 1.0
    found = _followed(_turned(vectors), 0.005)
    assert _off(found, _turned(vectors))[-1, 1] < 0.05
