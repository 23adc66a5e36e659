import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from tests.helpers.bodies import waving

from steadypose.benchmarks.baselines.body import beside, facing
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import yaw_matrix
from steadypose.prior.body.skeleton import PARENT, J
from steadypose.prior.clean.occluded import DENSITIES, FIRST_SPEED, OccludedJoints, Placed, Track, bridge
from steadypose.prior.models.occlusion import FEATURES, SIGMA_SCALE, STANDING, LiveOcclusion, Occluded, Weighed
from steadypose.prior.models.posture import LivePosture
from steadypose.training.recipes.occlusion import OcclusionConfig, OcclusionNet
from steadypose.training.weights import arrays_of

FRAMES, ARM = 40, [J["left_elbow"], J["left_wrist"]]


class Asked:
    """Stands in for the network, and remembers what it was asked of."""

    def __init__(self) -> None:
        self.rows: list[Occluded] = []

    def __call__(self, rows: Occluded) -> Weighed:
        self.rows.append(rows)
        return Weighed(rows.candidates[:, 0], np.ones(len(rows.joint)))


def walking(bodies: int = 1) -> Floats:
    """(T, B, 22, 3) metres: bodies that wave, turn and go."""
    motion = np.stack([waving(FRAMES + 9 * body)[9 * body :] for body in range(bodies)], axis=1)
    turned = motion @ yaw_matrix(np.linspace(0.0, 1.2, FRAMES))[:, None].swapaxes(-1, -2)
    return turned + np.linspace(0.0, 1.0, FRAMES)[:, None, None, None] * (1.0, 0.4, 0.0)


