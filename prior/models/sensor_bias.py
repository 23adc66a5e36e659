"""The network of a sensor's bias as the live node runs it, `CorrectionNet` without torch, and its features."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import HIPS, SHOULDERS, finite_joints
from steadypose.prior.models.compiled_graph import Network, Program
from steadypose.prior.models.weights import Arrays, load_weights, part

SMOOTHER_DENSITY = 1.0
"""m²/s³, of the causal smoother before the network: its answer must not jitter with its input."""

HISTORY: tuple[int, ...] = (0, 1, 2, 4, 7, 12)
"""Frames ago, at 30 Hz, that the network sees: nothing of the future."""

_CORNERS = (*HIPS, *SHOULDERS)
VECTORS = 22 * len(HISTORY) + 2
FEATURES = 3 * VECTORS + 2 + 22


@dataclass(frozen=True)
class CorrectionConfig:
    """Sizes of a correction network.

    Attributes:
        hidden: width of its two hidden layers.
        sensor: whose error it corrects.
    """

    hidden: int = 256
    sensor: str = "kinect_v2"

    @classmethod
    def from_dict(cls, config: dict[str, Any]) -> CorrectionConfig:
        """From the JSON of a weights file."""
        return cls(**config)


def trunk_frame(positions: Floats) -> Floats:
    """Rotations (..., 3, 3) from the frame that hips and shoulders span (x forward, y left, z up) to that of
    ``positions`` (..., 22, 3); NaN where one of the four is missing."""
    hip_l, hip_r, shoulder_l, shoulder_r = (positions[..., k, :] for k in _CORNERS)
    left = _unit(hip_l - hip_r + shoulder_l - shoulder_r)
    forward = _unit(np.cross(left, shoulder_l + shoulder_r - hip_l - hip_r))
    return np.stack([forward, left, np.cross(forward, left)], axis=-1)


def _unit(v: Floats) -> Floats:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-9)


def features(history: Floats, camera: Floats) -> Floats:
    """The network's input.

    Args:
        history: (H, B, 22, 3) metres, z up, smoothed causally; row k is the frame `HISTORY[k]` frames ago, NaN where
            a joint is missing.
        camera: (3,) metres, where the sensor stands.

    Returns:
        (B, FEATURES): the joints of all rows in the newest frame's trunk frame, from the middle of its hips; which way
        is up, which way the camera; how far it is (m), and how high the hips above it (m); which joints are seen.
    """
    newest = history[0]
    to_trunk = trunk_frame(newest).swapaxes(-1, -2)
    hips = (newest[:, _CORNERS[0]] + newest[:, _CORNERS[1]]) / 2
    view = camera - hips
    distance = np.linalg.norm(view, axis=-1, keepdims=True)
    up = np.broadcast_to([0.0, 0.0, 1.0], view.shape)
    joints = np.moveaxis(history - hips[:, None], 0, 1).reshape(len(hips), -1, 3)
    vectors = np.concatenate([joints, up[:, None], (view / np.maximum(distance, 1e-9))[:, None]], axis=1)
    turned = vectors @ to_trunk.swapaxes(-1, -2)
    seen = finite_joints(newest).astype(np.float64)
    return np.concatenate([turned.reshape(len(hips), -1), distance, -view[:, 2:], seen], axis=1)


def recall(frames: NDArray[np.float64]) -> NDArray[np.float64]:
    """(H, B, 22, 3) of the frames `HISTORY` ago among ``frames`` (T, B, 22, 3), the newest last.

    Before a body's first frame, its first frame is repeated.
    """
    seen = np.isfinite(frames[..., 0]).any(axis=-1)
    first = np.where(seen.any(axis=0), seen.argmax(axis=0), len(frames) - 1)
    rows = np.maximum(len(frames) - 1 - np.array(HISTORY)[:, None], first)
    return frames[rows, np.arange(frames.shape[1])]


class LiveCorrection:
    """A trained `CorrectionNet`.

    Args:
        weights: its state dict, which is copied.
        max_batch: frames at once.
    """

    def __init__(self, weights: Arrays, max_batch: int) -> None:
        p = Program()
        self._mean, self._scale = (weights[name].astype(np.float64) for name in ("mean", "scale"))
        self._features = matrix = p.matrix(1, FEATURES)
        for k in (0, 3, 6):  # between them, an activation and a dropout
            layer = part(weights, f"layers.{k}")
            matrix = p.linear(matrix, layer["weight"].T, layer["bias"], active=k > 0)
        self._answer, self._net = matrix, Network(p, max_batch)

    @classmethod
    def load(cls, sensor: str, max_batch: int) -> LiveCorrection:
        """From the weights of this sensor; raises as `load_weights`."""
        return cls(load_weights(sensor, "correction")[0], max_batch)

    def __call__(self, features: Floats) -> Floats:
        """(B, 22, 3) metres in the trunk's frame, what must be added to each joint, from `features` (B, FEATURES).

        NaN features are missing joints: they read as the training mean.
        """
        rows = slice(0, len(features))
        self._net.matrix(self._features, rows)[:, 0] = np.nan_to_num((features - self._mean) / self._scale)
        self._net.run(rows)
        return self._net.matrix(self._answer, rows).reshape(-1, 22, 3).astype(np.float64)
