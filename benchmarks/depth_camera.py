"""Simulates a stereo depth camera: renders people in a room, with the errors of stereo matching.

Errors are simulated on disparity, so that they grow with the square of the distance. They are spatially correlated
noise, quantisation to a fraction of a pixel, bleeding edges (the matcher's window spans both sides), half-occlusion
(pixels that only one of the two cameras observes), and holes without a match.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats
from steadypose.prior.body.capsules import CAPSULES, REST_HEIGHT, stature
from steadypose.prior.body.skeleton import J


@dataclass(frozen=True)
class Stereo:
    """A depth camera and its errors, in pixels: size of the image, focal length, standard deviation and quantisation
    of disparity, side of the matcher's window; ``baseline`` is the distance between the two cameras, metres, ``holes``
    the share of the image without a match."""

    width: int = 640
    height: int = 400
    focal: float = 455.0
    baseline: float = 0.075
    noise: float = 0.12
    step: float = 1 / 8
    window: int = 7
    holes: float = 0.03

    @property
    def intrinsics(self) -> Floats:
        """Camera matrix (3, 3), without distortion."""
        centre = (self.width - 1) / 2, (self.height - 1) / 2
        return np.array([[self.focal, 0.0, centre[0]], [0.0, self.focal, centre[1]], [0.0, 0.0, 1.0]])

    def project(self, points: Floats) -> Floats:
        """Project points (..., 3) in the optical frame to pixels (..., 2)."""
        image = points @ self.intrinsics.T
        return image[..., :2] / image[..., 2:]


def room(camera: Stereo, height: float, wall: float) -> Floats:
    """Return the depth (H, W) of an empty room, metres, for a level camera ``height`` metres above the floor before a
    ``wall`` so many metres away.
    """
    down = _rays(camera)[..., 1]
    with np.errstate(divide="ignore"):
        return np.where(down > 0, np.minimum(height / down, wall), wall)


def render(people: Sequence[tuple[Floats, Floats]], camera: Stereo, background: Floats) -> Floats:
    """Render the depth (H, W) of people in front of a background (H, W), metres along the optical axis, without errors.

    Each of the people has joints (22, 3) metres in the optical frame, and bones (22, 3), which determine the limbs'
    radii.
    """
    depth = background.copy()
    rays = _rays(camera)
    for joints, offsets in people:
        scale = stature(offsets) / REST_HEIGHT
        for first, second, radius in CAPSULES:
            ends = joints[[J[first], J[second]]]
            start, end = ends
            if ends[:, 2].min() < 0.2:
                continue
            reach = camera.focal * radius * scale / (ends[:, 2].min() - radius * scale) + 2
            box = camera.project(ends)
            x0, y0 = np.maximum(np.floor(box.min(axis=0) - reach), 0).astype(int)
            x1, y1 = np.ceil(box.max(axis=0) + reach).astype(int)
            part = np.s_[y0 : max(y1, 0), x0 : max(x1, 0)]
            depth[part] = np.minimum(depth[part], _capsule(rays[part], start, end, radius * scale))
    return depth


def corrupt(depth: Floats, camera: Stereo, rng: np.random.Generator) -> NDArray[np.uint16]:
    """Add stereo errors to depth (H, W) in metres; returns millimetres, 0 where there is no measurement."""
    import cv2  # from an extra, which rendering without errors does not need

    disparity = camera.focal * camera.baseline / depth
    # the matcher's window takes the nearer side on one side of an edge and both on the other
    half = camera.window // 2
    fat, mixed = cv2.dilate(disparity, np.ones((half + 1, half + 1))), cv2.blur(disparity, (half, half))
    mood = _texture(depth.shape, 4.0, rng)
    seen = np.where(mood > 0.3, fat, np.where(mood < -0.6, mixed, disparity))
    seen += camera.noise * (0.8 * _texture(depth.shape, 2.0, rng) + 0.6 * rng.standard_normal(depth.shape))
    seen = np.round(seen / camera.step) * camera.step
    # observed by the left camera only: hidden from the right one by something to the right
    column = np.arange(camera.width) - disparity
    ahead = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
    hidden = np.zeros(depth.shape, bool)
    hidden[:, :-1] = ahead[:, 1:] <= column[:, :-1]
    unmatched = _texture(depth.shape, 3.0, rng)
    hidden |= unmatched > np.quantile(unmatched, 1 - camera.holes)
    with np.errstate(divide="ignore"):
        metres = camera.focal * camera.baseline / seen
    return np.where(hidden | (seen <= 0), 0, np.clip(1000 * metres, 0, 65535)).astype(np.uint16)


@cache
def _rays(camera: Stereo) -> Floats:
    """Return the rays (H, W, 3) with z = 1."""
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1)
    return pixels @ np.linalg.inv(camera.intrinsics).T


def _texture(shape: tuple[int, ...], size: float, rng: np.random.Generator) -> Floats:
    """Return noise of unit variance, correlated over about ``size`` pixels."""
    import cv2

    noise = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), size)
    return noise / noise.std()


def _capsule(rays: Floats, start: Floats, end: Floats, radius: float) -> Floats:
    """Return the depth (...) at which rays (..., 3), from the origin with z = 1, enter a capsule; infinite if they
    miss."""
    axis = end - start
    along, length = rays @ axis, axis @ axis
    best = np.full(rays.shape[:-1], np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        # the cylinder: the components of ray and centre across the axis
        a = (rays * rays).sum(-1) * length - along**2
        b = length * (rays @ -start) - along * (axis @ -start)
        c = length * (start @ start) - (axis @ -start) ** 2 - radius**2 * length
        t = (-b - np.sqrt(b * b - a * c)) / a
        share = (t * along - axis @ start) / length
        best = np.where((share > 0) & (share < 1), t, best)
        for centre in (start, end):
            a, b = (rays * rays).sum(-1), rays @ centre
            t = (b - np.sqrt(b * b - a * (centre @ centre - radius**2))) / a
            best = np.where(np.isfinite(t), np.minimum(best, t), best)
    return np.where(np.isfinite(best), best, np.inf)
