"""Corrupts true joints for the studies. Functions draw from the generator that you pass and change nothing in place.

Noise and hidden joints (NaN) are of (T, C, J, 3) metres. The test cases of HG-VAE's anomaly score (`FAULTS`), tracking
faults and transformations of motion that are no faults, are of windows (B, T, 22, 3).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import MIRROR, PARENTS, J, limbs
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


def sides_exchanged(seen: Floats, rng: np.random.Generator, frames: int = 30, first: int = 20) -> Floats:
    """Exchange left and right of every clip's whole body for ``frames`` frames. It starts at a random time from frame
    ``first`` on and ends at least a third of a second before the clip does."""
    starts = rng.integers(first, len(seen) - frames - 10, endpoint=True, size=seen.shape[1])
    time = np.arange(len(seen))[:, None]
    on = (time >= starts) & (time < starts + frames)
    return np.where(on[..., None, None], seen[:, :, MIRROR], seen)


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
    return np.where(hidden[..., None], np.nan, seen)


Fault = Callable[[Floats, np.random.Generator], tuple[Floats, NDArray[np.bool_]]]
"""Maps clean windows (B, T, 22, 3) to corrupted ones, and returns which of them (B,) contain the fault."""

HELD = "a joint frozen"
BEGINS = 20  # frame in which a fault begins; it lasts to the window's end
MIN_MOTION = 0.10
"""Least motion of a frozen joint, metres; with less, it is indistinguishable from a still one."""

_ARM, _LEG, *_ = limbs(("elbow", "wrist"), ("knee", "ankle", "foot"))
_WHOLE_ARM, _WHOLE_LEG, *_ = limbs(("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle", "foot"))
_MOVERS = np.concatenate(limbs(("elbow", "wrist", "knee", "ankle")))


def _all(windows: Floats) -> NDArray[np.bool_]:
    return np.ones(len(windows), dtype=bool)


def noise(windows: Floats, rng: np.random.Generator, sigma: float) -> tuple[Floats, NDArray[np.bool_]]:
    return windows + rng.normal(0.0, sigma, windows.shape), _all(windows)


def exchanged(windows: Floats, rng: np.random.Generator, limb: list[int]) -> tuple[Floats, NDArray[np.bool_]]:
    """Swap limbs of both sides from `BEGINS` on; this counts as a fault only where they are apart."""
    both = np.array([*limb, *MIRROR[limb]])
    out = windows.copy()
    out[:, BEGINS:, both] = windows[:, BEGINS:, MIRROR[both]]
    return out, np.linalg.norm(out - windows, axis=-1).max(axis=(1, 2)) > MIN_MOTION


def frozen(windows: Floats, rng: np.random.Generator) -> tuple[Floats, NDArray[np.bool_]]:
    """Freeze a moving joint at its position in the frame before `BEGINS`."""
    return held(windows, windows, rng)


def held(seen: Floats, windows: Floats, rng: np.random.Generator) -> tuple[Floats, NDArray[np.bool_]]:
    """Freeze a joint of noisy observations ``seen`` of ``windows``: the tracker repeats its last output."""
    out = seen.copy()
    moved = np.linalg.norm(windows[:, BEGINS:] - windows[:, BEGINS - 1 : BEGINS], axis=-1)[..., _MOVERS].max(axis=1)
    for k, by in enumerate(moved):
        joint = _MOVERS[rng.choice(np.flatnonzero(by > MIN_MOTION))] if (by > MIN_MOTION).any() else _MOVERS[0]
        out[k, BEGINS:, joint] = seen[k, BEGINS - 1, joint]
    return out, (moved > MIN_MOTION).any(axis=1)


def other_skeleton(windows: Floats, rng: np.random.Generator) -> tuple[Floats, NDArray[np.bool_]]:
    """Scale bone lengths independently by 0.6 to 1.6: another person's skeleton."""
    out = windows.copy()
    factor = np.exp(rng.uniform(np.log(0.6), np.log(1.6), (len(windows), 22)))
    for joint, parent in enumerate(PARENTS[1:], start=1):
        out[:, :, joint] = out[:, :, parent] + factor[:, None, joint, None] * (
            windows[:, :, joint] - windows[:, :, parent]
        )
    return out, _all(windows)


def other_persons_limb(windows: Floats, rng: np.random.Generator) -> tuple[Floats, NDArray[np.bool_]]:
    """Replace an arm from `BEGINS` on by another person's, half a metre away."""
    out = windows.copy()
    other = windows[rng.permutation(len(windows))]
    beside = windows[:, BEGINS:, :1] - other[:, BEGINS:, :1] + rng.normal(0.0, 0.3, (len(windows), 1, 1, 3))
    out[:, BEGINS:, _ARM] = other[:, BEGINS:, _ARM] + beside
    return out, _all(windows)


def relabelled(windows: Floats, rng: np.random.Generator) -> tuple[Floats, NDArray[np.bool_]]:
    """Swap left and right everywhere: the knees bend the wrong way."""
    return windows[:, :, MIRROR], _all(windows)


def mirrored(windows: Floats, rng: np.random.Generator) -> tuple[Floats, NDArray[np.bool_]]:
    """Mirror the motion: no fault."""
    return windows[:, :, MIRROR] * np.array([1.0, -1.0, 1.0]), _all(windows)


def in_depth(windows: Floats, rng: np.random.Generator, limb: list[int]) -> tuple[Floats, NDArray[np.bool_]]:
    """Place people 3 m from a camera at the origin, and mirror a limb (its root first) about the image plane from
    `BEGINS` on; this counts as a fault only where it moves a joint."""
    placed = windows - windows[:, :1, :1] + np.array([3.0, 0.0, 0.0])
    out, root = placed.copy(), placed[:, BEGINS:, limb[:1]]
    ray = root / np.linalg.norm(root, axis=-1, keepdims=True)
    out[:, BEGINS:, limb] -= 2 * ((placed[:, BEGINS:, limb] - root) * ray).sum(axis=-1, keepdims=True) * ray
    return out, np.linalg.norm(out - placed, axis=-1).max(axis=(1, 2)) > MIN_MOTION


def reversed_in_time(windows: Floats, rng: np.random.Generator) -> tuple[Floats, NDArray[np.bool_]]:
    """Play backwards: usually no fault."""
    return windows[:, ::-1].copy(), _all(windows)


FAULTS: Mapping[str, Fault] = {
    **{f"noise of {s} cm": partial(noise, sigma=s / 100) for s in (1, 2, 4, 8)},
    "arms exchanged": partial(exchanged, limb=_ARM),
    "legs exchanged": partial(exchanged, limb=_LEG),
    HELD: frozen,  # the study repeats what was observed, including its noise
    "a joint at rest that should move": frozen,
    "left taken for right": relabelled,
    "another skeleton": other_skeleton,
    "another person's arm": other_persons_limb,
    "mirrored (no fault)": mirrored,
    "backwards (no fault)": reversed_in_time,
}

FAULTS_IN_DEPTH: Mapping[str, Fault] = {
    "arm mirrored in depth": partial(in_depth, limb=_WHOLE_ARM),
    "leg mirrored in depth": partial(in_depth, limb=_WHOLE_LEG),
}
"""Faults that depend on the place of the camera."""
