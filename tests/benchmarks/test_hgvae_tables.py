import numpy as np
import pytest
import torch
from tests.helpers.bodies import waving

from steadypose.benchmarks.studies import hgvae_imputation as imputation
from steadypose.benchmarks.studies import hgvae_models as models
from steadypose.benchmarks.studies.hgvae_faults import BEGINS, FAULTS, MIN_MOTION
from steadypose.prior.body.skeleton import MIRROR, REST_OFFSETS, J
from steadypose.prior.models.hgvae.features import in_frame_of, to_tracks
from steadypose.training.data.dataset import MotionSet
from steadypose.training.data.hgvae_windows import Windows, mean_tracks, standardise
from steadypose.training.networks.hgvae import HGVAE


def windows_of(*actions: str) -> MotionSet:
    count = len(actions)
    positions = np.concatenate([waving(80, speed=1 + 0.3 * k) for k in range(count)])
    return MotionSet(
        rotations=torch.eye(3).expand(80 * count, 22, 3, 3),
        positions=torch.from_numpy(positions).float(),
        offsets=torch.from_numpy(np.tile(REST_OFFSETS, (80 * count, 1, 1))).float(),
        contacts=torch.zeros(80 * count, 8, dtype=torch.bool),
        clip_start=np.arange(count + 1) * 80,
        subject=np.array(["somebody"] * count),
        action=np.array(actions),
    )


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_changes_windows_and_leaves_the_clean_ones_alone(name: str) -> None:
    clean = np.stack([waving(50, speed=s) for s in (1.0, 1.5, 2.0)])
    kept = clean.copy()
    spoilt, holds = FAULTS[name](clean, np.random.default_rng(0))
    np.testing.assert_array_equal(clean, kept)
    assert holds.any()
    assert all(np.abs(spoilt[k] - clean[k]).max() > 0 for k in np.flatnonzero(holds))


def test_a_joint_counts_as_frozen_only_where_it_would_have_moved() -> None:
    still = np.repeat(waving(1)[None], 50, axis=1)
    spoilt, holds = FAULTS["a joint frozen"](
        np.concatenate([still, waving(50, speed=3)[None]]), np.random.default_rng(0)
    )
    assert holds.tolist() == [False, True]
    stopped = np.ptp(spoilt[1, BEGINS - 1 :], axis=0).max(axis=-1) == 0
    assert stopped.sum() == 1
    assert np.linalg.norm(spoilt[1] - waving(50, speed=3), axis=-1)[:, stopped].max() > MIN_MOTION


def test_left_for_right_is_the_other_sides_joint() -> None:
    clean = waving(50)[None]
    spoilt, _ = FAULTS["left taken for right"](clean, np.random.default_rng(0))
    np.testing.assert_array_equal(spoilt[0, :, J["left_wrist"]], clean[0, :, MIRROR[J["left_wrist"]]])


def test_every_method_gives_back_what_was_seen_and_peers_are_what_they_are_called() -> None:
    torch.manual_seed(0)
    model = HGVAE(models.of_depth(2)).eval().requires_grad_(requires_grad=False)
    windows = Windows(windows_of("a"))
    model.mean.copy_(mean_tracks(windows, 50, count=4))
    positions, sizes = windows.draw(2, 50, np.random.default_rng(0))
    masks = np.zeros((2, 66, 50), dtype=bool)
    masks[:, 60, 10:20] = True
    masks[:, 63] = True
    found = imputation.impute_all(model, positions, sizes, masks, (2,))
    truth = found["mean"][1]
    for x, _ in found.values():
        np.testing.assert_allclose(x[~masks], truth[~masks])
        assert np.isfinite(x).all()
    assert (found["hold"][0][0, 60, 10:20] == truth[0, 60, 9]).all()
    assert found["line"][0][0, 60, 14] == pytest.approx(truth[0, 60, 9] + 5 / 11 * (truth[0, 60, 20] - truth[0, 60, 9]))
    assert found["mean"][0][0, 63, 0] == pytest.approx(float(model.mean[63]))


