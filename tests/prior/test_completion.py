from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from prior.completion_net import NEAR, CompletionConfig, CompletionNet, tell
from prior.graph import SCALE
from prior.skeletons import J
from prior.track_windows import Windows
from prior.train_completion import train_completion
from tests.prior.test_hgvae import SMALL, awake

WRIST = J["left_wrist"]
TRACKS = slice(3 * WRIST, 3 * WRIST + 3)


def windows(frames: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Deviations (3, 66, T), and what was observed of them: all; a wrist but in one gap; a wrist never."""
    deviations = np.random.default_rng(0).normal(scale=0.3, size=(3, 66, frames))
    observed = np.ones_like(deviations)
    observed[1, TRACKS, 4:9] = 0
    observed[2, TRACKS] = 0
    return deviations, observed


def test_a_correction_is_the_smaller_the_nearer_a_sighting_is() -> None:
    share = tell(*windows(), 0.0, patch=4).share
    assert (share[0] == 0).all()
    apart = np.array([1, 2, 3, 2, 1])
    np.testing.assert_allclose(share[1, TRACKS, 4:9], np.tile(1 - np.exp(-apart / NEAR), (3, 1)), rtol=1e-6)
    assert (share[2, TRACKS] == 1).all()
    assert (np.delete(share, range(TRACKS.start, TRACKS.stop), axis=1) == 0).all()


def test_a_sighting_a_second_ago_is_told_from_none() -> None:
    observed = np.ones((2, 66, 50))
    observed[0, TRACKS, 1:] = 0
    observed[1, TRACKS] = 0
    told = tell(np.zeros((2, 66, 50)), observed, 0.0, patch=5).nodes[:, :, :550].reshape(2, 50, 110)
    last, following = told[0, :, 66 + WRIST], told[0, :, 88 + WRIST]
    np.testing.assert_allclose(last, 1 / (1 + np.arange(50) / NEAR), rtol=1e-6)
    assert (following[1:] == 0).all()
    assert (told[1, :, [66 + WRIST, 88 + WRIST]] == 0).all()


def test_only_what_was_not_seen_moves() -> None:
    model = awake()
    deviations, observed = windows()
    completed = model.completed(torch.from_numpy(deviations).float(), torch.from_numpy(observed).float(), 0.01).numpy()
    moved = np.abs(completed - deviations) > 1e-6
    assert not moved[observed == 1].any()
    assert moved[observed == 0].all()


def test_noise_is_told_by_joint_where_it_was_seen_and_of_all_where_it_was_not() -> None:
    rng = np.random.default_rng(0)
    deviations, observed = np.zeros((1, 66, 12)), np.ones((1, 66, 12))
    deviations[0, TRACKS] = rng.normal(scale=0.02 / SCALE, size=(3, 12))
    observed[0, :3] = 0
    told = tell(deviations, observed, 0.0, patch=4).nodes[0, :, -24:-2]
    assert (told == told[0]).all()
    assert told[0, WRIST] > told[0, 0] > told[0, J["head"]]


def test_how_large_errors_last_is_told_to_every_node() -> None:
    told = [tell(*windows(), slow, patch=4).nodes[..., -1] for slow in (0.0, 0.001, 0.01, np.array([0.02, 0.02, 0.02]))]
    assert [float(t.max()) for t in told] == pytest.approx([np.log(0.2), np.log(0.2), 0.0, np.log(2.0)], abs=1e-6)
    assert all((t == t[0, 0]).all() for t in told)


def test_windows_come_in_whole_patches() -> None:
    with pytest.raises(ValueError, match="whole patches of 5, got 12"):
        CompletionNet(12, CompletionConfig(patch=5))


def test_without_a_network_the_guess_stays_and_there_is_nothing_to_train(tmp_path: Path) -> None:
    model = awake(replace(SMALL, completion=None))
    x, observed = torch.ones(1, 66, 12), torch.zeros(1, 66, 12)
    assert model.completed(x, observed, 0.0) is x
    with pytest.raises(ValueError, match="completion"):
        train_completion(model, Windows(None), Windows(None), tmp_path, 1, 0)  # type: ignore[arg-type]
