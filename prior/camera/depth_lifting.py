"""Lifts key points of a colour image to 3D with an aligned depth image.

Stereo depth is wrong at the edge of a limb, where a pixel shows the wall behind or a mixture of the two. A depth camera
also measures the skin, not joint centres. The depth of a joint is therefore

1. that of the nearest surface in a small neighbourhood on which enough pixels agree,
2. within the reach of the bone that leads to it, from the trunk outwards, so that neither the wall nor an object in
   front of the body captures a joint,
3. moved along the ray from the skin to the joint's centre.

The root is anchored at the midpoint of the hips, where the trunk fills the neighbourhood. The distance of the hips
behind the skin depends on the trunk's orientation. From the side, the trunk hides one hip; the position of this hip is
computed from the width of the hips, on the side of the farther arm and leg. Any other joint is unobserved (NaN) if its
depth is missing, contradicts the body, or belongs to another joint.

Key points are those of COCO-17 (`prior.body.layouts.COCO17`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats, Floats32
from steadypose.prior.body.layouts import COCO17
from steadypose.prior.compiled import njit

MIN_CONFIDENCE = 0.3  # least confidence of a key point; below it, detectors guess

_K = {name: index for index, name in enumerate(COCO17.joints)}
_JOINTS = len(COCO17.joints)
_SHOULDERS = (_K["left_shoulder"], _K["right_shoulder"])
_HIPS = (_K["left_hip"], _K["right_hip"])
_TRUNK = (*_SHOULDERS, *_HIPS)
_HEAD = tuple(_K[name] for name in ("nose", "left_eye", "right_eye", "left_ear", "right_ear"))

# Distance from the visible skin to the joint's centre, metres: half the limb's thickness. Nose and eyes lie on the
# skin, ears beside the middle of the head.
_THICKNESS = {"ear": 0.05, "shoulder": 0.07, "elbow": 0.045, "wrist": 0.04, "hip": 0.12, "knee": 0.065, "ankle": 0.055}
_TO_CENTRE = np.array([_THICKNESS.get(name.split("_")[-1], 0.0) for name in COCO17.joints])

_HALF_DEPTH, _HALF_BREADTH = 0.12, 0.18
"""Half axes of the trunk's horizontal cross-section at the hips, an ellipse, metres."""
_HIP_WIDTH, _SHOULDER_WIDTH, _TRUNK_LENGTH, _TRUNK_LENGTHS = 0.35, 0.70, 0.51, (0.42, 0.60)
"""Widths of hips and shoulders, joint to joint, in lengths of the trunk (midpoint of the shoulders to midpoint of the
hips); the trunk's usual length and the accepted range, metres."""
_MAX_TURN_COSINE, _HIP_SLACK, _VISIBLE_WIDTH = np.cos(np.radians(50)), 0.03, 0.65
"""Cosine of the turn above which the far hip is hidden; tolerance of a hip's depth, given the width of the hips,
metres; share of the shoulders' width below which one shoulder is hidden."""
_TURN_EVIDENCE, _FAR_SIDE_THRESHOLD, _CONFIDENCE_EVIDENCE = 0.10, 0.5, 0.05
"""Difference in depth of both sides' arms and legs above which the nearer side is certain, metres; share of it above
which the far side counts as known; and the equivalent difference in a detector's confidence."""
_FAR_LIMBS = np.array([0.05, 0.05, -0.03, -0.03])
"""Least distance of the far elbow, wrist, knee and ankle behind the midpoint of the hips, metres."""
_TRUNK_REACH, _HEAD_REACH = 0.40, 0.50
"""Largest distances from the trunk's depth to a shoulder or hip, and from between the shoulders to the face, metres."""
_ARM, _LEG = (0.45, 0.40), (0.60, 0.60)  # largest accepted lengths of the bones of arm and leg, metres
_LIMBS = [
    ([_K[f"{side}_{joint}"] for joint in joints], lengths)
    for side in ("left", "right")
    for joints, lengths in ((("shoulder", "elbow", "wrist"), _ARM), (("hip", "knee", "ankle"), _LEG))
]
_LIMB_ENDS = [[_K[f"{side}_{joint}"] for joint in ("elbow", "wrist", "knee", "ankle")] for side in ("left", "right")]
_MIN_SEPARATION = {"ear": 0.08, "elbow": 0.06, "wrist": 0.06, "knee": 0.06, "ankle": 0.05}
"""Distance of a left and a right joint below which they are one joint detected twice, metres."""

