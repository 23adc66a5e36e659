"""Weights as training has them: written with a card that says how they were made, read as tensors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from steadypose.prior.models.weights import load_weights

Config = TypeVar("Config")
N = TypeVar("N", bound=nn.Module)


def load_tensors(name: str, model: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """As `weights_io.load_weights`: the state dict and the configuration of ``model``."""
    weights, config = load_weights(name, model)
    return {key: torch.from_numpy(array) for key, array in weights.items()}, config


def load_network(
    network: Callable[[Config], N], config: Callable[[dict[str, Any]], Config], name: str, model: str
) -> N:
    """A trained network, in evaluation.

    Args:
        network: its class, such as `HGVAE`.
        config: what makes that class's configuration of the JSON of a weights file, such as `HGVAEConfig.from_dict`.
        name: the weight set, such as ``default``, or a path to a ``.safetensors`` file.
        model: the model's name, such as ``hgvae``.

    Raises:
        FileNotFoundError: no such weights; says which there are.
        WeightsError: the file is not one of this model's.
    """
    state, stored = load_tensors(name, model)
    loaded = network(config(stored))
    loaded.load_state_dict(state)
    return loaded.eval()
