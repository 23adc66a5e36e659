"""A sensor's systematic error, as a function of the pose that it shows.

A smoother removes what changes from frame to frame; most of a depth camera's error does not: it depends on the pose,
on what hides what, and on the direction of view, and stays while these do. This network learns it from recordings of
the sensor beside a reference, and says, frame by frame, where the joints really were.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from steadypose.prior.body.skeleton import HIPS, MIRROR, SHOULDERS, finite_joints

Floats = NDArray[np.float64]

HISTORY: tuple[int, ...] = (0, 1, 2, 4, 7, 12)
"""Frames ago, at 30 Hz, that the network sees: nothing of the future."""

_CORNERS = (*HIPS, *SHOULDERS)
_VECTORS = 22 * len(HISTORY) + 2
FEATURES = 3 * _VECTORS + 2 + 22


@dataclass(frozen=True)
class CorrectionConfig:
    """The sizes of a correction network.

    Attributes:
        hidden: width of its two hidden layers.
        sensor: which sensor's error it knows.
    """

    hidden: int = 256
    sensor: str = "kinect_v2"

    @classmethod
    def from_dict(cls, config: dict[str, Any]) -> CorrectionConfig:
        """From the JSON of a weights file."""
        return cls(**config)


class CorrectionNet(nn.Module):
    """Features of a frame (B, FEATURES) to what must be added to each joint, (B, 22, 3) metres, trunk frame."""

    mean: Tensor
    scale: Tensor

    def __init__(self, config: CorrectionConfig) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(FEATURES))
        self.register_buffer("scale", torch.ones(FEATURES))
        self.layers = nn.Sequential(
            nn.Linear(FEATURES, config.hidden), nn.GELU(), nn.Dropout(0.5),
            nn.Linear(config.hidden, config.hidden), nn.GELU(), nn.Dropout(0.5),
            nn.Linear(config.hidden, 66),
        )  # fmt: skip

    def forward(self, features: Tensor) -> Tensor:
        """NaN features are missing joints: they read as the training mean."""
        x = torch.nan_to_num((features - self.mean) / self.scale)
        return self.layers(x).reshape(-1, 22, 3)


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
    """What the network sees of each frame.

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


def mirror_features(x: Tensor) -> Tensor:
    """The features (B, FEATURES) of the same bodies seen in a mirror: left is right."""
    vectors = x[:, : 3 * _VECTORS].reshape(len(x), _VECTORS, 3) * x.new_tensor([1.0, -1.0, 1.0])
    joints = vectors[:, :-2].reshape(len(x), len(HISTORY), 22, 3)[:, :, MIRROR.tolist()]
    return torch.cat(
        [joints.flatten(1), vectors[:, -2:].flatten(1), x[:, -24:-22], x[:, -22:][:, MIRROR.tolist()]], dim=1
    )