_RADIUS, _MIN_PIXELS, _MAX_PIXELS = 0.03, 2.0, 16.0
"""Radius of the sampled disc about a key point, metres at the body, and its range in the image, pixels."""
_GRID = np.stack(np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9)), axis=-1).reshape(-1, 2)
_DISC = _GRID[np.hypot(*_GRID.T) <= 1.0]
_LINE_SAMPLES = np.linspace(0.1, 0.9, 9)
"""Positions of the samples on a line between joints, as shares of the line."""
_BAND, _BAND_GROWTH, _MIN_FILL = 0.04, 0.005, 0.25
"""Depth range of one surface, metres, and its growth with the squared distance, 1/m, like stereo noise; least share of
the neighbourhood that a surface fills."""
_HIP_SAMPLES, _HIP_SIDE_SAMPLES, _TRUNK_BAND = 2.7, 2.2, 0.25
"""Radii of the discs about the midpoint of the hips and about each hip, relative to `_RADIUS`; depth range of a leaning
or turned trunk's skin, metres."""


def lift(keypoints: Floats, confidence: Floats, depth: NDArray[Any], intrinsics: Floats) -> tuple[Floats32, Floats32]:
    """Lift the key points of the bodies in an image to 3D.

    Args:
        keypoints: (B, 17, 2) pixels of the depth image, x right and y down; NaN where missing.
        confidence: (B, 17) 0 to 1.
        depth: (H, W) along the optical axis: metres if floating, millimetres if integer (REP 118); 0 or NaN is a hole.
        intrinsics: (3, 3) camera matrix of the image, which has no distortion.

    Returns:
        Positions (B, 17, 3) metres in the optical frame (x right, y down, z forward), NaN where unobserved, and
        confidence (B, 17), 0 where unobserved.

    Raises:
        ValueError: the shapes do not match.
    """
    keypoints, confidence = np.asarray(keypoints, np.float64), np.asarray(confidence, np.float64)
    if keypoints.ndim != 3 or keypoints.shape[1:] != (_JOINTS, 2) or confidence.shape != keypoints.shape[:2]:
        raise ValueError(
            f"keypoints and confidence: expected shapes (B, {_JOINTS}, 2) and (B, {_JOINTS}), got {keypoints.shape} "
            f"and {confidence.shape}"
        )
    if depth.ndim != 2 or not depth.size or np.shape(intrinsics) != (3, 3):
        raise ValueError(
            "depth and intrinsics: expected shapes (H, W), of a pixel or more, and (3, 3), got "
            f"{depth.shape} and {np.shape(intrinsics)}"
        )
    confidence = np.clip(np.nan_to_num(confidence), 0.0, 1.0)
    intrinsics = np.asarray(intrinsics, np.float64)
    view = _View(depth, intrinsics, np.linalg.inv(intrinsics).astype(np.float64))
    height, width = depth.shape
    with np.errstate(invalid="ignore"):
        x, y = keypoints[..., 0], keypoints[..., 1]
        inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
        known = inside & (confidence >= MIN_CONFIDENCE)
    positions = np.full((*confidence.shape, 3), np.nan)
    for body in range(len(keypoints)):
        positions[body] = _lift_body(np.where(known[body, :, None], keypoints[body], np.nan), confidence[body], view)
    observed = np.isfinite(positions).all(axis=-1)
    return positions.astype(np.float32), np.where(observed, confidence, 0.0).astype(np.float32)


@dataclass(frozen=True)
class _View:
    """A depth image and its camera."""

    depth: NDArray[Any]
    intrinsics: Floats
    unprojection: Floats  # (3, 3) the inverse of the intrinsics

    def sample(self, pixels: Floats) -> Floats:
        """Metres of depth at the pixels (..., 2) nearest to these; NaN in holes, outside, and at NaN."""
        height, width = self.depth.shape
        nearest = np.rint(pixels)
        x, y = nearest[..., 0], nearest[..., 1]
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        at = np.where(inside[..., None], nearest, 0).astype(np.intp)
        metres = self.depth[at[..., 1], at[..., 0]].astype(np.float64)
        if self.depth.dtype.kind in "iu":
            metres /= 1000
        return np.where(inside & (metres > 0) & (metres < np.inf), metres, np.nan)

    def rays(self, pixels: Floats) -> Floats:
        """(..., 3) unit vectors through pixels (..., 2), optical frame."""
        rays = pixels @ self.unprojection[:, :2].T + self.unprojection[:, 2]
        return rays / np.sqrt((rays * rays).sum(axis=-1, keepdims=True))


