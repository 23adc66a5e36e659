from pathlib import Path

import numpy as np
import pytest
from tests.training.data.test_motion_plug_in_gait import BENDS, HIP, STILL, recording

from steadypose.prior.body.layouts import KINECT22
from steadypose.prior.body.skeleton import JOINTS, J
from steadypose.prior.mocap.clip import MotionError
from steadypose.training.data.readers import load_pairs

MARKERS = recording(BENDS, STILL, np.zeros(3))


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    names = sorted(MARKERS)
    markers = np.stack([MARKERS[n] for n in names], axis=1)
    counts = np.round(markers * 1e4).astype(np.int16)
    counts[5, names.index("LWRA")] = -32768
    kinect = np.zeros((len(counts), 22, 3), dtype=np.int16)
    kinect[:, KINECT22.joints.index("Waist")] = [1000, 9000, -25000]  # y up, 2.5 m in front, looking along -z
    arrays = {}
    for name in ("m02_s01_e01", "m01_s01_e01_inc", "m01_s07_e01"):
        arrays[f"{name}/kinect"], arrays[f"{name}/vicon_markers"] = kinect, counts
    path = tmp_path / "ui_prmd.npz"
    np.savez(path, fps=30.0, vicon_names=np.array(names), kinect_names=np.array(KINECT22.joints), **arrays)
    return path


def test_pairs_are_metric_z_up_and_in_order(archive: Path) -> None:
    pairs = load_pairs(archive, ["s07", "s01"])
    assert [p.name for p in pairs] == ["m01_s01_e01_inc", "m02_s01_e01", "m01_s07_e01"]
    pair = pairs[1]
    assert (pair.subject, pair.movement, pair.fps) == ("s01", "m02", 30.0)
    np.testing.assert_allclose(pair.kinect[0, KINECT22.joints.index("Waist")], [0.1, 2.5, 0.9])
    np.testing.assert_allclose(pair.vicon[0, J["left_hip"]], HIP, atol=2e-4)
    lost = np.argwhere(np.isnan(pair.vicon).any(axis=-1))
    assert [(int(t), JOINTS[j]) for t, j in lost] == [(5, "left_wrist")]


def test_only_the_subjects_asked_for_are_read_and_another_npz_is_refused(archive: Path) -> None:
    assert {p.subject for p in load_pairs(archive, ["s07"])} == {"s07"}
    with pytest.raises(MotionError, match="no recordings of s09"):
        load_pairs(archive, ["s07", "s09"])
    np.savez(archive, a=1)
    with pytest.raises(MotionError, match="vicon_names"):
        load_pairs(archive, ["s01"])
