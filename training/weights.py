"""Writes trained weights with a card of their provenance, and installs them where nodes look for them."""

import json
import os
import platform
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors.torch import save
from torch import nn

from steadypose.prior.fit.tensors import load_tensors
from steadypose.prior.models import weights as weights_io
from steadypose.prior.models.weights import Arrays, WeightsError
from steadypose.training.data.prepare import whole
from steadypose.training.distributed import writes


def save_weights(path: Path, model: nn.Module, config: Mapping[str, Any], card: Mapping[str, Any]) -> None:
    """Write weights (``.safetensors``), in half precision, with the configuration as JSON and a card, in the first
    process of torchrun.

    ``card`` is content by heading: data, licence, seed, training command, results; it is written beside as ``.md``.
    """
    if not writes():
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    tensors = {name: tensor.detach().half().contiguous() for name, tensor in model.state_dict().items()}
    with whole(path) as file:
        file.write(save(tensors, metadata={"config": json.dumps(dict(config), sort_keys=True)}))
    write_card(path, card)


def write_card(path: Path, card: Mapping[str, Any]) -> None:
    """Write the card (heading to content) of the weights ``path`` beside them, with commit and machine."""
    entries = {**card, "Commit": _commit(), "Made on": f"{platform.machine()}, torch on CPU"}
    lines = [f"# {path.stem}", "", *(f"- **{heading}**: {content}" for heading, content in entries.items()), ""]
    with whole(path.with_suffix(".md")) as file:
        file.write("\n".join(lines).encode())


def install(path: Path) -> Path:
    """Copy the weights ``MODEL-SET.safetensors`` of a training run, and the files that belong to them, to the folder
    where nodes look for a weight set; returns their new path.

    Replaced files are moved to the folder ``previous`` there, and back if the new ones cannot be written (OSError).
    """
    folder = weights_io.WEIGHTS
    (folder / "previous").mkdir(parents=True, exist_ok=True)
    replaced = _belonging(folder / path.name)
    for old in replaced:
        os.replace(old, folder / "previous" / old.name)
    try:
        for new in _belonging(path):
            with whole(folder / new.name) as file:
                file.write(new.read_bytes())
    except OSError:
        for old in replaced:
            os.replace(folder / "previous" / old.name, old)
        raise
    return folder / path.name


def arrays_of(network: nn.Module) -> Arrays:
    return {name: tensor.detach().float().numpy().copy() for name, tensor in network.state_dict().items()}


def started(model: nn.Module, name: str, start: str | None) -> str:
    """Load the weights ``start`` of the model ``name``, if given, into ``model``; returns the note for the card.

    Raises:
        FileNotFoundError: there are no such weights.
        WeightsError: the weights belong to another model or size.
    """
    if start is None:
        return ""
    try:
        model.load_state_dict(load_tensors(start, name)[0])
    except RuntimeError as error:
        raise WeightsError(f"start: expected weights of {name}, of this size, got '{start}': {error}") from error
    return f", started from the weights '{Path(start).stem}'"


def _belonging(path: Path) -> list[Path]:
    """Return the files of these weights: weights, card, curves, and others with their name."""
    return [file for file in path.parent.glob(f"{path.stem}.*") if file.is_file()]


def _commit() -> str:
    try:
        command = ["git", "describe", "--always", "--dirty"]
        return subprocess.check_output(
            command, cwd=weights_io.WEIGHTS.parent, stderr=subprocess.DEVNULL, text=True
        ).strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
