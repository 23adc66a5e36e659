"""Corruption of clean windows for training: a tracker's noise, its faults, and hidden joints.

As in `prior.clean.frame.SensorNoise`, a sensor's error has two parts: jitter, independent from frame to frame, and
bias, constant or slowly varying. Windows are (B, T, 22, 3) metres, and are not changed in place.
"""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.skeleton import MIRROR, PARENTS, J, limbs
from steadypose.prior.sim.noise import time_correlated
from steadypose.prior.timing.rate import FPS

Rng = np.random.Generator
Fault = Callable[[Floats, slice, list[int], Floats, Rng], None]
"""Type of a tracking fault: changes some joints in a slice of the frames of a window (T, 22, 3), in place. The other
window (T, 22, 3) is of another person, for faults that mix two bodies."""

SLOW_HZ = 0.7  # largest frequency of a sensor's bias, Hz

_LIMBS = limbs(
    ("wrist",), ("elbow", "wrist"), ("shoulder", "elbow", "wrist"),
    ("foot",), ("ankle", "foot"), ("knee", "ankle", "foot"), ("hip", "knee", "ankle", "foot"),
)  # fmt: skip
_LOWER = [joint for leg in limbs(("hip", "knee", "ankle", "foot")) for joint in leg]
ABSENT = [J[n] for n in ("spine1", "spine2", "spine3", "left_collar", "right_collar", "left_foot", "right_foot")]
"""Joints that many sensors lack."""


def draw_bias_sigma(count: int, rng: Rng) -> Floats:
    """(B,) metres along an axis, standard deviations of biases to train on: 0 in 30 % of windows, up to 3 cm."""
    return 0.03 * rng.uniform(0.0, 1.0, count) * (rng.random(count) < 0.7)


def add_noise(positions: Floats, rng: Rng, bias_sigma: Floats) -> Floats:
    """Add jitter of up to 10 cm, with a different deviation for each joint, and a slow bias to windows (B, T, 22, 3)
    metres.

    ``bias_sigma`` (B,) metres along an axis may be of `draw_bias_sigma`; half of the windows in which it is 0 get no
    jitter either.
    """
    count, frames, joints, _ = positions.shape
    jitter = 10 ** rng.uniform(-3.3, -1.0, (count, 1, 1, 1)) * np.exp(0.4 * rng.standard_normal((count, 1, joints, 1)))
    jitter[(bias_sigma == 0) & (rng.random(count) < 0.5)] = 0.0
    phase = rng.uniform(0.0, 2 * np.pi, (count, 1, joints, 3))
    turns = rng.uniform(0.0, SLOW_HZ, (count, 1, joints, 3)) * np.arange(frames)[:, None, None] / FPS
    bias = np.sqrt(2.0) * bias_sigma[:, None, None, None] * np.cos(phase + 2 * np.pi * turns)
    return positions + jitter * rng.standard_normal((count, frames, joints, 3)) + bias


def vary_builds(positions: Floats, length_sigma: float, turn_sigma: float, rng: Rng) -> Floats:
    """Augment windows (B, T, 22, 3) metres by varying bone lengths and posture.

    ``length_sigma`` is the standard deviation of the logarithm of each bone's scale, which both sides share;
    ``turn_sigma`` bounds that, drawn for each window, of a constant rotation of each bone about each axis, radians.
    """
    count, joints = len(positions), len(PARENTS)
    factor = np.exp(length_sigma * rng.standard_normal((count, joints)))
    factor = np.sqrt(factor * factor[:, MIRROR])[..., None, None]
    angles = turn_sigma * rng.uniform(0.0, 1.0, (count, 1, 1)) * rng.standard_normal((count, joints, 3))
    turns = factor * Rotation.from_rotvec(angles.reshape(-1, 3)).as_matrix().reshape(count, joints, 3, 3)
    other = positions.copy()
    for joint, parent in enumerate(PARENTS[1:], start=1):
        bone = positions[:, :, joint] - positions[:, :, parent]
        other[:, :, joint] = other[:, :, parent] + bone @ turns[:, joint].swapaxes(-1, -2)
    return other


JITTER_SHARE = 0.5  # share of jitter in the variance of a sensor's error; the rest is bias


