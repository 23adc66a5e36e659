"""Sizes of HG-VAE and of the networks beside it, as stored with their weights; its nodes and their unit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

JOINT_NODES = 66
"""22 joints, 3 coordinates: node ``3 * joint + axis``."""

SCALE = 0.2
"""Metres, the unit of the networks' inputs and outputs."""

TRACK_LOG_VAR = -4.0
"""Log-variance of tracks for which an output of 0 stands: a deviation of 2.7 cm"""


class Level(NamedTuple):
    """One stochastic level: how many nodes, and how many latent features each has."""

    nodes: int
    latent: int


@dataclass(frozen=True)
class CompletionConfig:
    """Sizes of the completion network.

    Attributes:
        patch: frames in a node; a window has whole patches.
        features: of each node.
        blocks: graph convolutional blocks between reading and writing.
    """

    patch: int = 5
    features: int = 256
    blocks: int = 4


@dataclass(frozen=True)
class HGVAEConfig:
    """The sizes of an HG-VAE.

    Attributes:
        frames: T, frames of a window at 30 Hz (the paper has 50).
        coefficients: of the cosine transform that are kept, lowest first (the paper keeps all T).
        features: F, of every node in the deterministic streams (the paper has 256).
        levels: stochastic levels, the top one first (the paper: 1, 8, 24 and 54 nodes).
        stochastic: how many of the levels, counted from the bottom, are random; those above stay at their prior's
            mean and carry nothing (table 1: depth at equal capacity). None: all.
        actions: action classes, given one-hot beside the top latent; 0 for a model without.
        completion: sizes of the completion network; None for a model without.
    """

    frames: int = 50
    coefficients: int = 20
    features: int = 64
    levels: tuple[Level, ...] = (Level(1, 64), Level(8, 32), Level(24, 32), Level(JOINT_NODES, 16))
    stochastic: int | None = None
    actions: int = 0
    completion: CompletionConfig | None = None

    @classmethod
    def from_dict(cls, config: dict[str, Any]) -> HGVAEConfig:
        """From the JSON of a weights file."""
        completion = config.get("completion")
        return cls(**{
            **config,
            "levels": tuple(Level(*level) for level in config["levels"]),
            "completion": completion and CompletionConfig(**completion),
        })  # fmt: skip


@dataclass(frozen=True)
class FaultNetConfig:
    """Sizes of the fault network.

    Attributes:
        frames: T, of HG-VAE's window.
        features: of each of its 66 nodes.
    """

    frames: int = 50
    features: int = 48

    @classmethod
    def from_dict(cls, config: dict[str, Any]) -> FaultNetConfig:
        """From the JSON of a weights file."""
        return cls(**config)
