"""Observations as terms of the energy: joints in space, key points of an image, points of a body's surface."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import torch
from torch import Tensor

from steadypose.prior.arrays import Floats
from steadypose.prior.body.capsules import CAPSULES, REST_HEIGHT, stature
from steadypose.prior.body.skeleton import J
from steadypose.prior.fit.energy import Term, bisquare, geman_mcclure, huber
from steadypose.prior.fit.motion import Motion

ROBUST = 5.0  # residual above which a key point or a point of the surface is an outlier, standard deviations

CLEAR = 3.0
"""Residual above which the pull of a 3D joint is constant, standard deviations. No joint is ignored altogether."""

MOST_POINTS = 200  # largest number of surface points per frame that are fitted

POINT_SHARE = 0.03
"""Weight of a surface point if there are 3D joints. The errors of capsules and of a depth camera are correlated in
space and time, so many points in many frames would outweigh correct joints (benchmarks/NOTEBOOK.md)."""

POINT_SIGMA = 0.05
"""Standard deviation of surface points, metres: error of a depth camera at five metres, and of capsules as a body
model. Limbs are attracted by points within `ROBUST` times this distance."""


class Observed(Term, Protocol):
    """Observations of T frames."""

    def between(self, first: int, last: int) -> Observed:
        """Return the observations of the frames ``first`` to ``last - 1``."""
        ...

    def misfit(self, motion: Motion) -> Tensor:
        """(T, 22) distance of each joint from its observation, metres or pixels; NaN if there is none."""
        ...


@dataclass(frozen=True)
class SeenJoints:
    """E_data of 3D joints or key points, some of them hidden."""

    positions: Tensor  # (T, 22, 3) metres, world; NaN where unobserved
    sigma: Tensor  # (T, 22) metres along an axis, standard deviations

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
    """A fixed pinhole camera."""

    focal: Tensor  # (2,) pixels
    centre: Tensor  # (2,) pixels
    rotation: Tensor  # (3, 3) rotation from its optical frame (x right, y down, z forward) to the world
    position: Tensor  # (3,) metres, world

    def project(self, points: Tensor) -> Tensor:
        """(..., 2) pixels of points (..., 3) metres, world; depths are at least 0.1 m."""
        seen = (points - self.position) @ self.rotation
        return seen[..., :2] / seen[..., 2:].clamp(min=0.1) * self.focal + self.centre


@dataclass(frozen=True)
class KeyPoints:
    """E_data of key points in an image, weighted by their confidence, with the Geman-McClure kernel."""

    pixels: Tensor  # (T, 22, 2); NaN where not detected
    confidence: Tensor  # (T, 22) 0 to 1, the weight, as in the paper; the official code uses its square
    camera: Pinhole  # the camera
    sigma: float  # pixels along an axis, standard deviation

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
    """E_data of a depth camera's points: the distance of each from the visible side of the nearest bone's capsule.

    A camera measures only the side of a body that faces it. With the distance from a closed surface, a point that is
    behind a limb's centre because of noise would attract the limb's back side, and the points in front would then bias
    the body.
    """

    points: Tensor  # (T, N, 3) metres, world, padded with NaN
    camera: Tensor  # (3,) or (T, 3) metres, world, position of the camera
    sigma: float = POINT_SIGMA  # metres, standard deviation
    weight: float = 1.0  # weight of a point, below 1 because neighbouring errors are correlated

    @cached_property
    def _seen(self) -> Tensor:
        return torch.isfinite(self.points).all(dim=-1)

    @cached_property
    def _rays(self) -> Tensor:
        """(P, 3) unit vectors from the camera to the observed points."""
        away = (self.points - self.camera.reshape(-1, 1, 3))[self._seen]
        return away / away.norm(dim=-1, keepdim=True)

    def residual(self, motion: Motion) -> Tensor:
        """(P, 2) residuals along the ray and across it."""
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
        """(T, 22) median distance of a frame's points, metres, equal for all joints, as points belong to no joint."""
        off = self.residual(motion).norm(dim=-1) * self.sigma
        frames, _ = torch.nonzero(self._seen, as_tuple=True)
        found = torch.full((len(self.points), motion.joints.shape[1]), torch.nan)
        for frame in frames.unique():
            found[frame] = off[frames == frame].median()
        return found


def thinned(points: Floats) -> Floats:
    """Thin points (T, N, 3) evenly to about `MOST_POINTS` per frame; neighbours with correlated errors add little."""
    return points[:, :: max(points.shape[1] // MOST_POINTS, 1)]


def _off(points: Tensor, rays: Tensor, starts: Tensor, ends: Tensor, radii: Tensor) -> Tensor:
    """(..., 2) metres from capsules to points along unit rays: behind the visible side, and beside the capsules."""
    bone = ends - starts
    share = ((points - starts) * bone).sum(dim=-1) / bone.square().sum(dim=-1).clamp(min=1e-8)
    off = points - starts - share.clamp(0.0, 1.0).unsqueeze(-1) * bone
    along = (off * rays).sum(dim=-1)
    beside = ((off - along.unsqueeze(-1) * rays).square().sum(dim=-1) + 1e-10).sqrt()
    front = ((radii.square() - beside.square()).clamp(min=0.0) + 1e-4).sqrt()
    return torch.stack([along + front, torch.relu(beside - radii)], dim=-1)
