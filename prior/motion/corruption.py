"""What cameras and trackers do to a window, for training: noise, hidden joints, and what they get plainly wrong."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steadypose.prior.body.skeleton import MIRROR, PARENTS, J, limbs
from steadypose.prior.timing.rate import FPS

Floats = NDArray[np.float64]
Rng = np.random.Generator
Fault = Callable[[Floats, slice, list[int], Floats, Rng], None]
"""Spoils a window (T, 22, 3) in place: some joints in a part of its frames; with another window, of somebody else."""

SLOW_HZ = 0.7
"""how fast a sensor's slow error changes at most"""

_LIMBS = limbs(
    ("wrist",), ("elbow", "wrist"), ("shoulder", "elbow", "wrist"),
    ("foot",), ("ankle", "foot"), ("knee", "ankle", "foot"), ("hip", "knee", "ankle", "foot"),
)  # fmt: skip
_LOWER = [joint for leg in limbs(("hip", "knee", "ankle", "foot")) for joint in leg]
_ABSENT = [J[n] for n in ("spine1", "spine2", "spine3", "left_collar", "right_collar", "left_foot", "right_foot")]
"""joints that many sensors do not have"""


def slow_errors(count: int, rng: Rng) -> Floats:
    """(B,) metres along an axis: how large the errors of a sensor are that last or change slowly, in many none."""
    return 0.03 * rng.uniform(0.0, 1.0, count) * (rng.random(count) < 0.7)


def add_noise(positions: Floats, rng: Rng, slow: Floats) -> Floats:
    """Windows (B, T, 22, 3) with noise from frame to frame, of some joints more than of others, up to 10 cm, and with
    errors ``slow`` (B,) that last or change slowly; see `slow_errors`. Half of those without such errors have none."""
    count, frames, joints, _ = positions.shape
    fast = 10 ** rng.uniform(-3.3, -1.0, (count, 1, 1, 1)) * np.exp(0.4 * rng.standard_normal((count, 1, joints, 1)))
    fast[(slow == 0) & (rng.random(count) < 0.5)] = 0.0
    phase = rng.uniform(0.0, 2 * np.pi, (count, 1, joints, 3))
    turns = rng.uniform(0.0, SLOW_HZ, (count, 1, joints, 3)) * np.arange(frames)[:, None, None] / FPS
    bias = np.sqrt(2.0) * slow[:, None, None, None] * np.cos(phase + 2 * np.pi * turns)
    return positions + fast * rng.standard_normal((count, frames, joints, 3)) + bias


def other_builds(positions: Floats, lengths: float, turned: float, rng: Rng) -> Floats:
    """Windows (B, T, 22, 3) of people who are built and who hold themselves otherwise.

    Args:
        positions: metres.
        lengths: standard deviation of the logarithm of each bone's length, alike on both sides.
        turned: radians, by how much each bone is turned about each axis, throughout the window: at most so much
            standard deviation, in most windows less.
        rng: of what is drawn.
    """
    count, joints = len(positions), len(PARENTS)
    factor = np.exp(lengths * rng.standard_normal((count, joints)))
    factor = np.sqrt(factor * factor[:, MIRROR])[..., None, None]
    angles = turned * rng.uniform(0.0, 1.0, (count, 1, 1)) * rng.standard_normal((count, joints, 3))
    turns = factor * Rotation.from_rotvec(angles.reshape(-1, 3)).as_matrix().reshape(count, joints, 3, 3)
    other = positions.copy()
    for joint, parent in enumerate(PARENTS[1:], start=1):
        bone = positions[:, :, joint] - positions[:, :, parent]
        other[:, :, joint] = other[:, :, parent] + bone @ turns[:, joint].swapaxes(-1, -2)
    return other


FAST = 0.5
"""share of a sensor's variance that is noise from frame to frame, if nothing else is known"""


def sensed(positions: Floats, sigma: Floats | float, rng: Rng, fast: Floats | float = FAST) -> Floats:
    """Windows (B, T, 22, 3) as a sensor of error ``sigma`` (metres along an axis) sees them; of its variance, ``fast``
    is noise from frame to frame, the rest lasts."""
    count, _, joints, _ = positions.shape
    slow = np.sqrt(1.0 - fast) * rng.standard_normal((count, 1, joints, 3))
    return positions + sigma * (slow + np.sqrt(fast) * rng.standard_normal(positions.shape))


def wandering(positions: Floats, sigma: Floats, rng: Rng, fast: Floats) -> Floats:
    """Windows (B, T, 22, 3) as `sensed`, but of some joints more than of others, and what lasts wanders.

    Args:
        positions: metres.
        sigma: (B,) metres along an axis, the sensor's error, over all joints.
        rng: of what is drawn.
        fast: (B,) share of its variance that is noise from frame to frame.
    """
    count, frames, joints, _ = positions.shape
    factor = np.exp(rng.choice([0.0, 0.5], (count, 1)) * rng.standard_normal((count, joints)))
    factor /= np.sqrt(np.square(factor).mean(axis=1, keepdims=True))
    memory = 1.0 - 10 ** rng.uniform(-3.0, -0.7, (count, 1, 1))
    slow, new = rng.standard_normal((count, frames, joints, 3)), np.sqrt(1.0 - memory**2)
    for t in range(1, frames):
        slow[:, t] = memory * slow[:, t - 1] + new * slow[:, t]
    quick, lasts = (np.sqrt(share)[:, None, None, None] for share in (fast, 1.0 - fast))
    noise = lasts * slow + quick * rng.standard_normal(slow.shape)
    return positions + sigma[:, None, None, None] * factor[:, None, :, None] * noise