def with_sensor_error(positions: Floats, sigma: Floats | float, rng: Rng) -> Floats:
    """Add jitter and a constant bias of each joint, ``sigma`` metres along an axis in total, to windows (B, T, 22, 3).

    `JITTER_SHARE` of the variance is jitter.
    """
    count, _, joints, _ = positions.shape
    bias = np.sqrt(1.0 - JITTER_SHARE) * rng.standard_normal((count, 1, joints, 3))
    return positions + sigma * (bias + np.sqrt(JITTER_SHARE) * rng.standard_normal(positions.shape))


def with_drifting_error(positions: Floats, sigma: Floats, rng: Rng, jitter_share: Floats) -> Floats:
    """Add jitter and a drifting bias (an AR(1) process) to windows (B, T, 22, 3) metres; in half, some joints are
    worse.

    ``sigma`` (B,) is the RMS error over all joints, metres along an axis; ``jitter_share`` (B,) that of jitter in its
    square.
    """
    count, frames, joints, _ = positions.shape
    factor = np.exp(rng.choice([0.0, 0.5], (count, 1)) * rng.standard_normal((count, joints)))
    factor /= np.sqrt(np.square(factor).mean(axis=1, keepdims=True))
    memory = 1.0 - 10 ** rng.uniform(-3.0, -0.7, (count, 1, 1))
    drift = time_correlated(rng.standard_normal((count, frames, joints, 3)), memory, axis=1)
    fast, slow = (np.sqrt(share)[:, None, None, None] for share in (jitter_share, 1.0 - jitter_share))
    noise = slow * drift + fast * rng.standard_normal(drift.shape)
    return positions + sigma[:, None, None, None] * factor[:, None, :, None] * noise


def with_faults(clean: Floats, faults: Sequence[Fault], share: float, rng: Rng) -> Floats:
    """Add one of ``faults`` to a ``share`` of windows (B, T, 22, 3); 60 % of the faults last to the window's end."""
    corrupted = clean.copy()
    frames = clean.shape[1]
    for window in corrupted:
        if rng.random() > share:
            continue
        length = int(np.clip(np.exp(rng.uniform(np.log(3), np.log(1.5 * frames))), 3, frames - 1))
        start = frames - length if rng.random() < 0.6 else int(rng.integers(1, frames - length + 1))
        joints = _LIMBS[rng.integers(len(_LIMBS))] if rng.random() < 0.6 else [int(rng.integers(1, len(PARENTS)))]
        other = clean[rng.integers(len(clean))]
        faults[int(rng.integers(len(faults)))](window, slice(start, start + length), joints, other, rng)
    return corrupted


def stands_still(window: Floats, part: slice, joints: list[int], other: Floats, rng: Rng) -> None:
    """Limbs frozen where they were, in the world or relative to the pelvis."""
    before = window[part.start - 1].copy()
    if rng.random() < 0.6:
        window[part, joints] = before[joints]
    else:  # beside the pelvis
        window[part, joints] = before[joints] - before[0] + window[part, :1]


def repeats(window: Floats, part: slice, joints: list[int], other: Floats, rng: Rng) -> None:
    """Limbs for which the tracker repeats its last output, noise included."""
    window[part, joints] = window[part.start - 1, joints]


def exchanged(window: Floats, part: slice, joints: list[int], other: Floats, rng: Rng) -> None:
    """Limbs of both sides exchanged."""
    both = [*joints, *MIRROR[joints]]
    window[part, both] = window[part][:, MIRROR[both]]


def sides_exchanged(window: Floats, part: slice, joints: list[int], other: Floats, rng: Rng) -> None:
    """The whole body mirrored: left and right exchanged."""
    when = part if rng.random() < 0.5 else slice(None)
    window[when] = window[when][:, MIRROR]


def displaced(window: Floats, part: slice, joints: list[int], other: Floats, rng: Rng) -> None:
    """Limbs displaced by a constant 2 to 40 cm."""
    window[part, joints] += rng.normal(0.0, 10 ** rng.uniform(-1.7, -0.4), 3)


def of_another_person(window: Floats, part: slice, joints: list[int], other: Floats, rng: Rng) -> None:
    """Limbs of another person, placed beside this one's pelvis."""
    beside = window[part, :1] - other[part, :1] + rng.normal(0.0, 10 ** rng.uniform(-2.0, -0.4), 3)
    window[part, joints] = other[part][:, joints] + beside


