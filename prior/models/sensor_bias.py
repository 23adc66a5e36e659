"""Live inference of the sensor bias network (`CorrectionNet`) without torch, and its features."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import HIPS, SHOULDERS, finite_joints
from steadypose.prior.models.compiled_graph import Network, Program
from steadypose.prior.models.weights import Arrays, load_weights, part

SMOOTHER_DENSITY = 1.0
"""Spectral density of the acceleration noise of the causal smoother before the network, m²/s³. The smoother keeps the
input's jitter out of the network's output."""

HISTORY: tuple[int, ...] = (0, 1, 2, 4, 7, 12)  # ages of the network's input frames, frames at 30 Hz

_CORNERS = (*HIPS, *SHOULDERS)
VECTORS = 22 * len(HISTORY) + 2
FEATURES = 3 * VECTORS + 2 + 22


@dataclass(frozen=True)
class CorrectionConfig:
    """Sizes of a correction network."""

    hidden: int = 256  # width of its two hidden layers
    sensor: str = "kinect_v2"  # name of the sensor that it corrects


def trunk_frame(positions: Floats) -> Floats:
    """Return rotations (..., 3, 3) from the trunk's frame to that of ``positions`` (..., 22, 3).

    Hips and shoulders span the trunk's frame (x forward, y left, z up). It is NaN if one of the four is missing.
    """
    hip_l, hip_r, shoulder_l, shoulder_r = (positions[..., k, :] for k in _CORNERS)
    left = _unit(hip_l - hip_r + shoulder_l - shoulder_r)
    forward = _unit(np.cross(left, shoulder_l + shoulder_r - hip_l - hip_r))
    return np.stack([forward, left, np.cross(forward, left)], axis=-1)


def _unit(v: Floats) -> Floats:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-9)


def features(history: Floats, camera: Floats) -> Floats:
    """Build the network's input.

    Args:
        history: (H, B, 22, 3) metres, z up, causally smoothed; row k is the frame `HISTORY[k]` frames ago, NaN where a
            joint is missing.
        camera: (3,) metres, position of the sensor.

    Returns:
        (B, FEATURES): the joints of all rows in the newest trunk frame, relative to the midpoint of the hips; the
        directions of up and of the camera; the distance to the camera and the height of the hips above it (m); which
        joints are observed.
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
    observed = finite_joints(newest).astype(np.float64)
    return np.concatenate([turned.reshape(len(hips), -1), distance, -view[:, 2:], observed], axis=1)


def recall(frames: Floats) -> Floats:
    """(H, B, 22, 3) frames of the ages `HISTORY` among ``frames`` (T, B, 22, 3), which are oldest first.

    Frames before a body's first one repeat its first.
    """
    observed = np.isfinite(frames[..., 0]).any(axis=-1)
    first = np.where(observed.any(axis=0), observed.argmax(axis=0), len(frames) - 1)
    rows = np.maximum(len(frames) - 1 - np.array(HISTORY)[:, None], first)
    return frames[rows, np.arange(frames.shape[1])]


class LiveCorrection:
    """A trained `CorrectionNet` for at most ``max_batch`` frames per call."""

    def __init__(self, weights: Arrays, max_batch: int) -> None:
        p = Program()
        self._mean, self._scale = (weights[name].astype(np.float64) for name in ("mean", "scale"))
        self._features = matrix = p.matrix(1, FEATURES)
        for k in (0, 3, 6):  # activation and dropout lie between
            layer = part(weights, f"layers.{k}")
            matrix = p.linear(matrix, layer["weight"].T, layer["bias"], active=k > 0)
        self._output, self._net = matrix, Network(p, max_batch)

    @classmethod
    def load(cls, sensor: str, max_batch: int) -> LiveCorrection:
        """Load the weights of this sensor; raises like `load_weights`."""
        return cls(load_weights(sensor, "correction")[0], max_batch)

    def __call__(self, features: Floats) -> Floats:
        """Return the correction to add to each joint, (B, 22, 3) metres in the trunk's frame, from `features`.

        NaN features (missing joints) are replaced by the training mean.
        """
        rows = slice(0, len(features))
        self._net.matrix(self._features, rows)[:, 0] = np.nan_to_num((features - self._mean) / self._scale)
        self._net.run(rows)
        return self._net.matrix(self._output, rows).reshape(-1, 22, 3).astype(np.float64)
