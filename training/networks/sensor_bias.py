"""A sensor's systematic error, as a function of the pose that it shows.

A smoother removes jitter; most of a depth camera's error is slow: it depends on the pose, on self-occlusion and on the
direction of view, and stays while these do. This network learns it from recordings of the sensor with a reference, and
gives, frame by frame, the correction of each joint.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from steadypose.prior.body.skeleton import MIRROR
from steadypose.prior.models.sensor_bias import FEATURES, HISTORY, VECTORS, CorrectionConfig


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


def mirror_features(x: Tensor) -> Tensor:
    """The features (B, FEATURES) of the same bodies seen in a mirror: left is right."""
    vectors = x[:, : 3 * VECTORS].reshape(len(x), VECTORS, 3) * x.new_tensor([1.0, -1.0, 1.0])
    joints = vectors[:, :-2].reshape(len(x), len(HISTORY), 22, 3)[:, :, MIRROR.tolist()]
    return torch.cat(
        [joints.flatten(1), vectors[:, -2:].flatten(1), x[:, -24:-22], x[:, -22:][:, MIRROR.tolist()]], dim=1
    )
