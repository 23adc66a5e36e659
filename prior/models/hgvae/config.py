"""Sizes of HG-VAE and of its companion networks, as stored with their weights; its nodes and their unit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

from steadypose.prior.models.weights import WeightsError

JOINT_NODES = 66  # number of nodes: 22 joints with 3 coordinates each, node ``3 * joint + axis``
SCALE = 0.2  # unit of the networks' inputs and outputs, metres
TRACK_LOG_VAR = -4.0  # log-variance of tracks at an output of 0, in units of `SCALE`: a standard deviation of 2.7 cm


class Level(NamedTuple):
    """One stochastic level: number of nodes, and number of latent features of each."""

    nodes: int
    latent: int


@dataclass(frozen=True)
class CompletionConfig:
    """Sizes of the completion network."""

    patch: int = 5  # frames in a node; a window consists of whole patches
    width: int = 256  # number of features of each node
    heads: int = 8  # number of attention heads
    layers: int = 5  # number of attention layers between the input and the output layer


@dataclass(frozen=True)
class HGVAEConfig:
    """The sizes of an HG-VAE."""

    frames: int = 50  # T, frames of a window at 30 Hz (paper: 50)
    coefficients: int = 20  # number of coefficients of the cosine transform that are kept, lowest first (paper: all T)
    features: int = 64  # F, features of every node in the deterministic streams (paper: 256)
    levels: tuple[Level, ...] = (Level(1, 64), Level(8, 32), Level(24, 32), Level(JOINT_NODES, 16))
    """stochastic levels, top level first (paper: 1, 8, 24 and 54 nodes)"""
    stochastic: int | None = None
    """number of random levels, counted from the bottom. Levels above stay at their prior's mean and carry no
    information (table 1: depth at equal capacity). None means all levels"""
    actions: int = 0  # number of action classes, given one-hot beside the top latent; 0 for a model without actions
    completion: CompletionConfig | None = None  # sizes of the completion network; None for a model without one

    @classmethod
    def from_dict(cls, config: dict[str, Any]) -> HGVAEConfig:
        """From the JSON of a weights file; raises WeightsError for an earlier version's."""
        completion = config.get("completion")
        if completion and "heads" not in completion:
            raise WeightsError("hgvae: expected a completion network of this version, a transformer: train again")
        return cls(**{
            **config,
            "levels": tuple(Level(*level) for level in config["levels"]),
            "completion": completion and CompletionConfig(**completion),
        })  # fmt: skip


@dataclass(frozen=True)
class FaultNetConfig:
    """Sizes of the fault network."""

    frames: int = 50  # T, frames of HG-VAE's window
    features: int = 48  # number of features of each of its 66 nodes

    @classmethod
    def from_dict(cls, config: dict[str, Any]) -> FaultNetConfig:
        """From the JSON of a weights file."""
        return cls(**config)