def spoil(clean: Floats, faults: Sequence[Fault], share: float, rng: Rng) -> Floats:
    """Windows (B, T, 22, 3), a ``share`` of them with one of ``faults``, most of these to the window's end."""
    spoilt = clean.copy()
    frames = clean.shape[1]
    for window in spoilt:
        if rng.random() > share:
            continue
        length = int(np.clip(np.exp(rng.uniform(np.log(3), np.log(1.5 * frames))), 3, frames - 1))
        start = frames - length if rng.random() < 0.6 else int(rng.integers(1, frames - length + 1))
        joints = _LIMBS[rng.integers(len(_LIMBS))] if rng.random() < 0.6 else [int(rng.integers(1, len(PARENTS)))]
        other = clean[rng.integers(len(clean))]
        faults[int(rng.integers(len(faults)))](window, slice(start, start + length), joints, other, rng)
    return spoilt


def stands_still(window: Floats, part: slice, joints: list[int], other: Floats, rng: Rng) -> None:
    """Limbs that stay where they were: in the room, or beside the pelvis."""
    before = window[part.start - 1].copy()
    if rng.random() < 0.6:
        window[part, joints] = before[joints]
    else:  # beside the pelvis
        window[part, joints] = before[joints] - before[0] + window[part, :1]


def repeats(window: Floats, part: slice, joints: list[int], other: Floats, rng: Rng) -> None:
    """A tracker's last answer for some limbs, its noise and all."""
    window[part, joints] = window[part.start - 1, joints]


def exchanged(window: Floats, part: slice, joints: list[int], other: Floats, rng: Rng) -> None:
    """Limbs taken for the other side's."""
    both = [*joints, *MIRROR[joints]]
    window[part, both] = window[part][:, MIRROR[both]]


def sides_exchanged(window: Floats, part: slice, joints: list[int], other: Floats, rng: Rng) -> None:
    """Left taken for right, all over."""
    when = part if rng.random() < 0.5 else slice(None)
    window[when] = window[when][:, MIRROR]


def elsewhere(window: Floats, part: slice, joints: list[int], other: Floats, rng: Rng) -> None:
    """Limbs that lie 2 to 40 cm elsewhere."""
    window[part, joints] += rng.normal(0.0, 10 ** rng.uniform(-1.7, -0.4), 3)


def somebody_elses(window: Floats, part: slice, joints: list[int], other: Floats, rng: Rng) -> None:
    """Somebody else's limbs."""
    beside = window[part, :1] - other[part, :1] + rng.normal(0.0, 10 ** rng.uniform(-2.0, -0.4), 3)
    window[part, joints] = other[part][:, joints] + beside


def other_bones(window: Floats, part: slice, joints: list[int], other: Floats, rng: Rng) -> None:
    """Bones each longer or shorter by itself: a skeleton taken for another."""
    own, factor = window.copy(), np.exp(rng.normal(0.0, rng.uniform(0.05, 0.35), len(PARENTS)))
    for joint, parent in enumerate(PARENTS[1:], start=1):
        window[:, joint] = window[:, parent] + factor[joint] * (own[:, joint] - own[:, parent])


def noisy(window: Floats, part: slice, joints: list[int], other: Floats, rng: Rng) -> None:
    """More noise, of 1 to 10 cm, on some joints or on all."""
    which = joints if rng.random() < 0.5 else list(range(len(PARENTS)))
    window[part, which] += rng.normal(0.0, 10 ** rng.uniform(-2.0, -1.0), (part.stop - part.start, len(which), 3))


def jumps(window: Floats, part: slice, joints: list[int], other: Floats, rng: Rng) -> None:
    """One frame in which a limb is far away."""
    window[rng.integers(part.start, part.stop), joints] += rng.normal(0.0, 0.2, 3)


def occlude(positions: Floats, rng: Rng) -> Floats:
    """Windows (B, T, 22, 3) with entries made NaN as cameras lose them: limbs, sets of joints, single ones, the past.

    The newest frame matters most, so half of the gaps reach it.
    """
    seen = positions.copy()
    frames = positions.shape[1]
    for window in seen:
        if rng.random() < 0.4:
            window[:, _ABSENT] = np.nan
        if rng.random() < 0.25:
            window[:, 1 + rng.choice(len(PARENTS) - 1, rng.integers(1, 7), replace=False)] = np.nan
        for _ in range(rng.integers(1, 4)):
            kind = rng.random()
            joints = (
                _LIMBS[rng.integers(len(_LIMBS))] if kind < 0.6
                else _LOWER if kind < 0.7
                else _below(int(rng.integers(1, len(PARENTS)))) if kind < 0.8
                else np.flatnonzero(rng.random(len(PARENTS)) < rng.uniform(0.05, 0.5))
            )  # fmt: skip
            length = int(np.clip(np.exp(rng.uniform(np.log(2), np.log(2.0 * frames))), 1, frames))
            start = frames - length if rng.random() < 0.5 else int(rng.integers(0, frames - length + 1))
            window[start : start + length, joints] = np.nan
        if rng.random() < 0.2:
            window[rng.random(window.shape[:2]) < 10 ** rng.uniform(-3, -0.3)] = np.nan
        if rng.random() < 0.15:
            window[: rng.integers(1, frames - 3)] = np.nan
    return seen


def hide_joints(positions: Floats, count: int, rng: Rng) -> Floats:
    """Windows (B, T, 22, 3), each without ``count`` joints, at random."""
    hidden = rng.permuted(np.tile(np.arange(22) < count, (len(positions), 1)), axis=1)
    return np.where(hidden[:, None, :, None], np.nan, positions)


def _below(joint: int) -> list[int]:
    """A joint and all that hangs from it."""
    found = [joint]
    for child in range(joint + 1, len(PARENTS)):
        if PARENTS[child] in found:
            found.append(child)
    return found
