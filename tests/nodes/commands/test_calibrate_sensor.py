from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.helpers.bodies import waving

from steadypose.nodes.cli import USAGE_ERROR, main
from steadypose.prior.body.skeleton import J
from steadypose.prior.models.sensor_bias import trunk_frame

pytestmark = pytest.mark.slow

FRAMES = 240
BIAS = np.zeros((22, 3))
BIAS[[J["left_wrist"], J["right_wrist"], J["head"]]] = [0.08, 0.0, 0.03]
"""metres in the trunk's frame, what the sensor adds"""


def write(folder: Path, person: str, scale: float, seed: int) -> tuple[Path, Path]:
    """A person as the sensor and the reference have them: at other rates, in other frames, from another moment on."""
    rng = np.random.default_rng(seed)
    truth = waving(FRAMES) * scale
    observed = truth + BIAS @ trunk_frame(truth).swapaxes(-1, -2) + rng.normal(0.0, 0.003, truth.shape)
    stamps = 10**18 + np.round(np.arange(FRAMES) * 1e9 / 30).astype(np.int64)
    turned = truth @ Rotation.from_euler("z", 40.0, degrees=True).as_matrix().T + [3.0, -1.0, 0.2]
    for name in ("sensor", "reference"):
        (folder / name / person).mkdir(parents=True)
    paths = folder / "sensor" / person / "a.npz", folder / "reference" / person / "a.npz"
    np.savez(paths[0], positions=observed, stamp_ns=stamps, skeleton="smpl22")
    np.savez(paths[1], positions=turned[6:], stamp_ns=stamps[6:], skeleton="smpl22")
    return paths


def test_the_bias_is_learned_and_helps_somebody_else(tmp_path: Path, capsys) -> None:
    for seed, (person, scale) in enumerate((("ann", 1.0), ("bob", 0.93), ("cid", 1.06))):
        write(tmp_path, person, scale, seed)
    folders = [str(tmp_path / name) for name in ("sensor", "reference")]
    steps = ["--iterations", "120", "--name", "mine", "--out", str(tmp_path)]
    assert main(["calibrate", "sensor", *folders, *steps]) == 0
    out = capsys.readouterr().out
    assert "3 recordings of 3 people" in out
    assert [line.split()[1] for line in out.splitlines() if line.startswith("  without")] == ["ann:", "bob:", "cid:"]
    (mean,) = (line for line in out.splitlines() if line.startswith("mean of 3 people left out"))
    before, after = (float(mean.split(word)[1].split()[0]) for word in ("out: ", "corrected "))
    assert before > 8.0
    assert after < 0.7 * before
    weights = tmp_path / "correction-mine.safetensors"
    assert f"prior.correct.sensor={weights}" in out
    assert "3 recordings of 3 people beside a reference" in weights.with_suffix(".md").read_text()
    source, truth = tmp_path / "sensor/bob/a.npz", waving(FRAMES) * 0.93
    wrist = J["left_wrist"]
    off = {}
    for name, options in (("plain", []), ("corrected", ["--set", f"correct.sensor={weights}"])):
        assert main(["clean", str(source), str(tmp_path / f"{name}.npz"), *options]) == 0
        with np.load(tmp_path / f"{name}.npz") as cleaned:
            off[name] = np.linalg.norm(cleaned["positions"][60:, wrist] - truth[60:, wrist], axis=-1).mean()
    assert off["corrected"] < 0.6 * off["plain"]


@pytest.mark.parametrize(("change", "match"), [
    ({"stamp_ns": 10**18 + 10**12 + np.arange(FRAMES) * 33_333_333}, "got no time in common"),
    ({"positions": np.full((FRAMES, 22, 3), np.nan)}, "expected a person in two frames or more"),
    ({"positions": np.ones((FRAMES, 2, 22, 3))}, "expected one person, got 2"),
    ({"positions": waving(100), "stamp_ns": 10**18 + np.arange(100) * 33_333_333}, "expected 10 s or more"),
    ({"positions": 1000 * waving(FRAMES)}, "are both in metres"),
    ({"positions": waving(FRAMES)[:, ::-1]}, "in the order of their skeleton"),
    ({"stamp_ns": 10**18 + (np.arange(FRAMES) + 12) * 33_333_333}, "the reference fits best 0.40 s earlier"),
])  # fmt: skip
def test_recordings_that_do_not_go_together_are_refused(change: dict, match: str, tmp_path: Path, capsys) -> None:
    sensor, reference = write(tmp_path, "ann", 1.0, 0)
    good = {"positions": waving(FRAMES), "stamp_ns": 10**18 + np.arange(FRAMES) * 33_333_333, "skeleton": "smpl22"}
    np.savez(reference, **(good | change))
    assert main(["calibrate", "sensor", str(sensor), str(reference), "--out", str(tmp_path)]) == USAGE_ERROR
    assert match in capsys.readouterr().err


def test_a_reference_that_is_missing_or_has_none_of_the_sensors_joints_is_refused(tmp_path: Path, capsys) -> None:
    sensor, reference = write(tmp_path, "ann", 1.0, 0)
    for path, seen in ((sensor, np.arange(22) < 20), (reference, np.arange(22) >= 20)):
        np.savez(path, positions=np.where(seen[:, None], waving(FRAMES), np.nan), skeleton="smpl22", fps=30.0)
    assert main(["calibrate", "sensor", str(sensor), str(reference), "--out", str(tmp_path)]) == USAGE_ERROR
    assert "got inf m" in capsys.readouterr().err
    reference.unlink()
    folders = [str(tmp_path / name) for name in ("sensor", "reference")]
    assert main(["calibrate", "sensor", *folders, "--out", str(tmp_path)]) == USAGE_ERROR
    assert "ann/a.npz there is none" in capsys.readouterr().err


def test_recordings_go_with_files_of_their_name_and_a_person_is_the_folder_above(tmp_path: Path, capsys) -> None:
    for seed, take in enumerate(("walk", "sit")):
        sensor, reference = write(tmp_path, f"ann/{take}", 1.0, seed)
        reference.rename(reference.parents[1] / f"{take}.npz")
        assert main(["clean", str(sensor), str(sensor.parents[1] / f"{take}_")]) == 0
        sensor.unlink()
        sensor.parent.rmdir()
        (sensor.parents[1] / f"{take}_").rename(sensor.parent)
    folders = [str(tmp_path / name) for name in ("sensor", "reference")]
    assert main(["calibrate", "sensor", *folders, "--iterations", "1", "--out", str(tmp_path)]) == 0
    assert "2 recordings of 1 person" in capsys.readouterr().out
