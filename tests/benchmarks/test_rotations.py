import numpy as np
from scipy.spatial.transform import Rotation
from tests.helpers.bodies import waving

from steadypose.benchmarks.baselines.rotations import RotationNet, predict_rotations, smooth_rotations
from steadypose.benchmarks.studies.rotations_truth import SCORED, align, angle, score
from steadypose.prior.body.skeleton import REST_POSITIONS

FRAMES, CLIPS = 40, 2


def _turns(rng: np.random.Generator, size: float) -> np.ndarray:
    vectors = rng.normal(0.0, size, (FRAMES * CLIPS * len(SCORED), 3))
    return Rotation.from_rotvec(vectors).as_matrix().reshape(FRAMES, CLIPS, len(SCORED), 3, 3)


def test_alignment_takes_away_a_constant_rotation_of_a_joint_and_no_outliers() -> None:
    rng = np.random.default_rng(0)
    file, rest = _turns(rng, 0.5), Rotation.random(len(SCORED), rng=rng).as_matrix()
    solved = file @ rest
    solved[:4] = solved[:4] @ Rotation.from_rotvec([2.0, 0.0, 0.0]).as_matrix()
    np.testing.assert_allclose(align(file, solved)[4:], solved[4:], atol=0.03)


def test_heading_tilt_direction_and_twist_are_told_apart() -> None:
    truth = np.broadcast_to(np.eye(3), (FRAMES, CLIPS, len(SCORED), 3, 3))
    positions = np.repeat(waving(FRAMES)[:, None], CLIPS, axis=1)

    def of(vector: list[float]) -> dict[str, list[float]]:
        return score(Rotation.from_rotvec(vector, degrees=True).as_matrix() @ truth, truth, positions)

    turned, leaning = of([0.0, 0.0, 10.0]), of([0.0, 10.0, 0.0])
    assert (turned["heading"], turned["tilt"], turned["root"]) == ([10.0, 10.0], [0.0, 0.0], [10.0, 10.0])
    assert (leaning["heading"], leaning["tilt"]) == ([0.0, 0.0], [10.0, 10.0])
    # about the vertical, legs twist and arms swing: two of each
    assert turned["twist"] == [5.0, 10.0]
    assert turned["turn beyond"] == 0.0


def test_the_turn_beyond_is_that_of_noise() -> None:
    truth = np.broadcast_to(np.eye(3), (FRAMES, CLIPS, len(SCORED), 3, 3))
    turns, bodies = _turns(np.random.default_rng(1), np.radians(1.0)), np.repeat(waving(FRAMES)[:, None], CLIPS, 1)
    found = score(turns, truth, bodies)
    assert abs(found["turn beyond"] - np.sqrt(2) * np.sqrt(8 / np.pi)) < 0.1


def _turning(frames: int, rate: float) -> np.ndarray:
    """(T, 1, 3, 3) of constant angular velocity, radians a frame."""
    return Rotation.from_rotvec(np.arange(frames)[:, None] * rate * np.array([0.6, 0.0, 0.8])).as_matrix()[:, None]


def test_constant_turning_is_followed_exactly_once_known_and_without_lag_an_agile_filter_gives_back_what_it_sees():
    truth = _turning(200, 0.1)
    for lag in (0, 4):
        found = smooth_rotations(truth, 10.0, lag)
        assert np.degrees(angle(found[150:].swapaxes(-1, -2) @ truth[150:])).max() < 1e-3
    seen = Rotation.from_rotvec(np.random.default_rng(0).standard_normal((20, 3))).as_matrix()[:, None]
    np.testing.assert_allclose(smooth_rotations(seen, 1e9, 0), seen, atol=1e-3)


def test_a_lag_and_stiffness_average_noise_away() -> None:
    truth = _turning(600, 0.02)
    noise = Rotation.from_rotvec(0.1 * np.random.default_rng(0).standard_normal((600, 3))).as_matrix()[:, None]
    seen = truth @ noise

    def off(density: float, lag: int) -> float:
        error = angle(smooth_rotations(seen, density, lag).swapaxes(-1, -2) @ truth)[60:]
        return float(np.sqrt(np.mean(error**2)))

    assert off(0.1, 4) < off(0.1, 0) < off(100.0, 0)
    assert off(100.0, 4) < 0.8 * off(100.0, 0)


def test_the_network_gives_rotations_that_turn_with_the_body() -> None:
    rng = np.random.default_rng(0)
    seen = REST_POSITIONS + 0.05 * rng.standard_normal((12, 2, 22, 3))
    turn = Rotation.from_euler("z", 1.0).as_matrix()
    net = RotationNet([0, 3, 9], lag=4).eval()
    found, turned = (predict_rotations(net, part) for part in (seen, seen @ turn.T))
    np.testing.assert_allclose(found @ found.swapaxes(-1, -2), np.broadcast_to(np.eye(3), found.shape), atol=1e-5)
    np.testing.assert_allclose(turned, turn @ found, atol=1e-4)
