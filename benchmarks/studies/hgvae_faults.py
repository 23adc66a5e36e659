"""Test cases of HG-VAE's anomaly score: tracking faults, and transformations of motion that are no faults."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import MIRROR, PARENTS, limbs

Fault = Callable[[Floats, np.random.Generator], tuple[Floats, NDArray[np.bool_]]]
"""Maps clean windows (B, T, 22, 3) to corrupted ones, and returns which of them (B,) contain the fault."""

HELD = "a joint frozen"
BEGINS = 20
"""Frame in which a fault begins; it lasts to the window's end."""
MIN_MOTION = 0.10
"""Least motion of a frozen joint, metres; with less, it is indistinguishable from a still one."""

_ARM, _LEG, *_ = limbs(("elbow", "wrist"), ("knee", "ankle", "foot"))
_WHOLE_ARM, _WHOLE_LEG, *_ = limbs(("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle", "foot"))
_MOVERS = np.concatenate(limbs(("elbow", "wrist", "knee", "ankle")))


def _all(windows: Floats) -> NDArray[np.bool_]:
    return np.ones(len(windows), dtype=bool)


def noise(windows: Floats, rng: np.random.Generator, sigma: float) -> tuple[Floats, NDArray[np.bool_]]:
    """Add independent noise along each axis."""
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
