"""Observations as terms of the energy: joints in space, key points of a picture, points of a body's surface."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import torch
from torch import Tensor

from steadypose.prior.body.skeleton import J
from steadypose.prior.offline.energy import Term, bisquare, geman_mcclure, huber
from steadypose.prior.offline.motion import Motion
from steadypose.prior.sim.body import CAPSULES, REST_HEIGHT, stature

ROBUST = 5.0
"""Standard deviations from which on a key point or a point of the surface counts as an outlier."""

CLEAR = 3.0
"""Standard deviations from which on a joint in space pulls no harder; none is given up: there may be no other."""

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
    """E_data of key points in a picture, weighted by their confidence, under Geman's and McClure's kernel.

    Attributes:
        pixels: (T, 22, 2); NaN where not found.
        confidence: (T, 22) 0 to 1, a weight as in the paper; its square is the official code's.
        camera: of the picture.
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
    """E_data of points of a depth camera: the distance of each from the nearest capsule about a bone.

    Attributes:
        points: (T, N, 3) metres, world; NaN where there are fewer.
        sigma: metres.
    """

    points: Tensor
    sigma: float = POINT_SIGMA

    @cached_property
    def _seen(self) -> Tensor:
        return torch.isfinite(self.points).all(dim=-1)

    def residual(self, motion: Motion) -> Tensor:
        frames, _ = torch.nonzero(self._seen, as_tuple=True)
        points, joints = self.points[self._seen], motion.world_joints
        radii = _RADII.to(joints.dtype) * (stature(motion.offsets.detach().numpy()) / REST_HEIGHT)
        with torch.no_grad():  # an argmin has no derivative
            nearest = _distance(points.unsqueeze(1), joints[frames][:, _STARTS], joints[frames][:, _ENDS], radii)
            which = nearest.abs().argmin(dim=1)
        starts, ends = torch.tensor(_STARTS)[which], torch.tensor(_ENDS)[which]
        return _distance(points, joints[frames, starts], joints[frames, ends], radii[which]) / self.sigma

    def kernel(self, square: Tensor) -> Tensor:
        return bisquare(square, ROBUST)

    def between(self, first: int, last: int) -> SurfacePoints:
        return SurfacePoints(self.points[first:last], self.sigma)

    def misfit(self, motion: Motion) -> Tensor:
        """(T, 22) the median distance of a frame's points, metres, for every joint: points belong to none."""
        off = self.residual(motion) * self.sigma
        frames, _ = torch.nonzero(self._seen, as_tuple=True)
        found = torch.full((len(self.points), motion.joints.shape[1]), torch.nan)
        for frame in frames.unique():
            found[frame] = off[frames == frame].abs().median()
        return found


def _distance(points: Tensor, starts: Tensor, ends: Tensor, radii: Tensor) -> Tensor:
    """(...) signed distance to capsules, metres, negative inside."""
    bone = ends - starts
    along = ((points - starts) * bone).sum(dim=-1) / bone.square().sum(dim=-1).clamp(min=1e-8)
    nearest = starts + along.clamp(0.0, 1.0).unsqueeze(-1) * bone
    return ((points - nearest).square().sum(dim=-1) + 1e-10).sqrt() - radii
