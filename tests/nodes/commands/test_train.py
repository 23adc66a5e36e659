from pathlib import Path

import numpy as np
import pytest
import torch

from steadypose.nodes.cli import main
from steadypose.nodes.commands import train as command
from steadypose.nodes.settings import LaunchError
from steadypose.training import weights as training_weights
from steadypose.training.loop import TrainingOptions


@pytest.fixture
def shipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of weights that ship, and a training that makes others of the same name."""
    folder = tmp_path / "weights"
    folder.mkdir()
    for suffix in ("safetensors", "md", "faults.safetensors"):
        (folder / f"hmvae-default.{suffix}").write_text("shipped")
    (folder / "hmvae-research.safetensors").write_text("another set")

    def train_hmvae(options: TrainingOptions) -> Path:
        path = options.path("hmvae")
        training_weights.save_weights(path, torch.nn.Linear(2, 1), {}, {"Model": "small"})
        return path

    monkeypatch.setattr("steadypose.prior.models.weights.WEIGHTS", folder)
    monkeypatch.setattr("steadypose.training.recipes.hmvae.train_hmvae", train_hmvae)
    return folder


def test_only_installed_weights_replace_those_that_ship_which_are_kept(shipped: Path, tmp_path: Path, capsys) -> None:
    command.train("hmvae", runs=tmp_path / "runs", iterations=1)
    assert (shipped / "hmvae-default.safetensors").read_text() == "shipped"
    assert (tmp_path / "runs/hmvae-default/hmvae-default.md").is_file()
    assert not (shipped / "previous").exists()
    command.train("hmvae", runs=tmp_path / "runs", iterations=1, install=True)
    made = tmp_path / "runs/hmvae-default/hmvae-default.safetensors"
    assert (shipped / made.name).read_bytes() == made.read_bytes()
    kept = sorted(file.name for file in (shipped / "previous").iterdir())
    assert kept == ["hmvae-default.faults.safetensors", "hmvae-default.md", "hmvae-default.safetensors"]
    assert not (shipped / "hmvae-default.faults.safetensors").exists()  # belonged to the old
    assert (shipped / "hmvae-research.safetensors").read_text() == "another set"
    assert str(shipped / made.name) in capsys.readouterr().out


def test_weights_that_cannot_be_installed_leave_the_old_ones(shipped: Path, tmp_path: Path) -> None:
    made = tmp_path / "hmvae-default.safetensors"
    made.write_text("new")
    (shipped / "hmvae-default.safetensors.part").mkdir()  # where the new file would be written
    with pytest.raises(IsADirectoryError):
        training_weights.install(made)
    assert {(shipped / f"hmvae-default.{end}").read_text() for end in ("safetensors", "md")} == {"shipped"}


def test_options_that_cannot_be_used_are_refused_by_name() -> None:
    with pytest.raises(LaunchError, match="--iterations: expected 1 or more, got 0"):
        command.train("correction", iterations=0)
    with pytest.raises(LaunchError, match="--start: a correction"):
        command.train("correction", start="default")
    with pytest.raises(LaunchError, match="--seed: expected 0 or more, got -1"):
        command.train("contacts", seed=-1)


def test_what_is_not_there_is_said_before_anything_is_prepared(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no weights 'mine' for hgvae: expected hgvae-mine\.safetensors"):
        command.train("completion", tmp_path, start="mine")
    with pytest.raises(LaunchError, match="--data: expected the folder of the recordings to train mixture on, got"):
        command.train("mixture", tmp_path / "prepared.npz")


def prepared(path: Path, *minutes: float, sets: tuple[str, ...] = ("default", "research")) -> Path:
    """A clip of so many minutes for each set, beside one to validate on."""
    frames = [*(round(1800 * m) for m in minutes), 100_000]
    split = [*("train" for _ in minutes), "val"]
    start = np.concatenate([[0], np.cumsum(frames)])
    np.savez(path, clip_start=start, split=np.array(split), set=np.array([*sets[: len(minutes)], "default"]))
    return path


def test_little_and_next_to_nothing_are_refused_before_training(shipped: Path, tmp_path: Path, monkeypatch, capsys):
    np.savez(tmp_path / "other.npz", joints=np.zeros(3))
    for enough in (prepared(tmp_path / "a.npz", 31.0), tmp_path / "other.npz", tmp_path):
        assert command.little_data(enough, "default") == ""
    path = prepared(tmp_path / "b.npz", 0.2, 12.0)
    printed = command.little_data(path, "research")
    assert "has 12.2 minutes of motion to train the 'research' weights on, which is little" in printed
    assert "or fine-tune with --start default" in printed
    assert command.little_data(path, "research", "default").endswith("expected 30; prepare more recordings")
    monkeypatch.setattr("steadypose.training.recipes.hmvae.train_hmvae", lambda options: pytest.fail("it was trained"))
    assert main(["train", "hmvae", "--data", str(path), "--runs", str(tmp_path / "runs")]) == 2
    printed = " ".join(capsys.readouterr().err.split())
    assert "has 0.2 minutes of motion to train the 'default' weights on: expected at least 0.5" in printed
    assert printed.endswith("; prepare more recordings")
    assert not (tmp_path / "runs").exists()
