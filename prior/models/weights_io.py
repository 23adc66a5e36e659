"""Weights that ship: safetensors with the configuration inside, read as arrays."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from safetensors import safe_open

from steadypose import PACKAGE

Arrays: TypeAlias = Mapping[str, NDArray[np.float32]]
"""A network's weights by name, as its state dict has them: ``blocks.0.first.weight``."""

WEIGHTS = PACKAGE / "prior" / "weights"
"""Where the weights lie: ``MODEL-SET.safetensors``, each with ``MODEL-SET.md``, its card."""

LICENCES = {
    "default": "Apache-2.0; trained only on data free for products",
    "research": "non-commercial use only: trained on CC BY-NC 4.0 data too",
}
"""by weight set, as a card tells it"""


def weights_path(name: str, model: str) -> Path:
    """Where ``model``'s weights lie, by the name of the weight set or as a path."""
    return Path(name) if name.endswith(".safetensors") else WEIGHTS / f"{model}-{name}.safetensors"


def load_weights(name: str, model: str) -> tuple[Arrays, dict[str, Any]]:
    """The weights and the configuration of ``model``.

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
    with safe_open(path, framework="numpy") as file:
        config = json.loads(file.metadata()["config"])
        names = file.keys()
        return {name: file.get_tensor(name).astype(np.float32, copy=False) for name in names}, config


def part(weights: Arrays, name: str) -> Arrays:
    """The weights of the part ``name`` of a network, by their names in it; empty if it has none."""
    prefix = f"{name}."
    return {key.removeprefix(prefix): array for key, array in weights.items() if key.startswith(prefix)}