def _lift_body(pixels: Floats, confidence: Floats, view: _View) -> Floats:
    """(17, 3) metres from key points (17, 2), NaN where unobserved."""
    positions = np.full((_JOINTS, 3), np.nan)
    trunk = _trunk_depth(pixels, view)
    if not np.isfinite(trunk):
        return positions
    rays = view.rays(pixels)
    radius = np.clip(_RADIUS * view.intrinsics[0, 0] / trunk, _MIN_PIXELS, _MAX_PIXELS)
    samples = view.sample(pixels[:, None] + radius * _DISC)

    for joint in _TRUNK:
        skin = _surface(samples[joint], trunk - _TRUNK_REACH, trunk + _TRUNK_REACH)
        positions[joint] = _behind(rays[joint], skin, _TO_CENTRE[joint])
    chest = _mean(positions, _SHOULDERS)
    hips = _Hips.find(pixels, chest, trunk, radius, view)
    if hips:
        positions[list(_HIPS)] = hips.middle

    def follow(joints: Sequence[int], lengths: Sequence[float], origin: Floats) -> None:
        """Place the joints of a chain, each within reach of the last one placed."""
        reach = 0.0
        for joint, length in zip(joints, lengths, strict=True):
            reach += length
            skin = _surface(samples[joint], *_skin_in_reach(rays[joint], origin, reach, _TO_CENTRE[joint]))
            if np.isfinite(skin):
                positions[joint] = origin = _behind(rays[joint], skin, _TO_CENTRE[joint])
                reach = 0.0

    middle = _mean(positions, _TRUNK)
    for joint in _HEAD:
        follow([joint], [_HEAD_REACH], chest if np.isfinite(chest).all() else middle)
    for (start, *joints), lengths in _LIMBS:
        if np.isfinite(positions[start]).all():
            follow(joints, lengths, positions[start])
        else:
            follow(joints, [lengths[0] + _TRUNK_REACH, *lengths[1:]], middle)
    turn = _turn(positions, confidence)
    if hips:
        positions[list(_HIPS)] = hips.places(turn)
        if hips.turned and abs(turn) > _FAR_SIDE_THRESHOLD:
            # a surface that is not behind the middle of the trunk is the trunk or the other limb, which hides this one
            far = _LIMB_ENDS[0 if turn > 0 else 1]
            hidden = positions[far, 2] < hips.middle[2] + _FAR_LIMBS
            positions[np.array(far)[hidden]] = np.nan
    _drop_doubles(positions, confidence, turn, _SHOULDER_WIDTH * (hips.trunk if hips else _TRUNK_LENGTH))
    return positions


@dataclass(frozen=True)
class _Hips:
    """The root: the midpoint of the hips, which determines both hips."""

    middle: Floats  # (3,) metres
    trunk: float  # metres, middle of the shoulders to middle of the hips
    rays: Floats  # (2, 3) through the left and the right hip
    beside: float  # metres from hip to hip across the line of sight
    measured: float  # metres by which the left hip's skin is farther; NaN if either is not visible

    @classmethod
    def find(cls, pixels: Floats, chest: Floats, trunk: float, radius: float, view: _View) -> _Hips | None:
        """From key points (17, 2), the middle of the shoulders (3,) and the depth of the trunk."""
        both = pixels[list(_HIPS)]
        centre = both.mean(axis=0)
        # the disc is wider than an arm in front of the hips: of two surfaces, the trunk is the one behind
        samples = view.sample(centre + _HIP_SAMPLES * radius * _DISC)
        skin = -_surface(-samples, -trunk - _TRUNK_REACH, -trunk + _TRUNK_REACH)
        if not np.isfinite(skin):
            return None
        rays = view.rays(both)
        flat = rays * (skin / rays[:, 2:])
        beside = float(np.linalg.norm(flat[0] - flat[1]))
        ray = view.rays(centre)
        length = np.linalg.norm(chest - _behind(ray, skin, _HALF_DEPTH))
        length = float(np.clip(length, *_TRUNK_LENGTHS)) if np.isfinite(length) else _TRUNK_LENGTH
        # an ellipse's radius along the line of sight
        cosine = min(beside / (_HIP_WIDTH * length), 1.0)
        sine = np.sqrt(1 - cosine**2)
        thickness = _HALF_DEPTH * _HALF_BREADTH / np.hypot(_HALF_BREADTH * cosine, _HALF_DEPTH * sine)
        left, right = (
            _surface(view.sample(hip + _HIP_SIDE_SAMPLES * radius * _DISC), trunk - _TRUNK_REACH, trunk + _TRUNK_REACH)
            for hip in both
        )
        return cls(_behind(ray, skin, float(thickness)), length, rays, beside, left - right)

    @property
    def turned(self) -> bool:
        """Whether the camera looks at the trunk from its side."""
        return self.beside < _MAX_TURN_COSINE * _HIP_WIDTH * self.trunk

    def places(self, turn: float) -> Floats:
        """(2, 3) metres: both hips, on their rays. ``turn`` as from `_turn`."""
        width = _HIP_WIDTH * self.trunk
        apart = np.sqrt(max(width**2 - self.beside**2, 0.0))
        if not self.turned and np.isfinite(self.measured):
            farther = float(np.clip(self.measured, -apart - _HIP_SLACK, apart + _HIP_SLACK))
        else:
            farther = turn * apart
        depths = self.middle[2] + np.array([farther, -farther]) / 2
        return self.rays * (depths / self.rays[:, 2])[:, None]


