"""Weights of a training are installed only when asked, and those they replace are kept."""

from pathlib import Path

import pytest
import torch

from steadypose.nodes.commands import train as command
from steadypose.nodes.graph.settings import LaunchError
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


def test_training_leaves_the_weights_that_ship_alone(shipped: Path, tmp_path: Path) -> None:
    command.train("hmvae", runs=tmp_path / "runs", iterations=1)
    assert (shipped / "hmvae-default.safetensors").read_text() == "shipped"
    assert (tmp_path / "runs/hmvae-default/hmvae-default.md").is_file()
    assert not (shipped / "previous").exists()


def test_installed_weights_replace_the_old_which_are_kept(shipped: Path, tmp_path: Path, capsys) -> None:
    command.train("hmvae", runs=tmp_path / "runs", iterations=1, install=True)
    made = tmp_path / "runs/hmvae-default/hmvae-default.safetensors"
    assert (shipped / made.name).read_bytes() == made.read_bytes()
    kept = sorted(file.name for file in (shipped / "previous").iterdir())
    assert kept == ["hmvae-default.faults.safetensors", "hmvae-default.md", "hmvae-default.safetensors"]
    assert not (shipped / "hmvae-default.faults.safetensors").exists()  # belonged to the old
    assert (shipped / "hmvae-research.safetensors").read_text() == "another set"
    assert str(shipped / made.name) in capsys.readouterr().out


def test_options_that_cannot_be_used_are_refused_by_name() -> None:
    with pytest.raises(LaunchError, match="--iterations: expected 1 or more, got 0"):
        command.train("correction", iterations=0)
    with pytest.raises(LaunchError, match="--start: a correction"):
        command.train("correction", start="default")
