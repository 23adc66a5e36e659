"""Torch versions of the live code: kinematics and rotations with gradients, and networks loaded from weights."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from steadypose.prior.body.kinematics import LEVELS
from steadypose.prior.body.skeleton import PARENTS
from steadypose.prior.models.weights import load_weights


def forward_kinematics(rotations: Tensor, offsets: Tensor, root: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Compute joint positions (..., 22, 3) metres and global rotations (..., 22, 3, 3), in the frame of the root's
    rotation, from local rotations (..., 22, 3, 3), bones (..., 22, 3) and the root's position (..., 3), the origin if
    omitted."""
    batch = rotations.shape[:-3]
    offsets = offsets.expand(*batch, *offsets.shape[-2:]).unsqueeze(-1)
    origin = rotations.new_zeros(*batch, 3) if root is None else root
    # lists instead of one tensor written in place, because autograd needs every level's values
    positions: list[Tensor] = [origin.unsqueeze(-2)]
    orientations: list[Tensor] = [rotations[..., :1, :, :]]
    for above, level in pairwise(LEVELS):
        parents = [p - above.start for p in PARENTS[level]]
        orientation = orientations[-1][..., parents, :, :]
        positions.append(positions[-1][..., parents, :] + (orientation @ offsets[..., level, :, :]).squeeze(-1))
        orientations.append(orientation @ rotations[..., level, :, :])
    return torch.cat(positions, dim=-2), torch.cat(orientations, dim=-3)


def to_6d(rotations: Tensor) -> Tensor:
    """Convert rotation matrices (..., 3, 3) to (..., 6): first column, then second."""
    return rotations[..., :2].transpose(-1, -2).flatten(-2)


def from_6d(x: Tensor) -> Tensor:
    """Convert (..., 6) to rotation matrices (..., 3, 3) by Gram-Schmidt (Zhou et al. 2019)."""
    a, b = x[..., :3], x[..., 3:]
    first = F.normalize(a, dim=-1)
    second = F.normalize(b - (first * b).sum(dim=-1, keepdim=True) * first, dim=-1)
    return torch.stack([first, second, torch.linalg.cross(first, second)], dim=-1)


def remove_heading(rotations: Tensor, frame: int) -> tuple[Tensor, Tensor]:
    """Turn windows of local rotations (B, T, 22, 3, 3), z up, about the vertical so that the body faces +x in
    ``frame``. Returns them, and the yaw matrices (B, 3, 3) that turn them back."""
    back = yaw_rotation(heading(rotations[:, frame, 0]))
    turned = rotations.clone()
    turned[:, :, 0] = back.transpose(-1, -2)[:, None] @ rotations[:, :, 0]
    return turned, back


def heading(root_rotation: Tensor) -> Tensor:
    """Yaw (...) in radians of root rotations (..., 3, 3), as `prior.body.kinematics.heading`, in torch."""
    left = root_rotation[..., :, 1]
    return torch.atan2(-left[..., 0], left[..., 1])


def yaw_rotation(yaw: Tensor) -> Tensor:
    """Rotations (..., 3, 3) about z by ``yaw`` (...) radians."""
    zero, one = torch.zeros_like(yaw), torch.ones_like(yaw)
    c, s = yaw.cos(), yaw.sin()
    return torch.stack([c, -s, zero, s, c, zero, zero, zero, one], dim=-1).reshape(*yaw.shape, 3, 3)


Config = TypeVar("Config")
N = TypeVar("N", bound=nn.Module)


def load_tensors(name: str, model: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Load the state dict and the configuration of ``model``, like `prior.models.weights.load_weights`."""
    weights, config = load_weights(name, model)
    return {key: torch.from_numpy(array) for key, array in weights.items()}, config


def load_network(
    network: Callable[[Config], N], config: Callable[[dict[str, Any]], Config], name: str, model: str
) -> N:
    """Load a trained network, in evaluation mode: ``network`` is its class, ``config`` makes the class's configuration
    of a weights file's JSON, such as `HGVAEConfig.from_dict`, and ``name`` and ``model`` are as in `load_weights`.

    Raises FileNotFoundError if there are no such weights (the message lists those that exist), WeightsError if the file
    belongs to another model.
    """
    state, stored = load_tensors(name, model)
    loaded = network(config(stored))
    loaded.load_state_dict(state)
    return loaded.eval()
