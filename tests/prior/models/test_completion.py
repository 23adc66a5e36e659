from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.prior.models.test_hgvae import SMALL, awake

from steadypose.prior.body.skeleton import PARENTS, J
from steadypose.prior.models.hgvae import live_completion
from steadypose.prior.models.hgvae.config import SCALE, CompletionConfig
from steadypose.prior.models.hgvae.live_completion import GROWTH, LAG, NEAR, STILL, Features, completion_features
from steadypose.training.networks.graph import CompletionNet, certainty_of

WRIST = J["left_wrist"]
TRACKS = slice(3 * WRIST, 3 * WRIST + 3)


def windows(frames: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Deviations (3, 66, T), and what was observed of them: all; a wrist but in one gap; a wrist never."""
    deviations = np.random.default_rng(0).normal(scale=0.3, size=(3, 66, frames))
    observed = np.ones_like(deviations)
    observed[1, TRACKS, 4:9] = 0
    observed[2, TRACKS] = 0
    return deviations, observed


def test_the_gap_to_the_nearest_observations() -> None:
    deviations, observed = windows()
    observed[0, 0, 7] = 0  # a coordinate alone: the joint was not seen whole
    gap = completion_features(deviations, observed, 0.0, patch=4).gap
    assert gap[0, 0, 7] == 0.5
    steps = np.arange(1, 6)
    np.testing.assert_allclose(gap[1, WRIST, 4:9], steps * (6 - steps) / 6, rtol=1e-6)
    assert (gap[2, WRIST] == -1).all()
    assert np.count_nonzero(gap) == 1 + 5 + 12
    observed[1, TRACKS, 9:] = 0
    assert completion_features(deviations, observed, 0.0, patch=4).gap[1, WRIST].tolist() == [0] * 4 + [*range(1, 9)]


def test_how_much_a_joint_moves_is_told_beside_the_one_above_and_without_the_noise() -> None:
    deviations, observed = windows()
    deviations[1] = np.tile(deviations[1, :3], (22, 1))  # all go where the pelvis goes: no other moves beside it
    deviations[2] = np.cumsum(deviations[2], axis=-1)
    features = completion_features(deviations, observed, np.array([0.0, 0.01, 0.01]), patch=4)
    assert features.noise[0, WRIST] == pytest.approx(
        (np.diff(deviations[0, TRACKS], n=2) ** 2).mean() / 6 + (0.002 / SCALE) ** 2, rel=1e-4
    )
    assert features.noise[1, J["head"]] > features.noise[1, WRIST] > (0.01 / SCALE) ** 2  # of the gap, nothing is told
    hips = [J["left_hip"], J["right_hip"], J["spine1"]]  # beside the pelvis's path, which is not the pelvis's track
    assert (np.delete(features.mobility[1], [0, WRIST, *hips]) < 1e-9).all()
    elbow = PARENTS[WRIST]
    way = deviations[2, 3 * elbow : 3 * elbow + 3] - deviations[2, 3 * PARENTS[elbow] : 3 * PARENTS[elbow] + 3]
    moved = ((way[:, LAG:] - way[:, :-LAG]) ** 2).mean() - 2 * (features.noise[2, elbow] - (0.01 / SCALE) ** 2)
    assert features.mobility[2, elbow] == pytest.approx(moved, rel=1e-3)
    assert features.mobility[2, WRIST] > 0  # never seen: as all do


def test_the_longer_ago_and_the_more_it_moves_the_less_the_line_counts() -> None:
    network = CompletionNet(12, CompletionConfig(patch=4, width=8, heads=2, layers=2))
    written = torch.zeros(1, 3, 88 * 4)
    written[..., : 66 * 4] = 1.0

    def leaning(moved: float, noise: float = 0.0, above: float = 0.0) -> np.ndarray:
        gap = torch.zeros(1, 22, 12)
        gap[0, WRIST], gap[0, PARENTS[WRIST]] = torch.arange(12), above
        with torch.inference_mode():
            correction, log_var = network.fuse(written, line_variance(gap, moved, noise))
        assert log_var[0, WRIST, 1:].diff().min() > 0
        return correction[0, 3 * WRIST].numpy()

    still, moving, noisy, hanging = leaning(1e-4), leaning(1e-2), leaning(1e-4, noise=1e-2), leaning(1e-4, above=5.0)
    assert still[0] == 0
    assert (np.diff(still) > 0).all()
    assert all((more[1:] > still[1:]).all() for more in (moving, noisy, hanging))
    assert moving[-1] < 1
    line = (1e-4 + (STILL / SCALE) ** 2) * (np.arange(12) / LAG) ** GROWTH
    np.testing.assert_allclose(still, line / (line + np.exp(live_completion.FIRST_LOG_VAR)), rtol=1e-5)
    never = line_variance(torch.full((1, 22, 12), -1.0), 0.0, 0.0)
    assert bool((network.fuse(written, never)[0] == 1).all())


def line_variance(apart: torch.Tensor, moved: float, noise: float) -> torch.Tensor:
    of_moved, of_noise = (np.full((1, 22), value, dtype=np.float32) for value in (moved, noise))
    features = Features(np.empty(0, dtype=np.float32), of_moved, of_noise, apart.numpy())
    return torch.from_numpy(features.line_variance())


def test_a_guess_is_believed_by_how_good_it_is() -> None:
    observed, log_var = (
        torch.zeros(1, 66, 4),
        torch.full((1, 22, 4), 2 * np.log(live_completion.HALF_CERTAIN_SIGMA / SCALE)),
    )
    observed[:, :3] = 1
    log_var[:, 2] += np.log(3.0)
    found = certainty_of(observed, log_var)
    assert (found[:, :3] == 1).all()
    np.testing.assert_allclose(found[:, 3:6], 0.5)
    np.testing.assert_allclose(found[:, 6:9], 0.25)


def test_an_observation_a_second_ago_differs_from_none() -> None:
    observed = np.ones((2, 66, 50))
    observed[0, TRACKS, 1:] = 0
    observed[1, TRACKS] = 0
    features = completion_features(np.zeros((2, 66, 50)), observed, 0.0, patch=5).nodes[:, :, :550].reshape(2, 50, 110)
    last, following = features[0, :, 66 + WRIST], features[0, :, 88 + WRIST]
    np.testing.assert_allclose(last, 1 / (1 + np.arange(50) / NEAR), rtol=1e-6)
    assert (following[1:] == 0).all()
    assert (features[1, :, [66 + WRIST, 88 + WRIST]] == 0).all()


def test_only_what_was_not_seen_moves() -> None:
    model = awake()
    deviations, observed = windows()
    observed[0, 3, 5] = 0  # one coordinate of a joint
    completed, certainty = model.completed(
        torch.from_numpy(deviations).float(), torch.from_numpy(observed).float(), 0.01
    )
    moved = np.abs(completed.numpy() - deviations) > 1e-6
    assert not moved[observed == 1].any()
    assert moved[observed == 0].all()
    assert ((certainty == 1).numpy() == (observed == 1)).all()


def test_noise_is_told_by_joint_where_it_was_seen_and_of_all_where_it_was_not() -> None:
    rng = np.random.default_rng(0)
    deviations, observed = np.zeros((1, 66, 12)), np.ones((1, 66, 12))
    deviations[0, TRACKS] = rng.normal(scale=0.02 / SCALE, size=(3, 12))
    observed[0, :3] = 0
    features = completion_features(deviations, observed, 0.0, patch=4).nodes[0, :, -46:-24]
    assert (features == features[0]).all()
    assert features[0, WRIST] > features[0, 0] > features[0, J["head"]]


def test_how_large_errors_last_is_told_to_every_node() -> None:
    features = [
        completion_features(*windows(), slow, patch=4).nodes[..., -1]
        for slow in (0.0, 0.001, 0.01, np.array([0.02, 0.02, 0.02]))
    ]
    assert [float(t.max()) for t in features] == pytest.approx([np.log(0.2), np.log(0.2), 0.0, np.log(2.0)], abs=1e-6)
    assert all((t == t[0, 0]).all() for t in features)


def test_windows_come_in_whole_patches() -> None:
    with pytest.raises(ValueError, match="whole patches of 5, got 12"):
        CompletionNet(12, CompletionConfig(patch=5))


def test_without_a_network_the_guess_stays() -> None:
    model = awake(replace(SMALL, completion=None))
    x, observed = torch.ones(1, 66, 12), torch.zeros(1, 66, 12)
    assert model.completed(x, observed, 0.0) == (x, observed)
