"""Live inference of `Completer` without torch: one pass over windows, applied to the interpolated motion."""

from __future__ import annotations

import math

import numpy as np

from steadypose.prior.arrays import Floats, Floats32
from steadypose.prior.models.completer_features import (
    BENDS,
    CompleterConfig,
    correction_share,
    read_window,
    rotations_of_6d,
)
from steadypose.prior.models.line import anchored
from steadypose.prior.models.weights import Arrays, load_weights, part


class LiveCompleter:
    """A trained `Completer`.

    Attributes:
        config: its sizes.
        usual: (22, 4) local quaternions, xyzw, of the mean pose, used for joints that are never known.
    """

    def __init__(self, config: CompleterConfig, weights: Arrays) -> None:
        self.config = config
        self._weights = weights
        self._layers = [part(weights, f"layers.{k}") for k in range(config.layers)]
        usual = weights["usual"].astype(np.float64)
        self.usual = usual / np.linalg.norm(usual, axis=-1, keepdims=True)

    @classmethod
    def load(cls, weights: str) -> LiveCompleter:
        """Load the weights of this name; raises like `load_weights`."""
        arrays, config = load_weights(weights, "completer")
        return cls(CompleterConfig.from_dict(config), arrays)

    def __call__(self, positions: Floats, offsets: Floats) -> tuple[Floats, Floats]:
        """Complete windows (B, T, 22, 3) metres, z up, NaN where unknown, of bones (B, 22, 3) metres. Known joints do
        not change.

        Returns local rotations (B, T, 22, 3, 3) and positions of the root (B, T, 3), metres.
        """
        window = read_window(positions, offsets, self.usual)
        output = self.forward(window.features).astype(np.float64)
        turns, steps, gates = np.split(output, [BENDS - 3, BENDS], axis=-1)
        share = correction_share(window.line).astype(np.float64)
        bend = window.bend * (1.0 - share / (1.0 + np.exp(gates[..., None])))
        turns = anchored(turns.reshape(*output.shape[:2], 22, 6), window.line, slice(0, 22))
        steps = anchored(steps[:, :, None], window.line, slice(22, 23))[:, :, 0]
        turns = share[:, :, :22] * turns + bend[:, :, :22]
        steps = share[:, :, 22] * steps + bend[:, :, 22, :3]
        columns = window.rotations[..., :2].swapaxes(-1, -2).reshape(turns.shape) + turns
        rotations = rotations_of_6d(columns)
        rotations[:, :, 0] = window.turn[:, None] @ rotations[:, :, 0]
        return rotations, (window.root + steps) @ window.turn.swapaxes(1, 2) + window.origin[:, None]

    def forward(self, features: Floats32) -> Floats32:
        """`Completer.forward`: (B, T, OUTPUTS) of features (B, T, FEATURES)."""
        count, frames = features.shape[:2]
        reach, heads = self.config.reach, self.config.heads
        at = np.arange(frames)
        apart = np.clip(at[None] - at[:, None], -reach, reach) + reach
        x = _linear(features.reshape(count * frames, -1), part(self._weights, "read"))
        size = x.shape[1] // heads
        for layer in self._layers:
            read = _linear(_norm(x, part(layer, "norm1")), part(layer, "attend"))
            query, key, value = read.reshape(count, frames, 3, heads, size).transpose(2, 0, 3, 1, 4)
            scores = query @ key.swapaxes(-1, -2) / np.float32(math.sqrt(size)) + layer["bias"][:, apart]
            scores = np.exp(scores - scores.max(axis=-1, keepdims=True))
            joined = (scores / scores.sum(axis=-1, keepdims=True)) @ value
            x = x + _linear(joined.swapaxes(1, 2).reshape(len(x), -1), part(layer, "join"))
            wide = _gelu(_linear(_norm(x, part(layer, "norm2")), part(layer, "widen")))
            x = x + _linear(wide, part(layer, "narrow"))
        return _linear(_norm(x, part(self._weights, "norm")), part(self._weights, "write")).reshape(count, frames, -1)


def _linear(x: Floats32, layer: Arrays) -> Floats32:
    return x @ layer["weight"].T + layer["bias"]


def _norm(x: Floats32, layer: Arrays) -> Floats32:
    centred = x - x.mean(axis=-1, keepdims=True)
    deviation = np.sqrt((centred * centred).mean(axis=-1, keepdims=True) + np.float32(1e-5))
    return centred / deviation * layer["weight"] + layer["bias"]


def _gelu(x: Floats32) -> Floats32:
    """GELU in its tanh approximation."""
    inner = np.float32(math.sqrt(2.0 / math.pi)) * (x + np.float32(0.044715) * x * x * x)
    return np.float32(0.5) * x * (np.float32(1.0) + np.tanh(inner))
