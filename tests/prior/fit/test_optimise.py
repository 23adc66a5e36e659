import numpy as np
import torch
from tests.helpers.bodies import waving

from steadypose.prior.body.kinematics import rotation_matrices, yaw_matrix
from steadypose.prior.body.skeleton import REST_OFFSETS, J
from steadypose.prior.complete.parts import PartsCompleter
from steadypose.prior.fit import optimise
from steadypose.prior.fit.hmvae_network import HMVAE
from steadypose.prior.fit.optimise import Optimiser
from steadypose.prior.fit.tensors import forward_kinematics, from_6d, heading, to_6d
from steadypose.prior.models.completer import LiveCompleter
from steadypose.prior.models.completer_features import CompleterConfig, solved_rotations
from steadypose.prior.models.hmvae import HMVAEConfig
from steadypose.training.recipes.completer import Completer
from steadypose.training.weights import arrays_of

WINDOW = 16


def make(monkeypatch) -> tuple[Optimiser, HMVAE, LiveCompleter]:
    monkeypatch.setattr(optimise, "LATENT_STEPS", 12)
    monkeypatch.setattr(optimise, "DECODER_STEPS", 6)
    torch.manual_seed(0)
    model = HMVAE(HMVAEConfig(window=WINDOW, kernel=3, strides=(1, 2, 2, 1), about_mean=True))
    completer = LiveCompleter(config := CompleterConfig(width=16, heads=2, layers=1), arrays_of(Completer(config)))
    return Optimiser(model, PartsCompleter(completer)), model, completer


def test_what_is_known_is_met_and_the_model_is_left_as_it_was(monkeypatch) -> None:
    optimiser, model, completer = make(monkeypatch)
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    for frames in (10, WINDOW, 27):  # shorter than a window, one, and two that overlap
        positions = waving(frames)
        positions[3:8] = np.nan
        positions[:, J["left_wrist"]] = np.nan
        rotations, root = optimiser(positions[None], REST_OFFSETS[None])
        solved, known = solved_rotations(positions, REST_OFFSETS, rotation_matrices(completer.usual))
        assert np.allclose(rotations[0][known], solved[known], atol=1e-6)
        assert np.allclose(rotations @ rotations.swapaxes(-1, -2), np.eye(3), atol=1e-9)
        assert np.isfinite(root).all()
    assert all(torch.equal(before[name], tensor) for name, tensor in model.state_dict().items())
    assert all(p.requires_grad for p in model.parameters())


def test_the_best_that_was_tried_is_kept(monkeypatch) -> None:
    optimiser, _, _ = make(monkeypatch)
    losses = []
    original = optimise._Known.loss

    def watched(self, decoded):
        losses.append(float(original(self, decoded.detach())))
        return original(self, decoded)

    monkeypatch.setattr(optimise._Known, "loss", watched)
    monkeypatch.setattr(optimise, "DECODER_RATE", 1.0)  # so fast that the last is not the best
    x = to_6d(torch.from_numpy(np.tile(np.eye(3), (1, WINDOW, 22, 1, 1))).float())
    seen = optimise._Known(
        x, torch.ones(1, WINDOW, 22, 1), torch.zeros(1, WINDOW, 22, 3), torch.zeros(1, WINDOW, 22, 1),
        torch.from_numpy(REST_OFFSETS).float(),
    )  # fmt: skip
    best = optimiser._search(x, seen, np.zeros(1, np.int64), torch.eye(3)[None])
    assert float(original(seen, best)) == min(losses[:13])
    assert losses[-1] > min(losses) < losses[0]


def test_who_is_still_before_and_after_a_gap_is_still_in_it(monkeypatch) -> None:
    """Though the model, all of whose weights are 0, decodes another pose: the way to the known ones goes over time."""
    optimiser, model, _ = make(monkeypatch)
    monkeypatch.setattr(optimise, "LATENT_STEPS", 1)
    monkeypatch.setattr(optimise, "DECODER_STEPS", 0)
    with torch.no_grad():
        for p in model.parameters():
            p.zero_()
    positions = np.tile(waving(1), (WINDOW, 1, 1))
    positions[6:9] = np.nan
    rotations, _ = optimiser(positions[None], REST_OFFSETS[None])
    np.testing.assert_allclose(rotations[0, 6:9], np.tile(rotations[0, :1], (3, 1, 1, 1)), atol=1e-6)


def test_joints_and_rotations_to_meet_are_of_one_pose_from_the_root_without_heading(monkeypatch) -> None:
    optimiser, _, _ = make(monkeypatch)
    given = []

    def kept(self, begun, seen, starts, back):
        given.append((seen, starts, back))
        return begun

    monkeypatch.setattr(Optimiser, "_search", kept)
    turned = waving(27) @ yaw_matrix(1.0).T + [3.0, 2.0, 0.0]
    optimiser(turned[None], REST_OFFSETS[None])
    ((seen, starts, back),) = given
    assert starts.tolist() == [0, 11]
    assert seen.rotations.all()
    assert seen.places.all()
    joints, _ = forward_kinematics(from_6d(seen.columns), seen.offsets)
    torch.testing.assert_close(joints, seen.joints, atol=8e-3, rtol=0)
    rows = starts[:, None] + np.arange(WINDOW)
    placed = seen.joints @ back.mT[:, None]
    np.testing.assert_allclose(placed.numpy(), (turned - turned[:, :1])[rows], atol=1e-5)
    assert heading(from_6d(seen.columns)[:, WINDOW // 2 - 1, 0]).abs().max() < 1e-5


def test_the_weights_that_ship_are_of_this_network(monkeypatch) -> None:
    assert isinstance(Optimiser.load("default", PartsCompleter(make(monkeypatch)[2])), Optimiser)