def test_only_what_is_hidden_counts_as_an_error_of_whole_joints() -> None:
    torch.manual_seed(0)
    model = HGVAE(models.of_depth(1)).eval()
    windows = Windows(windows_of("a"))
    model.mean.copy_(mean_tracks(windows, 50, count=4))
    positions, sizes = windows.draw(2, 50, np.random.default_rng(0))
    hidden = np.zeros((2, 22), dtype=bool)
    hidden[1, J["left_wrist"]] = True
    found = imputation.whole_joints(model, positions, sizes, hidden)
    assert set(found) == {"mean", "guess", "completion", "HG-VAE"}
    assert all(errors[0] == 0 for errors in found.values())
    # without a completion network, the guess: the wrist hangs from the elbow as it does in the mean body
    assert found["completion"][1] == found["guess"][1]
    seen = np.where(hidden[:, None, :, None], np.nan, positions)[1]
    tracks = to_tracks(seen, float(sizes[1]))
    true = in_frame_of(tracks, positions[1], float(sizes[1])) - model.mean.double().numpy()[:, None]
    wrist, elbow = (slice(3 * J[n], 3 * J[n] + 3) for n in ("left_wrist", "left_elbow"))
    assert found["mean"][1] == pytest.approx(1e6 * (true[wrist] ** 2).sum(), rel=1e-4)
    assert found["guess"][1] == pytest.approx(1e6 * ((true[wrist] - true[elbow]) ** 2).sum(), rel=1e-4)


def test_the_papers_ascent_never_ends_lower_than_it_began() -> None:
    torch.manual_seed(0)
    model = HGVAE(models.with_actions(0)).eval()
    x = np.random.default_rng(0).normal(scale=0.2, size=(3, 66, 50))
    observed = np.random.default_rng(1).random(x.shape) < 0.8

    def score(tracks: np.ndarray) -> torch.Tensor:
        at = standardise(model, tracks)
        return model(at, torch.ones_like(at)).log_prior.sum(dim=1)

    climbed = imputation.ascend_entries(model, x, observed, 3)
    assert (score(climbed) >= score(x) - 1e-2).all()
    np.testing.assert_allclose(climbed[observed], x[observed], atol=1e-6)


def test_all_depths_have_the_same_parameters() -> None:
    counts = {sum(p.numel() for p in HGVAE(models.of_depth(d)).parameters()) for d in models.DEPTHS}
    assert len(counts) == 1


def test_actions_are_drawn_from_their_own_clips_and_named_without_style() -> None:
    names = {"walk-turn-left active": "walk-turn-left", "idle, tired": "idle", "walking_12": "walking", "": ""}
    assert {name: models.action_name(name) for name in names} == names
    windows = models.ActionWindows(windows_of("run active", "walk", "run sad"), ["run", "walk"])
    positions, sizes, actions = windows.draw_actions(20, 30, np.random.default_rng(0))
    assert positions.shape == (20, 30, 22, 3)
    assert (sizes > 0).all()
    assert set(actions) == {0, 1}


def test_training_for_a_table_resumes(tmp_path) -> None:
    windows = models.ActionWindows(windows_of("run", "walk"), ["run", "walk"])
    config = models.with_actions(2)
    first = models.train(config, windows, tmp_path, steps=2, batch=4)
    again = models.train(config, windows, tmp_path, steps=2, batch=4)
    assert all(torch.equal(a, b) for a, b in zip(first.state_dict().values(), again.state_dict().values(), strict=True))


def test_top_latents_are_drawn_where_windows_of_the_action_are() -> None:
    rng = np.random.default_rng(0)
    actions = np.repeat([0, 1], 200)
    top = np.where(actions[:, None] == 1, 5.0, -5.0) + 0.1 * rng.normal(size=(400, 3))
    drawn = models.draw_tops(top, actions, np.array([1, 0, 1]), seed=0)
    assert (drawn.sign() == torch.tensor([[1.0], [-1.0], [1.0]])).all()
    assert (drawn.abs() - 5).abs().max() < 0.6


def test_a_predictors_future_stands_in_the_frame_of_its_past() -> None:
    torch.manual_seed(0)
    model = HGVAE(models.with_actions(0))
    windows = Windows(windows_of("a"))
    x, future, past, _ = imputation.predictor_pair(windows, 50, 4, np.random.default_rng(0), model)
    assert past.shape == (4, 50, 22, 3)
    step = (future[..., 0] - x[..., -1]).abs().max() * 0.2
    assert step < 0.1  # a frame later nobody has gone far
    assert torch.isfinite(imputation.train_predictor(windows, 50, 2, model)(x)).all()
