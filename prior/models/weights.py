"""Reads the bundled weights: safetensors with the configuration inside, as arrays."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from safetensors import SafetensorError, safe_open

from steadypose import PACKAGE
from steadypose.prior.arrays import Floats32
from steadypose.prior.settings import MODEL

Arrays: TypeAlias = Mapping[str, Floats32]
"""A network's weights by their names in its state dict, such as ``blocks.0.first.weight``."""

WEIGHTS = PACKAGE / "prior" / "weights"
"""Folder of the weights: ``MODEL-SET.safetensors``, each with its card ``MODEL-SET.md``."""

LICENCES = {
    "default": "Apache-2.0; trained only on data free for products",
    "research": "non-commercial use only: trained on CC BY-NC 4.0 data too",
}
"""Licence of each weight set, as stated on its cards."""

_PARTS = {
    "body_modes": "covariance",
    "completer": "layers norm read usual write",
    "contacts": "head unit",
    "correction": "layers mean scale",
    "faults": "blocks mean read write",
    "hgvae": "dct down encoder last_block mean read read_block start up write",
    "hmvae": "decoder encoder from_global from_local to_global to_local",
    "humor": "decoder encoder mean mixture_log_weights mixture_means mixture_precisions scale",
    "mixture": "body_memory deepen deviation gather joint joint_mix mean mix own_memory read remember tell think write",
    "occlusion": "deviation joint mean read think write",
    "posture": "factor mean",
    "trajectory": "head motion",
}
"""Top-level names of each model's state dict, used to detect a file of another model."""

_OPTIONAL_PARTS = {"hgvae": {"completion"}, "humor": {"prior"}}


class WeightsError(ValueError):
    """A weights file cannot be used; the message says what was expected."""


def weights_path(name: str, model: str) -> Path:
    """Return the path of a model's weights, given a weight set's name or a path.

    Raises:
        FileNotFoundError: there are no such weights; the message lists those that exist.
    """
    path = Path(name) if name.endswith(".safetensors") else WEIGHTS / f"{model}-{name}.safetensors"
    if path.is_file():
        return path
    known = sorted(p.stem.removeprefix(f"{model}-") for p in WEIGHTS.glob(f"{model}-*.safetensors"))
    raise FileNotFoundError(
        f"no weights '{name}' for {model}: expected {path.name}; there are {', '.join(known) or 'none'}. "
        f"Name one of these, or make them with 'steadypose train {model}'."
    )


def check_weights(settings: Any) -> None:
    """Check that the weights that a dataclass of settings names exist, except those of switched-off stages.

    Raises:
        FileNotFoundError: as `weights_path`.
    """
    for setting in fields(settings):
        value, model = getattr(settings, setting.name), setting.metadata.get(MODEL)
        if is_dataclass(value):
            check_weights(value)
        elif model and value and getattr(settings, "enabled", True):
            weights_path(value, model)


def load_weights(name: str, model: str) -> tuple[Arrays, dict[str, Any]]:
    """Load the weights and the configuration of a model.

    Args:
        name: the weight set, such as ``default``, or a path to a ``.safetensors`` file.
        model: the model's name, such as ``hmvae``.

    Raises:
        FileNotFoundError: there are no such weights; the message lists those that exist.
        WeightsError: the file is damaged, was not written by `steadypose train`, or holds another model.
    """
    path = weights_path(name, model)
    try:
        with safe_open(path, framework="numpy") as file:
            config = (file.metadata() or {}).get("config")
            names = file.keys()
            arrays = {key: file.get_tensor(key).astype(np.float32, copy=False) for key in names}
    except SafetensorError as error:
        raise WeightsError(f"{path}: expected weights as .safetensors: {error}") from error
    _check_parts(path, model, arrays)
    if config is None:
        raise WeightsError(f"{path}: expected weights written by 'steadypose train'; these have no configuration")
    return arrays, json.loads(config)


def _check_parts(path: Path, model: str, arrays: Arrays) -> None:
    """Refuse weights of another model: HG-VAE's fault network lies beside it as ``.faults.safetensors``."""
    kind = "faults" if ".faults" in path.suffixes else {"hmvae64": "hmvae"}.get(model, model)
    found = {key.partition(".")[0] for key in arrays}
    expected = set(_PARTS[kind].split())
    if expected <= found <= expected | _OPTIONAL_PARTS.get(kind, set()):
        return
    others = [other for other, parts in _PARTS.items() if set(parts.split()) <= found and other != kind]
    held = f"those of {max(others, key=lambda other: len(_PARTS[other]))}" if others else ", ".join(sorted(found)[:6])
    raise WeightsError(f"{path}: expected weights of {kind}, found {held}")


def part(weights: Arrays, name: str) -> Arrays:
    """The weights of the part ``name`` of a network, by their names in it; empty if it has none."""
    prefix = f"{name}."
    return {key.removeprefix(prefix): array for key, array in weights.items() if key.startswith(prefix)}