def _trunk_depth(pixels: Floats, view: _View) -> float:
    """Depth of the trunk's skin, metres: the surface that covers most of the lines between shoulders and hips.

    With fewer than two of these, all key points are used instead.
    """
    known = [joint for joint in _TRUNK if np.isfinite(pixels[joint]).all()]
    ends = list(combinations(known, 2)) or [(joint, joint) for joint in range(_JOINTS)]
    first, second = pixels[[a for a, _ in ends]], pixels[[b for _, b in ends]]
    samples = view.sample(first[:, None] + _LINE_SAMPLES[:, None] * (second - first)[:, None])
    samples = np.sort(samples[np.isfinite(samples)])
    if not len(samples):
        return np.nan
    last = np.searchsorted(samples, samples + _TRUNK_BAND, side="right")
    start = int(np.argmax(last - np.arange(len(samples))))
    return float(samples[(start + last[start]) // 2])


@njit("f8(f8[::1], f8, f8)", cache=True)
def _surface(samples: Floats, low: float, high: float) -> float:
    """Depth of the nearest surface from ``low`` to ``high`` that fills enough of the samples (S,), or NaN."""
    least = max(_MIN_FILL * len(samples), 3.0)
    depths = np.sort(samples[(samples >= low) & (samples <= high)])
    if len(depths) < least:
        return np.nan
    band = _BAND + _BAND_GROWTH * depths[0] ** 2
    best, best_count, until = 0, 0, np.inf
    last = 0
    for first in range(len(depths)):
        if depths[first] > until:
            break
        while last < len(depths) and depths[last] <= depths[first] + band:
            last += 1
        if last - first >= least and until == np.inf:
            # pixels that mix two depths lie in front of a surface; its depth is where most pixels agree
            until = depths[first] + band
        if until < np.inf and last - first > best_count:
            best, best_count = first, last - first
    return depths[best + best_count // 2] if best_count else np.nan


def _skin_in_reach(ray: Floats, origin: Floats, reach: float, to_centre: float) -> tuple[float, float]:
    """Depths between which a joint's skin lies if the joint is on ``ray`` (3,) and in reach of ``origin`` (3,)."""
    along = float(ray @ origin)
    beside = float(origin @ origin) - along**2
    if not beside <= reach**2:
        return np.inf, -np.inf  # the ray passes out of reach
    half = math.sqrt(reach**2 - beside)
    return (along - half - to_centre) * float(ray[2]), (along + half - to_centre) * float(ray[2])


def _behind(ray: Floats, skin: float, to_centre: float) -> Floats:
    """(3,) the point on a ray (3,) that lies ``to_centre`` metres behind the skin at this depth."""
    return ray * (skin / ray[2] + to_centre)


def _turn(positions: Floats, confidence: Floats) -> float:
    """Return the farther side of a body that stands sideways: 1 left, -1 right, 0 unknown, between if uncertain.

    It is that of the farther arm and leg, or if these hide each other, of the joints with less confidence.
    """
    left, right = positions[_LIMB_ENDS[0]], positions[_LIMB_ENDS[1]]
    distinct = np.linalg.norm(left - right, axis=-1) > max(_MIN_SEPARATION.values())
    if distinct.any():
        evidence = float((left - right)[distinct, 2].mean())
        if abs(evidence) > _TURN_EVIDENCE / 3:
            return float(np.clip(evidence / _TURN_EVIDENCE, -1, 1))
    difference = float((confidence[_LIMB_ENDS[1]] - confidence[_LIMB_ENDS[0]]).mean())
    return float(np.sign(difference)) if abs(difference) > _CONFIDENCE_EVIDENCE else 0.0


def _drop_doubles(positions: Floats, confidence: Floats, turn: float, shoulder_width: float) -> None:
    """Remove the hidden one of coincident left and right joints: that of the far side, or the less confident one."""
    apart = _MIN_SEPARATION | {"shoulder": _VISIBLE_WIDTH * shoulder_width}
    for name, least in apart.items():
        left, right = _K[f"left_{name}"], _K[f"right_{name}"]
        if np.linalg.norm(positions[left] - positions[right]) < least:
            left_goes = turn > 0 if abs(turn) > _FAR_SIDE_THRESHOLD else confidence[left] < confidence[right]
            positions[left if left_goes else right] = np.nan


def _mean(positions: Floats, joints: Sequence[int]) -> Floats:
    """(3,) mean of the known joints among these; NaN if none is known."""
    chosen = positions[list(joints)]
    known = np.isfinite(chosen).all(axis=-1)
    return chosen[known].mean(axis=0) if known.any() else np.full(3, np.nan)
