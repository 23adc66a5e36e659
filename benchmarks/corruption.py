"""Corrupts true joints for the studies: noise and hidden joints. Functions take and return (T, C, J, 3) metres.

Hidden joints are NaN. The functions draw from the generator that you pass and change nothing in place.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import MIRROR, J, limbs
from steadypose.prior.sim.camera import segment_gap
from steadypose.prior.sim.noise import time_correlated

Mask = NDArray[np.bool_]

LIMBS = (*limbs(("elbow", "wrist")), *limbs(("knee", "ankle", "foot")))
"""Limbs that a detector loses or swaps: lower arms and legs."""


def gaussian(truth: Floats, sigma: float, rng: np.random.Generator) -> Floats:
    """Add independent noise of ``sigma`` metres along each axis (0.04 in HuMoR's protocol)."""
    return truth + rng.normal(0.0, sigma, truth.shape)


def along_sight(truth: Floats, sigma: float, rng: np.random.Generator) -> Floats:
    """Add independent noise like depth errors: ``sigma`` metres across the line of sight of a camera at the origin, and
    three times as much along it."""
    noise = rng.normal(0.0, sigma, truth.shape)
    sight = truth / np.linalg.norm(truth, axis=-1, keepdims=True)
    return truth + noise + 2 * (noise * sight).sum(axis=-1, keepdims=True) * sight


def correlated(truth: Floats, sigma: float, rng: np.random.Generator, memory: float = 0.9) -> Floats:
    """Add stationary AR(1) noise of ``sigma`` metres, with correlation ``memory`` between frames.

    It resembles a depth camera's errors, which no low-pass filter separates from motion.
    """
    return truth + time_correlated(rng.normal(0.0, sigma, truth.shape), memory)


def spiked(seen: Floats, rng: np.random.Generator, share: float = 0.01, size: float = 0.30) -> Floats:
    """Displace one observation in a hundred by 30 cm, in a random direction."""
    direction = rng.normal(size=seen.shape)
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    hit = rng.random(seen.shape[:-1]) < share
    return np.where(hit[..., None], seen + size * direction, seen)


def swapped(seen: Floats, rng: np.random.Generator, rate: float = 0.02, mean_frames: float = 3.0) -> Floats:
    """Swap left and right lower arms, or legs, for a few frames; ``rate`` is the number of swaps that begin per
    frame."""
    frames, clips = seen.shape[:2]
    out = seen.copy()
    for left, right in zip(LIMBS[::2], LIMBS[1::2], strict=True):
        on = np.zeros((frames, clips), dtype=bool)
        begins = rng.random((frames, clips)) < rate
        lasts = rng.geometric(1 / mean_frames, (frames, clips))
        for t, c in zip(*np.nonzero(begins), strict=True):
            on[t : t + lasts[t, c], c] = True
        joints = np.concatenate([left, right])
        out[:, :, joints] = np.where(on[..., None, None], seen[:, :, MIRROR[joints]], seen[:, :, joints])
    return out


def below(truth: Floats, height: float = 0.9) -> Mask:
    """Return the joints (T, C, J) lower than ``height`` metres (HuMoR's occlusion)."""
    return truth[..., 2] < height


def arm_behind(truth: Floats, radius: float = 0.16) -> Mask:
    """Return the elbows and wrists (T, C, J) that the trunk hides from a camera 3 m to the body's left, 1.2 m up.

    The trunk is a capsule of ``radius`` metres from pelvis to neck. The camera is placed relative to the body in the
    middle of the clip.
    """
    middle = truth[len(truth) // 2]
    left = middle[:, J["left_hip"]] - middle[:, J["right_hip"]]
    left[:, 2] = 0.0
    camera = middle[:, J["pelvis"]] + 3.0 * left / np.linalg.norm(left, axis=-1, keepdims=True)
    camera[:, 2] = 1.2
    arms = LIMBS[0] + LIMBS[1]
    points = truth[:, :, arms]
    trunk = (truth[:, :, J[end], None] for end in ("pelvis", "neck"))
    gap, along = segment_gap(np.broadcast_to(camera[:, None], points.shape), points, *trunk)
    hidden = np.zeros(truth.shape[:-1], dtype=bool)
    hidden[..., arms] = (gap < radius) & (along < 1.0)
    return hidden


def bursts(shape: tuple[int, int, int], frames: int, first: int, rng: np.random.Generator) -> Mask:
    """Hide one limb of every clip for ``frames`` frames, (T, C, J). It starts at a random time from frame ``first`` on
    and ends at least a third of a second before the clip does."""
    hidden = np.zeros(shape, dtype=bool)
    starts = rng.integers(first, shape[0] - frames - 10, endpoint=True, size=shape[1])
    hit = rng.integers(len(LIMBS), size=shape[1])
    for clip, (start, limb) in enumerate(zip(starts, hit, strict=True)):
        hidden[start : start + frames, clip, LIMBS[limb]] = True
    return hidden


def hide(seen: Floats, hidden: Mask) -> Floats:
    """Set hidden joints to NaN."""
    return np.where(hidden[..., None], np.nan, seen)
