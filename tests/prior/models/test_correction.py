import numpy as np
import pytest
import torch
from tests.helpers.bodies import waving
from tests.helpers.values import gated

from steadypose.prior.body.kinematics import yaw_matrix
from steadypose.prior.body.skeleton import MIRROR, J
from steadypose.prior.clean.sensor_error import Correct
from steadypose.prior.clean.settings import CorrectSettings
from steadypose.prior.models.sensor_bias import FEATURES, HISTORY, CorrectionConfig, features, recall, trunk_frame
from steadypose.training.recipes.sensor_bias import CorrectionNet, mirror_features

CAMERA = np.array([-3.0, 0.5, 1.2])


def history(frames: int = 3) -> np.ndarray:
    positions = waving(frames + HISTORY[-1])
    return np.stack([positions[HISTORY[-1] - k : len(positions) - k] for k in HISTORY])


def test_features_do_not_change_when_the_room_is_turned_and_moved() -> None:
    turn, shift = yaw_matrix(0.8), np.array([1.0, -2.0, 0.3])
    a = features(history(), CAMERA)
    b = features(history() @ turn.T + shift, turn @ CAMERA + shift)
    assert a.shape == (3, FEATURES)
    assert np.allclose(a, b)


def test_a_mirrored_body_has_mirrored_features_and_mirroring_twice_is_nothing() -> None:
    flip = np.array([1.0, -1.0, 1.0])
    x = torch.from_numpy(features(history(), CAMERA))
    seen_in_a_mirror = features((history() * flip)[:, :, MIRROR], CAMERA * flip)
    assert torch.allclose(mirror_features(x), torch.from_numpy(seen_in_a_mirror))
    assert torch.equal(mirror_features(mirror_features(x)), x)


def test_the_trunk_frame_of_somebody_who_faces_x_is_the_identity_but_for_the_lean() -> None:
    frame = trunk_frame(waving(1))[0]
    assert np.allclose(frame.T @ frame, np.eye(3))
    assert frame[0, 0] > 0.9
    assert frame[1, 1] > 0.9


def test_a_missing_joint_reads_as_the_mean() -> None:
    net = CorrectionNet(CorrectionConfig(hidden=8)).eval()
    x = torch.from_numpy(features(history(), CAMERA)).float()
    net.mean.copy_(x[0])
    holed = x.clone()
    holed[:, 0:3] = torch.nan
    assert torch.isfinite(net(holed)).all()
    x[:, 0:3] = x[0, 0:3]
    assert torch.allclose(net(holed), net(x), atol=1e-6)


def test_a_young_body_is_remembered_as_it_was_first_seen() -> None:
    frames = np.full((HISTORY[-1] + 1, 2, 22, 3), np.nan)
    frames[-2:, 0] = [[[1.0]], [[2.0]]]
    frames[:, 1] = np.arange(HISTORY[-1] + 1)[:, None, None]
    recalled = recall(frames)
    assert recalled[:, 0, 0, 0].tolist() == [2.0, 1.0, 1.0, 1.0, 1.0, 1.0]
    assert recalled[:, 1, 0, 0].tolist() == [HISTORY[-1] - k for k in HISTORY]


def correct(positions: np.ndarray) -> np.ndarray:
    stage = Correct(CorrectSettings("kinect_v2"), 1)
    out = []
    for k, frame in enumerate(positions):
        out.append(stage.update(gated(frame[None], k / 30)).positions[0])
    return np.array(out)


def test_the_weights_that_ship_move_joints_by_centimetres_and_smoothly() -> None:
    positions = waving(60) + [2.5, 0, 0]
    moved = correct(positions) - positions
    size = np.linalg.norm(moved, axis=-1)[20:]
    assert 0.005 < np.median(size) < 0.08
    assert size.max() < 0.25
    assert np.abs(np.diff(moved[20:], axis=0)).max() < 0.02


def test_a_hidden_joint_stays_hidden_and_a_hidden_trunk_fades_the_correction() -> None:
    positions = waving(60) + [2.5, 0, 0]
    holed = positions.copy()
    holed[30:, J["left_wrist"]] = np.nan
    holed[40:, J["left_hip"]] = np.nan
    out = correct(holed)
    assert np.isnan(out[30:, J["left_wrist"]]).all()
    assert np.isfinite(out[:, J["head"]]).all()
    moved = np.linalg.norm(out - holed, axis=-1)[:, J["head"]]
    assert moved[59] == pytest.approx(moved[39] * 0.9**20, rel=0.01)
