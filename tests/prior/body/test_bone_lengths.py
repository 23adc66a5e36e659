import numpy as np
import pytest
from tests.helpers.bodies import fk, random_pose, waving

from steadypose.prior.body import bone_lengths
from steadypose.prior.body.bone_lengths import LIKE_SAMPLES, TRUNK_PLACE_SPREAD, estimate_bones, estimate_offsets
from steadypose.prior.body.inverse_kinematics import solve_pose
from steadypose.prior.body.skeleton import COLLARS, HIPS, LIMB_ENDS, MIRROR, REST_OFFSETS, J

BIAS, NOISE = 0.02, 0.01
UNTURNED = np.tile(np.eye(3), (22, 1, 1))
LEFT_HIP, RIGHT_KNEE = J["left_hip"], J["right_knee"]


def lengths(offsets: np.ndarray) -> np.ndarray:
    return np.linalg.norm(offsets, axis=-1)


def worst(offsets: np.ndarray, truth: np.ndarray) -> float:
    """Metres, of the bone that is the furthest from its true length."""
    return float(np.abs(lengths(offsets) - lengths(truth)).max())


@pytest.mark.parametrize("scale", [0.75, 1.0, 1.15])
def test_many_good_samples_give_the_persons_own_bones(scale: float) -> None:
    offsets = estimate_bones(waving(64, scale, speed=3.0), BIAS, NOISE, 64).offsets
    assert worst(offsets, scale * REST_OFFSETS) < 0.01


def test_one_sample_with_a_limb_guessed_gives_human_bones() -> None:
    """Seen from the side, the far hip is put 0.4 m away on the wall behind."""
    positions = waving(1)
    positions[:, LEFT_HIP] += [0.0, 0.35, 0.0]
    measured = np.linalg.norm(positions[0, LEFT_HIP] - positions[0, 0])
    assert measured - lengths(REST_OFFSETS)[LEFT_HIP] > 0.3
    assert worst(estimate_bones(positions, BIAS, NOISE, 64).offsets, REST_OFFSETS) < 0.07


def test_a_person_with_long_legs_is_believed_the_more_the_longer_they_are_seen_and_the_better_the_sensor() -> None:
    """The same samples: nearly this person's bones from motion capture, human ones from a sensor that may err."""
    long = REST_OFFSETS.copy()
    legs = [J[f"{s}_{j}"] for s in ("left", "right") for j in ("knee", "ankle")]
    long[legs] *= 1.15
    positions = solve_pose(waving(64, speed=3.0), long)[1]
    positions = positions + np.random.default_rng(0).normal(size=positions.shape) * 0.01

    def off(frames: int, bias: float) -> float:
        return float(lengths(estimate_bones(positions[:frames], bias, NOISE, 64).offsets - long)[legs].mean())

    assert off(1, BIAS) > off(8, BIAS) > off(64, BIAS)
    assert off(64, BIAS) < 0.4 * lengths(long - REST_OFFSETS)[legs].mean()
    assert off(12, 0.0) < 0.005 < 0.02 < off(12, BIAS)


def test_both_sides_are_alike_though_one_is_seen() -> None:
    positions = waving(64, 1.1)
    right = [J[f"right_{j}"] for j in ("knee", "ankle", "foot", "elbow", "wrist")]
    positions[:, right] = np.nan
    offsets = estimate_bones(positions, BIAS, NOISE, 64).offsets
    np.testing.assert_allclose(offsets[MIRROR] * [1, -1, 1], offsets, atol=1e-12)
    assert worst(offsets, 1.1 * REST_OFFSETS) < 0.04


def test_a_joint_never_seen_lies_between_its_neighbours() -> None:
    positions = waving(64, 1.1, speed=3.0)
    hidden = [J[n] for n in ("spine1", "spine2", "left_collar", "right_collar")]
    positions[:, hidden] = np.nan
    assert worst(estimate_bones(positions, BIAS, NOISE, 64).offsets, 1.1 * REST_OFFSETS) < 0.02


def test_a_collar_never_seen_is_where_the_shoulder_says() -> None:
    person = REST_OFFSETS.copy()
    person[[*COLLARS]] += [0.04, 0.0, 0.02]
    positions = fk(random_pose(np.random.default_rng(4), 64, spread=0.2), person)
    positions[:, [*COLLARS]] = np.nan
    found = estimate_bones(positions, 0.0, 0.001, 64).offsets
    np.testing.assert_allclose((found - REST_OFFSETS)[[*COLLARS]], [[0.04, 0.0, 0.02]] * 2, atol=0.015)


def test_what_is_still_to_be_learned_of_a_bone_falls_with_every_sample_and_ends() -> None:
    positions = waving(64, speed=3.0)
    variance = np.stack([estimate_bones(positions[:n], BIAS, NOISE, 64).length_variance for n in (1, 8, 32, 64)])
    assert (np.diff(variance[:, 1:], axis=0) < 0).all()
    assert (variance[-1] == 0).all()
    sure = estimate_bones(positions[:1], 0.0, 0.001, 64).length_variance
    assert sure.max() < 0.002**2