def other_bones(window: Floats, part: slice, joints: list[int], other: Floats, rng: Rng) -> None:
    """Bone lengths scaled independently, throughout the window: not this person's skeleton."""
    own, factor = window.copy(), np.exp(rng.normal(0.0, rng.uniform(0.05, 0.35), len(PARENTS)))
    for joint, parent in enumerate(PARENTS[1:], start=1):
        window[:, joint] = window[:, parent] + factor[joint] * (own[:, joint] - own[:, parent])


def noisy(window: Floats, part: slice, joints: list[int], other: Floats, rng: Rng) -> None:
    """Additional jitter of 1 to 10 cm, on some joints or on all."""
    which = joints if rng.random() < 0.5 else list(range(len(PARENTS)))
    window[part, which] += rng.normal(0.0, 10 ** rng.uniform(-2.0, -1.0), (part.stop - part.start, len(which), 3))


def jumps(window: Floats, part: slice, joints: list[int], other: Floats, rng: Rng) -> None:
    """A limb displaced by decimetres in a single frame."""
    window[rng.integers(part.start, part.stop), joints] += rng.normal(0.0, 0.2, 3)


def occlude(positions: Floats, rng: Rng) -> Floats:
    """Hide joints (NaN) of windows (B, T, 22, 3) in the way that cameras lose them: limbs, the lower body, subtrees,
    joints below a counter or beyond an edge of the image, random sets of joints, single entries, joints that a sensor
    lacks, and all frames before a body entered. Half of the gaps reach the newest frame, which matters most.
    """
    observed = positions.copy()
    frames = positions.shape[1]
    for window in observed:
        if rng.random() < 0.4:
            window[:, ABSENT] = np.nan
        if rng.random() < 0.25:
            window[:, 1 + rng.choice(len(PARENTS) - 1, rng.integers(1, 7), replace=False)] = np.nan
        for _ in range(rng.integers(1, 4)):
            kind = rng.random()
            length = int(np.clip(np.exp(rng.uniform(np.log(2), np.log(2.0 * frames))), 1, frames))
            start = frames - length if rng.random() < 0.5 else int(rng.integers(0, frames - length + 1))
            gap = window[start : start + length]
            if kind < 0.15:
                gap[_beyond_an_edge(window, rng)[start : start + length]] = np.nan
                continue
            joints = (
                _LIMBS[rng.integers(len(_LIMBS))] if kind < 0.65
                else _LOWER if kind < 0.75
                else _below(int(rng.integers(1, len(PARENTS)))) if kind < 0.85
                else np.flatnonzero(rng.random(len(PARENTS)) < rng.uniform(0.05, 0.5))
            )  # fmt: skip
            gap[:, joints] = np.nan
        if rng.random() < 0.2:
            window[rng.random(window.shape[:2]) < 10 ** rng.uniform(-3, -0.3)] = np.nan
        if rng.random() < 0.15:
            window[: rng.integers(1, frames - 3)] = np.nan
    return observed


def hide_joints(positions: Floats, count: int, rng: Rng) -> Floats:
    """Set ``count`` random joints of each window (B, T, 22, 3) to NaN in all frames."""
    hidden = rng.permuted(np.tile(np.arange(22) < count, (len(positions), 1)), axis=1)
    return np.where(hidden[:, None, :, None], np.nan, positions)


def _beyond_an_edge(window: Floats, rng: Rng) -> Bools:
    """(T, 22) which joints of a window (T, 22, 3) lie below a level or beyond a vertical plane, 5 to 75 %."""
    turn = rng.uniform(0.0, 2.0 * np.pi)
    outwards = [0.0, 0.0, -1.0] if rng.random() < 0.7 else [np.cos(turn), np.sin(turn), 0.0]
    distance = window @ np.array(outwards)
    known = distance[np.isfinite(distance)]
    return np.asarray(distance > (np.quantile(known, rng.uniform(0.25, 0.95)) if len(known) else np.inf))


def _below(joint: int) -> list[int]:
    """A joint and all its descendants."""
    subtree = [joint]
    for child in range(joint + 1, len(PARENTS)):
        if PARENTS[child] in subtree:
            subtree.append(child)
    return subtree
