import numpy as np
from scipy.spatial.transform import Rotation
from tests.helpers.bodies import waving

from steadypose.benchmarks.studies.rotations_truth import SCORED, align, score

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
    found = score(
        _turns(np.random.default_rng(1), np.radians(1.0)), truth, np.repeat(waving(FRAMES)[:, None], CLIPS, 1)
    )
    assert abs(found["turn beyond"] - np.sqrt(2) * np.sqrt(8 / np.pi)) < 0.1