def test_lengths_are_the_posterior_of_a_stature_and_each_bones_own() -> None:
    """Against the joint Gaussian of all logarithms of lengths, conditioned at once."""
    frames, samples = 5, 20
    rng = np.random.default_rng(2)
    ratio = np.exp(0.1 * rng.standard_normal(22))
    ratio = np.minimum(ratio, ratio[MIRROR])  # equal on both sides
    person = REST_OFFSETS * ratio[:, None]
    positions = np.tile(fk(UNTURNED, person), (frames, 1, 1))
    bones = [joint for joint in range(1, 22) if joint <= MIRROR[joint]]
    rest = lengths(REST_OFFSETS)[bones]
    sides = np.array([1 if MIRROR[joint] == joint else 2 for joint in bones])
    spread = np.array([bone_lengths.LIMB_SPREAD if j in LIMB_ENDS else bone_lengths.TRUNK_SPREAD for j in bones])
    prior = np.diag(spread**2) + bone_lengths.STATURE_SPREAD**2
    bias, noise = bone_lengths.LENGTH_BIASES * BIAS, np.sqrt(2.0) * NOISE

    def posterior(count: int) -> tuple[np.ndarray, np.ndarray]:
        error = (bias**2 / (1 + count / LIKE_SAMPLES) + noise**2 / (sides * count)) / rest**2
        gain = prior @ np.linalg.inv(prior + np.diag(error))
        return gain @ np.log(ratio[bones]), np.diag(prior - gain @ prior)

    (mean, now), (_, then) = posterior(frames), posterior(samples)
    found = estimate_bones(positions, BIAS, NOISE, samples)
    of_limbs = [k for k, joint in enumerate(bones) if joint in LIMB_ENDS]
    expected = rest * np.exp(mean)
    np.testing.assert_allclose(lengths(found.offsets)[bones][of_limbs], expected[of_limbs], rtol=1e-9)
    to_learn = (now - then) * expected**2
    np.testing.assert_allclose(found.length_variance[bones][of_limbs], to_learn[of_limbs], rtol=1e-9)

    # the hips are placed on the pelvis, each axis by itself
    def weight(count: int) -> float:
        doubt = bias**2 / (1 + count / LIKE_SAMPLES) + noise**2 / count
        return TRUNK_PLACE_SPREAD**2 / (TRUNK_PLACE_SPREAD**2 + doubt)

    scaled = REST_OFFSETS[HIPS[0]] * np.exp(mean[bones.index(HIPS[0])])
    placed = scaled + weight(frames) * (person[HIPS[0]] - scaled)
    np.testing.assert_allclose(found.offsets[HIPS[0]], placed, atol=5e-4)
    expected_variance = TRUNK_PLACE_SPREAD**2 * (weight(samples) - weight(frames))
    assert found.length_variance[HIPS[0]] == pytest.approx(expected_variance)


def test_bones_are_recovered_from_noisy_poses() -> None:
    rng = np.random.default_rng(6)
    bones = REST_OFFSETS * rng.uniform(0.8, 1.2, size=(22, 1))
    positions = fk(random_pose(rng, 300, spread=0.2), bones) + rng.normal(size=(300, 22, 3)) * 0.015
    positions[:20] += rng.normal(size=(20, 22, 3)) * 0.5  # outliers
    estimate = estimate_offsets(positions)
    assert worst(estimate, bones) < 0.012


def test_a_bent_limb_does_not_shorten_bones_around_a_joint_that_is_never_seen() -> None:
    """Arms hang from the shoulders, and a knee is straight now and then."""
    arm, leg = [J["left_shoulder"], J["left_elbow"]], [J["left_knee"], J["left_ankle"]]
    bones = REST_OFFSETS * 1.1
    posture = REST_OFFSETS.copy()
    for side in ("left", "right"):
        for part in ("elbow", "wrist"):
            posture[J[f"{side}_{part}"]] = [0.0, 0.0, -np.linalg.norm(REST_OFFSETS[J[f"{side}_{part}"]])]
    sits = posture.copy()
    for side in ("left", "right"):
        sits[J[f"{side}_ankle"]] = [-np.linalg.norm(REST_OFFSETS[J[f"{side}_ankle"]]), 0.0, 0.0]
    positions = np.stack([fk(UNTURNED, 1.1 * pose) for pose in [posture] * 6 + [sits] * 14])
    for unseen, chain in (("shoulder", arm), ("knee", leg)):
        shown = positions.copy()
        shown[:, [J[f"{side}_{unseen}"] for side in ("left", "right")]] = np.nan
        np.testing.assert_allclose(lengths(estimate_offsets(shown))[chain], lengths(bones)[chain], rtol=0.02)


def test_an_arm_alone_has_the_bones_that_its_ends_span() -> None:
    positions = np.full((3, 22, 3), np.nan)
    positions[:, J["left_collar"]], positions[:, J["left_elbow"]] = 0.0, [0.0, 0.3, 0.0]
    chain = [J["left_shoulder"], J["left_elbow"]]
    assert np.linalg.norm(estimate_offsets(positions)[chain].sum(axis=0)) == pytest.approx(0.3)
