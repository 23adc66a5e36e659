import numpy as np
import pytest
import torch
from tests.helpers.bodies import waving

from steadypose.benchmarks.corruption import BEGINS, FAULTS, FAULTS_IN_DEPTH, MIN_MOTION
from steadypose.benchmarks.studies import hgvae_imputation as imputation
from steadypose.prior.body.skeleton import MIRROR, REST_OFFSETS, J
from steadypose.prior.models.hgvae.config import JOINT_NODES, HGVAEConfig, Level
from steadypose.prior.models.hgvae.features import in_frame_of, to_tracks
from steadypose.training.data.dataset import MotionSet
from steadypose.training.data.hgvae_windows import Windows, mean_tracks, standardise
from steadypose.training.networks.hgvae import HGVAE

SMALL = HGVAEConfig(features=16, levels=(Level(1, 8), Level(JOINT_NODES, 2)))


def windows() -> Windows:
    """Of somebody who waves, 80 frames."""
    positions, offsets = torch.from_numpy(waving(80)).float(), torch.from_numpy(REST_OFFSETS).float()
    whole = torch.eye(3).expand(80, 22, 3, 3), positions, offsets.expand(80, 22, 3), torch.zeros(80, 8)
    return Windows(MotionSet(*whole, np.array([0, 80])))


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_changes_windows_and_leaves_the_clean_ones_alone(name: str) -> None:
    clean = np.stack([waving(50, speed=s) for s in (1.0, 1.5, 2.0)])
    kept = clean.copy()
    corrupted, holds = FAULTS[name](clean, np.random.default_rng(0))
    np.testing.assert_array_equal(clean, kept)
    assert holds.any()
    assert all(np.abs(corrupted[k] - clean[k]).max() > 0 for k in np.flatnonzero(holds))


def test_a_joint_counts_as_frozen_only_where_it_would_have_moved_and_left_for_right_is_the_other_sides() -> None:
    still = np.repeat(waving(1)[None], 50, axis=1)
    both = np.concatenate([still, waving(50, speed=3)[None]])
    corrupted, holds = FAULTS["a joint frozen"](both, np.random.default_rng(0))
    assert holds.tolist() == [False, True]
    stopped = np.ptp(corrupted[1, BEGINS - 1 :], axis=0).max(axis=-1) == 0
    assert stopped.sum() == 1
    assert np.linalg.norm(corrupted[1] - waving(50, speed=3), axis=-1)[:, stopped].max() > MIN_MOTION
    clean = waving(50)[None]
    corrupted, _ = FAULTS["left taken for right"](clean, np.random.default_rng(0))
    np.testing.assert_array_equal(corrupted[0, :, J["left_wrist"]], clean[0, :, MIRROR[J["left_wrist"]]])


def test_a_limb_mirrored_in_depth_keeps_its_bones_and_its_direction_from_the_camera_before_it() -> None:
    clean = np.stack([waving(50), waving(50, speed=2.0)]) + [7.0, 8.0, 0.0]
    corrupted, holds = FAULTS_IN_DEPTH["leg mirrored in depth"](clean, np.random.default_rng(0))
    placed, _ = FAULTS_IN_DEPTH["leg mirrored in depth"](clean[:, :BEGINS], np.random.default_rng(0))
    np.testing.assert_array_equal(corrupted[:, :BEGINS], placed)
    np.testing.assert_allclose(corrupted[:, 0, 0], [[3.0, 0.0, 0.0]] * 2, atol=1e-12)
    hip, knee = (corrupted[:, BEGINS:, J[f"left_{joint}"]] for joint in ("hip", "knee"))
    bone, moved = knee - hip, (clean[:, BEGINS:, J["left_knee"]] - clean[:, BEGINS:, J["left_hip"]])
    np.testing.assert_allclose(np.linalg.norm(bone, axis=-1), np.linalg.norm(moved, axis=-1))
    np.testing.assert_allclose((bone * hip).sum(axis=-1), -(moved * hip).sum(axis=-1))
    np.testing.assert_allclose(np.cross(bone - moved, hip), 0.0, atol=1e-12)
    assert holds.all()


@pytest.fixture
def model() -> HGVAE:
    torch.manual_seed(0)
    model = HGVAE(SMALL).eval().requires_grad_(requires_grad=False)
    model.mean.copy_(mean_tracks(windows(), 50, count=4))
    return model


def test_every_method_gives_back_what_was_seen_and_peers_are_what_they_are_called(model: HGVAE) -> None:
    positions, sizes = windows().draw(2, 50, np.random.default_rng(0))
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


def test_only_what_is_hidden_counts_as_an_error_of_whole_joints(model: HGVAE) -> None:
    positions, sizes = windows().draw(2, 50, np.random.default_rng(0))
    hidden = np.zeros((2, 22), dtype=bool)
    hidden[1, J["left_wrist"]] = True
    found = imputation.impute_whole_joints(model, positions, sizes, hidden)
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


def test_the_papers_ascent_never_ends_lower_than_it_began(model: HGVAE) -> None:
    x = np.random.default_rng(0).normal(scale=0.2, size=(3, 66, 50))
    observed = np.random.default_rng(1).random(x.shape) < 0.8

    def score(tracks: np.ndarray) -> torch.Tensor:
        at = standardise(model, tracks)
        return model(at, torch.ones_like(at)).log_prior.sum(dim=1)

    climbed = imputation.ascend_entries(model, x, observed, 3)
    assert (score(climbed) >= score(x) - 1e-2).all()
    np.testing.assert_allclose(climbed[observed], x[observed], atol=1e-6)
