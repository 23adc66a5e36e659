import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steadypose.msgs.recording import RecordingReader
from steadypose.msgs.types import JointState, PoseRaw, PoseWorld
from steadypose.nodes.cli import main
from steadypose.prior.body.kinematics import label_contacts
from steadypose.prior.body.skeleton import J
from steadypose.prior.sim.noise import KINECT_NOISE
from steadypose.prior.sim.streams import ManifestError, make, read_manifest, record
from steadypose.prior.timing.resample import PERIOD_NS

SIM_DATA = Path(__file__).parents[3] / "sim_data"
STREAMS = read_manifest(SIM_DATA / "manifest.json")
CAMERA = {"position": [0.0, 0.0, 1.4], "look_at": [2.5, 0.0, 1.0], "skeleton": "coco17"}
ENTRY = {"what": "a test", "script": "idle", "seed": 9, "seconds": 2.0, "camera": CAMERA}


def manifest(folder: Path, **streams: object) -> Path:
    path = folder / "manifest.json"
    path.write_text(json.dumps({"streams": streams}))
    return path


def test_a_stream_made_twice_is_the_same_bytes(tmp_path: Path) -> None:
    path = manifest(tmp_path, short=ENTRY)
    for folder in ("one", "two"):
        assert main(["simulate", str(tmp_path / folder), "--manifest", str(path)]) == 0
    files = sorted(p.relative_to(tmp_path / "one") for p in (tmp_path / "one").rglob("*.*"))
    assert len(files) == 2
    for file in files:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()


def test_truth_is_whole_and_consistent(tmp_path: Path) -> None:
    entry = {**ENTRY, "script": "walk_turn", "seconds": 5.0}
    (stream,) = read_manifest(manifest(tmp_path, short=entry)).values()
    raw, truth = make(stream)
    stamps = np.array([m.stamp_ns for m in truth])
    assert stamps[0] == raw[0].stamp_ns
    assert (np.diff(stamps) == PERIOD_NS).all()
    assert raw[-1].stamp_ns - stamps[-1] < PERIOD_NS
    positions = np.array([m.bodies[0].positions for m in truth])
    roots = np.array([m.bodies[0].root_position for m in truth])
    velocity = np.array([m.bodies[0].root_velocity for m in truth])
    np.testing.assert_allclose(positions[:, 0], roots, atol=1e-6)
    np.testing.assert_allclose(velocity[1:-1], np.gradient(roots, PERIOD_NS / 1e9, axis=0)[1:-1], atol=0.06)
    contacts = np.array([m.bodies[0].contacts for m in truth])
    assert (label_contacts(positions, 30.0) == contacts.astype(bool))[:, 2:6].mean() > 0.85
    facing = Rotation.from_quat(truth[0].bodies[0].root_orientation).apply([1.0, 0.0, 0.0])
    assert facing[0] < -0.9, "towards the camera"


def test_the_command_says_what_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = manifest(tmp_path, short=ENTRY)
    assert main(["simulate", str(tmp_path / "out"), "--stream", "long", "--manifest", str(path)]) == 2
    assert "no stream long; it has short" in capsys.readouterr().err
    assert main(["simulate", str(tmp_path / "out"), "--manifest", str(tmp_path / "none.json")]) == 2
    assert "cannot read" in capsys.readouterr().err
    (tmp_path / "out" / "short").mkdir(parents=True)
    assert main(["simulate", str(tmp_path / "out"), "--manifest", str(path)]) == 2
    assert "File exists" in capsys.readouterr().err


@pytest.mark.parametrize(("entry", "text"), [
    ({**ENTRY, "sead": 3}, "unknown keys"),
    ({k: v for k, v in ENTRY.items() if k != "seed"}, "expected a key 'seed'"),
    ({**ENTRY, "script": "dance"}, "no script 'dance'; there are walk_turn"),
    ({**ENTRY, "seconds": 0.5}, "expected seconds of 2.0 or more, got 0.5"),
    ({**ENTRY, "camera": {**CAMERA, "zoom": 2}}, "zoom"),
])  # fmt: skip
def test_a_wrong_manifest_is_refused_with_the_reason(tmp_path: Path, entry: dict[str, object], text: str) -> None:
    with pytest.raises(ManifestError, match=text):
        read_manifest(manifest(tmp_path, short=entry))


@pytest.mark.parametrize("name", STREAMS)
def test_a_bundled_stream_is_what_the_manifest_says(name: str) -> None:
    stream = STREAMS[name]
    with RecordingReader(SIM_DATA / name) as recording:
        assert recording.complete
        assert recording.topics == ("pose/raw", "pose/truth")
        assert 10 <= recording.duration_s <= 60
        raw = [m for _, _, m in recording.messages(["pose/raw"]) if isinstance(m, PoseRaw)]
        truth = [m for _, _, m in recording.messages(["pose/truth"]) if isinstance(m, PoseWorld)]
    assert {m.skeleton for m in raw} == {stream.camera.skeleton}
    assert {m.calibrated for m in raw} == {stream.camera.calibrated}
    assert {len(m.bodies) for m in truth} == {2 if name == "crossing" else 1}
    assert all(np.isfinite(b.positions).all() for m in truth for b in m.bodies)
    assert len(raw) / recording.duration_s == pytest.approx(stream.camera.fps, rel=0.06)
    if name in ("wave_hidden_arm", "crossing"):
        hidden = np.mean([b.state == JointState.IMPUTED for m in truth for b in m.bodies], axis=0)
        assert hidden[J["right_wrist"]] > 0.1


def test_a_bundled_stream_is_made_again(tmp_path: Path) -> None:
    """To the millimetre: the last bits may differ from one kind of machine to another."""
    record(STREAMS["idle"], tmp_path / "idle")
    with RecordingReader(SIM_DATA / "idle") as old, RecordingReader(tmp_path / "idle") as new:
        for (_, stamp, was), (_, again, made) in zip(old.messages(), new.messages(), strict=True):
            assert stamp == again
            if isinstance(was, PoseRaw) and isinstance(made, PoseRaw):
                difference = np.abs(was.bodies[0].positions - made.bodies[0].positions)
                assert np.nanmedian(difference) < 1e-3, f"made with other parameters than {KINECT_NOISE.name} has now"
