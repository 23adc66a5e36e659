"""Observations as terms of the energy: joints in space, key points of an image, points of a body's surface."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from steadypose.prior.body.capsules import CAPSULES, REST_HEIGHT, stature
from steadypose.prior.body.skeleton import J
from steadypose.prior.fit.energy import Term, bisquare, geman_mcclure, huber
from steadypose.prior.fit.motion import Motion

ROBUST = 5.0
"""Standard deviations from which on a key point or a point of the surface counts as an outlier."""

CLEAR = 3.0
"""Standard deviations from which on a joint in space pulls no harder; none is given up: there may be no other."""

MOST_POINTS = 200
"""Of a surface, a frame, that are fitted."""

POINT_SHARE = 0.03
"""Of points beside joints in space: what capsules and a depth camera get wrong lasts, and so many points in so many
frames would outvote joints that are right (benchmarks/NOTEBOOK.md)."""

POINT_SIGMA = 0.05
"""Metres: error of a depth camera's points five metres away, and of capsules as a body. A limb finds its points within
`ROBUST` times that."""


class Observed(Term, Protocol):
    """Observations of T frames."""

    def between(self, first: int, last: int) -> Observed:
        """Those of the frames ``first`` to ``last - 1``."""
        ...

    def misfit(self, motion: Motion) -> Tensor:
        """(T, 22) distance of each joint from its observation: metres, or pixels; NaN where there is none."""
        ...


@dataclass(frozen=True)
class SeenJoints:
    """E_data of joints or key points in space, some of them hidden.

    Attributes:
        positions: (T, 22, 3) metres, world; NaN where not seen.
        sigma: (T, 22) metres along an axis.
    """

    positions: Tensor
    sigma: Tensor

    @cached_property
    def _seen(self) -> Tensor:
        return torch.isfinite(self.positions).all(dim=-1)

    def residual(self, motion: Motion) -> Tensor:
        return (motion.world_joints[self._seen] - self.positions[self._seen]) / self.sigma[self._seen].unsqueeze(-1)

    def kernel(self, square: Tensor) -> Tensor:
        return huber(square, CLEAR)

    def between(self, first: int, last: int) -> SeenJoints:
        return SeenJoints(self.positions[first:last], self.sigma[first:last])

    def misfit(self, motion: Motion) -> Tensor:
        return (motion.world_joints - self.positions).norm(dim=-1)


@dataclass(frozen=True)
class Pinhole:
    """A fixed pinhole camera.

    Attributes:
        focal: (2,) pixels.
        centre: (2,) pixels.
        rotation: (3, 3) from its optical frame (x right, y down, z forward) to the world.
        position: (3,) metres, world.
    """

    focal: Tensor
    centre: Tensor
    rotation: Tensor
    position: Tensor

    def project(self, points: Tensor) -> Tensor:
        """(..., 2) pixels of points (..., 3) metres, world; depths are at least 0.1 m."""
        seen = (points - self.position) @ self.rotation
        return seen[..., :2] / seen[..., 2:].clamp(min=0.1) * self.focal + self.centre


@dataclass(frozen=True)
class KeyPoints:
    """E_data of key points in an image, weighted by their confidence, under Geman's and McClure's kernel.

    Attributes:
        pixels: (T, 22, 2); NaN where not found.
        confidence: (T, 22) 0 to 1, a weight as in the paper; its square is the official code's.
        camera: of the image.
        sigma: pixels along an axis.
    """

    pixels: Tensor
    confidence: Tensor
    camera: Pinhole
    sigma: float

    @cached_property
    def _seen(self) -> Tensor:
        return torch.isfinite(self.pixels).all(dim=-1) & (self.confidence > 0)

    def residual(self, motion: Motion) -> Tensor:
        off = self.camera.project(motion.world_joints[self._seen]) - self.pixels[self._seen]
        return off / self.sigma

    def kernel(self, square: Tensor) -> Tensor:
        return geman_mcclure(square, ROBUST) * self.confidence[self._seen].unsqueeze(-1)

    def between(self, first: int, last: int) -> KeyPoints:
        return replace(self, pixels=self.pixels[first:last], confidence=self.confidence[first:last])

    def misfit(self, motion: Motion) -> Tensor:
        off = (self.camera.project(motion.world_joints) - self.pixels).norm(dim=-1)
        return torch.where(self._seen, off, torch.nan)


_STARTS = [J[first] for first, _, _ in CAPSULES]
_ENDS = [J[second] for _, second, _ in CAPSULES]
_RADII = torch.tensor([radius for _, _, radius in CAPSULES])


@dataclass(frozen=True)
class SurfacePoints:
    """E_data of points of a depth camera: how far each is from where the camera sees the nearest capsule about a bone.

    A camera sees the side of a body that is turned to it. The distance from a closed surface would let a point that
    noise puts behind a limb's middle pull towards its back, and those in front of it alone would then move the body.

    Attributes:
        points: (T, N, 3) metres, world; NaN where there are fewer.
        camera: (3,) metres, world, where it stands, or (T, 3).
        sigma: metres.
        weight: share of a point that counts, for neighbours err alike.
    """

    points: Tensor
    camera: Tensor
    sigma: float = POINT_SIGMA
    weight: float = 1.0

    @cached_property
    def _seen(self) -> Tensor:
        return torch.isfinite(self.points).all(dim=-1)

    @cached_property
    def _rays(self) -> Tensor:
        """(P, 3) unit vectors from the camera to the points seen."""
        away = (self.points - self.camera.reshape(-1, 1, 3))[self._seen]
        return away / away.norm(dim=-1, keepdim=True)

    def residual(self, motion: Motion) -> Tensor:
        """(P, 2) along the ray and across it."""
        frames, _ = torch.nonzero(self._seen, as_tuple=True)
        points, joints = self.points[self._seen], motion.world_joints
        radii = _RADII.to(joints.dtype) * (stature(motion.offsets.detach().numpy()) / REST_HEIGHT)
        with torch.no_grad():  # an argmin has no derivative
            each = _off(
                points[:, None], self._rays[:, None], joints[frames][:, _STARTS], joints[frames][:, _ENDS], radii
            )
            which = each.square().sum(dim=-1).argmin(dim=1)
        starts, ends = torch.tensor(_STARTS)[which], torch.tensor(_ENDS)[which]
        return _off(points, self._rays, joints[frames, starts], joints[frames, ends], radii[which]) / self.sigma

    def kernel(self, square: Tensor) -> Tensor:
        return bisquare(square.sum(dim=-1), ROBUST) * self.weight

    def between(self, first: int, last: int) -> SurfacePoints:
        camera = self.camera if self.camera.ndim == 1 else self.camera[first:last]
        return replace(self, points=self.points[first:last], camera=camera)

    def misfit(self, motion: Motion) -> Tensor:
        """(T, 22) the median distance of a frame's points, metres, for every joint: points belong to none."""
        off = self.residual(motion).norm(dim=-1) * self.sigma
        frames, _ = torch.nonzero(self._seen, as_tuple=True)
        found = torch.full((len(self.points), motion.joints.shape[1]), torch.nan)
        for frame in frames.unique():
            found[frame] = off[frames == frame].median()
        return found


def thinned(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """About `MOST_POINTS` of points (T, N, 3) a frame, evenly: neighbours err alike, and say nothing new."""
    return points[:, :: max(points.shape[1] // MOST_POINTS, 1)]


def _off(points: Tensor, rays: Tensor, starts: Tensor, ends: Tensor, radii: Tensor) -> Tensor:
    """(..., 2) metres from capsules to points seen along unit rays: behind the side that is seen, and beside them."""
    bone = ends - starts
    share = ((points - starts) * bone).sum(dim=-1) / bone.square().sum(dim=-1).clamp(min=1e-8)
    off = points - starts - share.clamp(0.0, 1.0).unsqueeze(-1) * bone
    along = (off * rays).sum(dim=-1)
    beside = ((off - along.unsqueeze(-1) * rays).square().sum(dim=-1) + 1e-10).sqrt()
    front = ((radii.square() - beside.square()).clamp(min=0.0) + 1e-4).sqrt()
    return torch.stack([along + front, torch.relu(beside - radii)], dim=-1)
