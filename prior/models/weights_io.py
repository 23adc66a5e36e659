"""Weights that ship: safetensors with the configuration inside, and a card beside them that says how they were made."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor, nn

from steadypose import PACKAGE
from steadypose.prior.models.distributed import writes

WEIGHTS = PACKAGE / "prior" / "weights"
"""Where the weights lie: ``MODEL-SET.safetensors``, each with ``MODEL-SET.md``, its card."""


LICENCES = {
    "default": "Apache-2.0; trained only on data free for products",
    "research": "non-commercial use only: trained on CC BY-NC 4.0 data too",
}
"""by weight set, as a card tells it"""


def save_weights(path: Path, model: nn.Module, config: Mapping[str, Any], card: Mapping[str, Any]) -> None:
    """Write weights, in half precision, with their configuration, and the card; on the first process of torchrun.

    Args:
        path: ends in ``.safetensors``; the card is written beside it as ``.md``.
        model: its state dict is saved.
        config: what rebuilds the model, as JSON in the file's metadata.
        card: heading to content: data, licence, seed, training command, results.
    """
    if not writes():
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    tensors = {name: tensor.detach().half().contiguous() for name, tensor in model.state_dict().items()}
    _write_whole(path, save(tensors, metadata={"config": json.dumps(dict(config), sort_keys=True)}))
    lines = [f"# {path.stem}", ""]
    for heading, content in {**card, "Commit": _commit(), "Made on": f"{platform.machine()}, torch on CPU"}.items():
        lines += [f"- **{heading}**: {content}"]
    _write_whole(path.with_suffix(".md"), ("\n".join(lines) + "\n").encode())


def weights_path(name: str, model: str) -> Path:
    """Where ``model``'s weights lie, by the name of the weight set or as a path."""
    return Path(name) if name.endswith(".safetensors") else WEIGHTS / f"{model}-{name}.safetensors"


def load_weights(name: str, model: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The state dict and configuration of ``model``.

    Args:
        name: the weight set, such as ``default``, or a path to a ``.safetensors`` file.
        model: the model's name, such as ``hmvae``.

    Raises:
        FileNotFoundError: no such weights; says which there are.
    """
    path = weights_path(name, model)
    if not path.is_file():
        known = sorted(p.stem.removeprefix(f"{model}-") for p in WEIGHTS.glob(f"{model}-*.safetensors"))
        raise FileNotFoundError(
            f"no weights '{name}' for {model}: expected {path.name}; there are {', '.join(known) or 'none'}. "
            f"Name one of these, or make them with 'steadypose train {model}'."
        )
    with safe_open(path, framework="pt") as file:
        config = json.loads(file.metadata()["config"])
        return {key: file.get_tensor(key).float() for key in file.keys()}, config  # noqa: SIM118 (not a mapping)


def started(model: nn.Module, name: str, start: str | None) -> str:
    """Load into ``model`` the weights ``start`` of the model ``name``, if there are to be any; what a card says of it.

    Raises:
        FileNotFoundError: no such weights.
        ValueError: weights of another model.
    """
    if start is None:
        return ""
    try:
        model.load_state_dict(load_weights(start, name)[0])
    except RuntimeError as error:
        raise ValueError(f"start: expected weights of {name}, of this size, got '{start}': {error}") from error
    return f", started from the weights '{Path(start).stem}'"


def _write_whole(path: Path, content: bytes) -> None:
    part = path.with_name(path.name + ".part")
    part.write_bytes(content)
    os.replace(part, path)


def _commit() -> str:
    try:
        found = subprocess.run(
            ["git", "describe", "--always", "--dirty"], cwd=WEIGHTS.parent, capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return found.stdout.strip()