def occlusions(bodies: int, seed: int) -> NDArray[np.bool_]:
    """(T, B, 22) joints that come and go, after five frames in which all is seen, and one that is always there."""
    rng = np.random.default_rng(seed)
    hidden = np.repeat(rng.random((FRAMES // 4, bodies, 22)) < 0.3, 4, axis=0)
    hidden[:5], hidden[:, :, J["neck"]] = False, False
    return hidden


def without_gaps(bodies: int = 1) -> Track:
    """In which no joint is bridged."""
    return Track(np.full((2, bodies, 22, 3), np.nan), 0, np.full(bodies, 0.005))


def bones(frame: Floats) -> Floats:
    """(B, 22, 3) metres: from each joint's parent to it, in a body like this frame's."""
    return frame - frame[:, PARENT]


def placed(
    joints: OccludedJoints, truth: Floats, seen: Floats, sigma: Floats, unseen: Floats, completed: Floats,
    completed_sigma: float,
) -> Placed:  # fmt: skip
    """What is said of bodies (B, 22, 3), whose bones are known, of which no joint is seen again within the delay."""
    count, again, deviations = len(seen), np.zeros(sigma.shape, dtype=bool), np.full(sigma.shape, completed_sigma)
    answer = joints.update(
        np.arange(count), seen, sigma, unseen, again, completed, deviations, bones(truth), without_gaps(count)
    )
    assert answer is not None
    return answer


def asked_of(truth: Floats, hidden: NDArray[np.bool_]) -> list[Occluded]:
    """The rows of every frame, of joints that coast where they were last seen, and are completed as they truly are."""
    bodies = truth.shape[1]
    joints, asked = OccludedJoints("default", bodies), Asked()
    joints.weigher = asked
    place, unseen = truth[0].copy(), np.zeros((bodies, 22))
    for frame, gone in zip(truth, hidden, strict=True):
        unseen = np.where(gone, unseen + 1 / 30, 0.0)
        place = np.where(gone[..., None], place, frame)
        sigma = 0.005 + unseen
        again = np.zeros(gone.shape, dtype=bool)
        joints.update(
            np.arange(bodies), place, sigma, unseen, again, frame, np.full(sigma.shape, 0.03), bones(frame),
            without_gaps(bodies),
        )  # fmt: skip
    return asked.rows


@given(st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_joints_keep_their_place_beside_the_body(seed: int) -> None:
    truth, hidden = walking(2), occlusions(2, seed)
    expected = beside(np.where(hidden[..., None], np.nan, truth), np.arange(FRAMES) / 30, 0)
    times = np.flatnonzero(hidden.any(axis=(1, 2)))
    rows = asked_of(truth, hidden)
    assert len(rows) == len(times)
    for t, row in zip(times, rows, strict=True):
        assert set(zip(row.body, row.joint, strict=True)) == set(zip(*np.nonzero(hidden[t]), strict=True))
        np.testing.assert_allclose(row.candidates[:, 2], expected[t, row.body, row.joint], atol=1e-9)


def test_of_a_frame_lost_whole_nothing_is_asked() -> None:
    truth, hidden = walking(), np.zeros((FRAMES, 1, 22), dtype=bool)
    hidden[10:12] = True
    assert not asked_of(truth, hidden)


LEG = [J[f"left_{name}"] for name in ("knee", "ankle", "foot")]


@pytest.mark.parametrize(("limb", "share"), [(ARM, 0.5), (LEG, 0.0)])
def test_a_limb_never_seen_is_between_completion_standing_body_and_posture(limb: list[int], share: float) -> None:
    truth, rng, joints = walking(), np.random.default_rng(0), OccludedJoints("default", 1)
    joints.weigher, posture = (asked := Asked()), LivePosture.load("default")
    unseen, sigma, off = np.zeros((1, 22)), np.full((1, 22), 0.005), []
    unseen[:, limb], sigma[:, limb] = np.inf, np.inf
    for frame in truth:
        seen, completed = frame.copy(), frame + 0.02 * rng.standard_normal(frame.shape)
        seen[:, limb] = np.nan
        answer = placed(joints, frame, seen, sigma, unseen, completed, 0.03)
        assert answer.joints.tolist() == [[0, joint] for joint in limb]
        above = PARENT[limb[0]]
        standing = frame[0, above] + (STANDING[limb] - STANDING[above]) @ yaw_matrix(facing(frame))[0].T
        expected = posture(frame, sigma, np.linalg.norm(bones(frame), axis=-1)).positions[0, limb]
        off.append(answer.positions - (1.0 - share) * 0.5 * (frame[0, limb] + standing) - share * expected)
    assert not asked.rows
    np.testing.assert_allclose(off[10:], 0.0, atol=0.05)
    shake = np.diff(off[10:], axis=0).std()
    assert shake < 0.01, "of 0.028, what differs from frame to frame in the completion"


def test_limbs_never_seen_of_two_bodies_are_where_each_alone_has_them() -> None:
    both, alone = OccludedJoints("default", 2), [OccludedJoints("default", 1) for _ in range(2)]
    unseen = np.zeros((2, 22))
    unseen[0, ARM] = unseen[1, LEG] = np.inf
    sigma = np.where(unseen > 0, np.inf, 0.005)
    for frame in walking(2)[:5]:
        seen = np.where(unseen[..., None] > 0, np.nan, frame)
        together = placed(both, frame, seen, sigma, unseen, frame, 0.03)
        each = [placed(alone[k], frame[[k]], seen[[k]], sigma[[k]], unseen[[k]], frame[[k]], 0.03) for k in range(2)]
        np.testing.assert_allclose(together.positions, np.concatenate([one.positions for one in each]), atol=1e-9)


def test_limbs_that_were_never_seen_are_stated_less_sure_and_those_seen_in_part_are_not() -> None:
    joints, standing = OccludedJoints("default", 1), waving(1)
    joints.weigher = Asked()
    arm, part = [J[f"right_{name}"] for name in ("shoulder", "elbow", "wrist")], [J["right_ankle"], J["right_foot"]]
    unseen, sigma, seen = np.zeros((1, 22)), np.full((1, 22), 0.005), standing.copy()
    for gone in (LEG, arm, part, ARM[1:]):
        unseen[:, gone], sigma[:, gone], seen[:, gone] = np.inf, np.inf, np.nan
    answer = placed(joints, standing, seen, sigma, unseen, standing, 0.05)
    stated = dict(zip(answer.joints[:, 1].tolist(), answer.sigma.tolist(), strict=True))
    expected = dict.fromkeys(sorted((*LEG, *arm, *part, ARM[1])), 0.05) | dict.fromkeys(LEG, 0.07)
    expected |= dict.fromkeys(arm[1:], 0.08)
    assert stated == {joint: pytest.approx(value) for joint, value in expected.items()}


def test_what_was_last_seen_is_forgotten_until_the_completions_deviation_is_stated() -> None:
    joints, standing, stated = OccludedJoints("default", 1), waving(1), []
    for second in range(15):
        unseen = np.zeros((1, 22))
        unseen[:, ARM] = second
        answer = placed(joints, standing, standing, 0.003 + 0.1 * unseen, unseen, standing, 0.1)
        if second:
            stated.append(answer.sigma.min())
    assert min(stated[10:]) >= 0.1 > stated[0]


@given(st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_a_bridged_joint_is_the_gaussian_mean_given_both_sides_of_its_gap(seed: int) -> None:
    rng = np.random.default_rng(seed)
    track, noise, t = np.cumsum(0.02 * rng.standard_normal((24, 3)), axis=0), 0.01, np.arange(24) / 30
    track[12:18], at = np.nan, int(rng.integers(12, 18))
    known = np.flatnonzero(np.isfinite(track[:, 0]))[1:]
    x, means, likelihoods = track[known] - track[0], [], []
    low, high = np.minimum.outer(t, t), np.maximum.outer(t, t)
    for density in DENSITIES:
        # of an integrated random walk that begins at the first observation
        walk = density * low**2 * (high / 2 - low / 6) + FIRST_SPEED**2 * np.outer(t, t) + noise**2
        covariance = walk[np.ix_(known, known)] + noise**2 * np.eye(len(known))
        solved = np.linalg.solve(covariance, x)
        means.append(track[0] + walk[at, known] @ solved)
        likelihoods.append(-0.5 * (x * solved).sum() - 1.5 * np.linalg.slogdet(covariance)[1])
    weights = np.exp(np.array(likelihoods) - max(likelihoods))
    place = np.empty(3)
    assert 0.0 < bridge(track, at, noise, place) < 0.2
    np.testing.assert_allclose(place, weights @ np.array(means) / weights.sum(), atol=1e-6)


def test_a_joint_that_is_not_seen_before_is_not_bridged() -> None:
    track, place = np.full((8, 3), np.nan), np.zeros(3)
    track[5:] = 1.0
    assert bridge(track, 3, 0.01, place) == np.inf
    assert np.isnan(place).all()


def test_live_form_gives_what_torch_gives_between_the_candidates() -> None:
    torch.manual_seed(1)
    network = OcclusionNet(OcclusionConfig())
    with torch.no_grad():
        for tensor in (*network.parameters(), network.mean):
            tensor.normal_(0.0, 0.3)
        network.deviation.uniform_(0.5, 2.0)
    rng = np.random.default_rng(0)
    features, joint = rng.normal(size=(50, FEATURES)).astype(np.float32), rng.integers(0, 22, 50)
    rows = Occluded(np.zeros(50, dtype=np.intp), joint, rng.normal(size=(50, 4, 3)), features)
    live = LiveOcclusion(arrays_of(network))(rows)
    with torch.no_grad():
        weights, log_sigma = network(torch.from_numpy(features), torch.from_numpy(joint))
    expected = np.einsum("nc,nca->na", weights.numpy().astype(float), rows.candidates)
    np.testing.assert_allclose(live.positions, expected, atol=1e-5)
    np.testing.assert_allclose(live.sigma, SIGMA_SCALE * 1e-3 * np.exp(log_sigma.numpy()), rtol=1e-4)
    assert (live.positions <= rows.candidates.max(axis=1) + 1e-9).all()
    assert (live.positions >= rows.candidates.min(axis=1) - 1e-9).all()


def test_what_ships_believes_a_foot_that_stands_more_than_its_completion() -> None:
    joints, feet = OccludedJoints("default", 1), [J["left_ankle"], J["left_foot"]]
    standing, unseen, found = waving(1), np.zeros((1, 22)), []
    wrong = standing + (0.0, 0.2, 0.0)
    for frame in range(60):
        unseen[:, feet] = max(frame - 10, 0) / 30
        answer = placed(joints, standing, standing, 0.003 + 0.1 * unseen, unseen.copy(), wrong, 0.1)
        if len(answer.joints):
            found.append(answer)
    off = np.array([np.linalg.norm(each.positions - standing[0, feet], axis=-1) for each in found])
    assert off.max() < 0.06
