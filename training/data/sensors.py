"""Simulated sensors for training the mixture, with errors from 0 to 8 cm."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import HIPS, MIRROR, PARENTS, J, limbs
from steadypose.prior.sim.noise import time_correlated
from steadypose.prior.timing.rate import FPS
from steadypose.training.data.corruption import ABSENT, occlude
from steadypose.training.data.recordings import Motion, Pairs, load_kinect, load_motion

Rng = np.random.Generator

GATED = 0.18  # size of jumps above which 90 % are removed, as by the gate before the mixture, metres

KINDS = ("perfect", "white", "coloured", "replayed", "mixed", "kinect", "monocular")
SHARES = np.array([0.13, 0.25, 0.15, 0.11, 0.11, 0.13, 0.12])
"""Shares of the kinds of sensors: no error, white noise, AR(1) noise, a real Kinect's errors added to other motion, all
of these together, the real Kinect's recordings, and a monocular network with errors in each bone's depth."""

TURNED = 0.25  # share of clips in which the whole body is turned, so that people lie, stand on their hands or roll
CARRIED = 0.15  # share of clips from a moving camera with unknown pose, such as a robot's or one that is bumped into

_SWINGS = (
    ("elbow", "wrist"),
    ("shoulder", "elbow", "wrist"),
    ("knee", "ankle", "foot"),
    ("hip", "knee", "ankle", "foot"),
)
_LIMBS = limbs(_SWINGS[0], _SWINGS[2])


@dataclass(frozen=True)
class Sensed:
    """Clips as observed by simulated sensors."""

    observed: Floats  # (C, T, 22, 3) metres, NaN where unobserved
    truth: Floats  # (C, T, 22, 3) metres, NaN where unknown
    confidence: Floats  # (C, T, 22) the sensor's, 0 to 1; in 70 % of clips, the noise is inversely proportional


class Sensors:
    """Draws clips of motion and simulates sensors on them."""

    def __init__(self, motion: Motion, pairs: Pairs, frames: int) -> None:
        """``frames`` is the length of a clip; ``pairs`` are recordings of the training subjects."""
        self._motion, self._pairs, self._frames = motion, pairs, frames
        room = np.maximum(np.diff(motion.start) - frames, 0).astype(float)
        # sources are weighted by their length to the power of 0.4: dance is short and fast
        weight = np.zeros(len(room))
        for source in sorted(set(motion.source)):
            own = motion.source == source
            if room[own].sum() > 0:
                weight[own] = room[own] / room[own].sum() ** 0.6
        self._weight = weight / weight.sum()
        lengths = np.diff(pairs.start) * sound(pairs)
        self._pair_weight = np.maximum(lengths - 20, 0) / np.maximum(lengths - 20, 0).sum()

    @classmethod
    def of(cls, arrays: Path, split: str, frames: int) -> "Sensors":
        """Of the motion and pairs of a split in the folder of `recordings.write_arrays`."""
        return cls(load_motion(arrays, split), load_kinect(arrays, split), frames)

    def draw(self, count: int, rng: Rng) -> Sensed:
        """Draw ``count`` clips."""
        kind = rng.choice(len(KINDS), count, p=SHARES)
        truth = self._true(count, rng)
        observed = truth.copy()
        confidence = _confidences(count, self._frames, rng)
        for clip in range(count):
            if KINDS[kind[clip]] == "kinect":
                observed[clip], truth[clip] = self._real(rng)
            else:
                noise = self._noise(KINDS[kind[clip]], truth[clip], rng)
                informative = rng.random() < 0.7  # whether the noise is inversely proportional to the confidence
                observed[clip] = truth[clip] + (noise * (0.8 / confidence[clip, ..., None]) if informative else noise)
        self._add_outliers(observed, kind, rng)
        # relative to the hips, as monocular networks give joints
        about = np.flatnonzero(rng.random(count) < np.where(kind == KINDS.index("monocular"), 0.8, 0.05))
        for places in (observed, truth):
            places[about] -= places[about][:, :, HIPS].mean(axis=2, keepdims=True)
        for clip in np.flatnonzero(rng.random(count) < TURNED):
            _turn(observed[clip], truth[clip], rng)
        return Sensed(observed, truth, confidence)

    def _true(self, count: int, rng: Rng) -> Floats:
        start = self._motion.start
        clips = rng.choice(len(self._weight), count, p=self._weight)
        first = start[clips] + (rng.random(count) * (np.diff(start)[clips] - self._frames)).astype(int)
        truth = self._motion.positions[first[:, None] + np.arange(self._frames)].astype(np.float64)
        mirrored = rng.random(count) < 0.5
        truth[mirrored] = truth[mirrored][:, :, MIRROR] * (1.0, -1.0, 1.0)
        truth *= np.where(rng.random(count) < 0.4, rng.uniform(0.75, 1.1, count), 1.0)[:, None, None, None]
        still = rng.random(count) < 0.04
        truth[still] = truth[still, :1]
        for clip in np.flatnonzero((rng.random(count) < 0.12) | still):
            if rng.random() < 0.9:
                _swing(truth[clip], rng)
        for clip in np.flatnonzero(rng.random(count) < CARRIED):
            _carry(truth[clip], rng)
        return truth

    def _residual(self, rng: Rng) -> Floats:
        """(T, 22, 3) metres, errors of the real Kinect, rotated about the vertical.

        Joints that it lacks get their parent's error. Recordings shorter than a clip are played forwards and backwards.
        """
        start = self._pairs.start
        clip = rng.choice(len(self._pair_weight), p=self._pair_weight)
        rows = slice(start[clip], start[clip + 1])
        error = np.nan_to_num((self._pairs.seen[rows] - self._pairs.truth[rows]).astype(np.float64))
        error -= np.median(error, axis=0) * rng.random()
        for joint in range(1, 22):
            if not error[:, joint].any():
                error[:, joint] = error[:, PARENTS[joint]]
        length = len(error)
        time = np.arange(self._frames) + rng.integers(0, 2 * length)
        time = np.abs((time % (2 * length)) - length + 0.5) - 0.5
        error = error[np.clip(time, 0, length - 1).astype(int)]
        if rng.random() < 0.5:
            error = error[:, MIRROR] * (1.0, -1.0, 1.0)
        return rng.uniform(0.6, 1.4) * error @ Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)).as_matrix().T

    def _noise(self, kind: str, truth: Floats, rng: Rng) -> Floats:
        """(T, 22, 3) metres, errors of a sensor of this kind."""
        shape = truth.shape
        if kind == "perfect":
            return 10 ** rng.uniform(-4, -3) * rng.standard_normal(shape) if rng.random() < 0.15 else np.zeros(shape)
        if kind == "monocular":
            return _monocular_errors(truth, rng)
        by_joint = np.exp(rng.choice([0.0, 0.5]) * rng.standard_normal((1, 22, 1)))
        noise = np.zeros(shape)
        if kind in ("white", "mixed"):
            upper = -1.05 if kind == "white" else -1.5
            noise += 10 ** rng.uniform(-2.8, upper) * by_joint * rng.standard_normal(shape)
        if kind in ("coloured", "mixed"):
            noise += 10 ** rng.uniform(-2.4, -1.2) * by_joint * _coloured(shape, rng.uniform(0.5, 0.97), rng)
        if kind == "replayed" or (kind == "mixed" and rng.random() < 0.3):
            noise += self._residual(rng)
        if kind != "replayed" and rng.random() < 0.25:
            along = rng.standard_normal(3) * (1.0, 1.0, 0.3)
            along /= np.linalg.norm(along)
            noise += (rng.choice([2.0, 1.0])) * (noise @ along)[..., None] * along
        if kind == "mixed":
            rate = np.gradient(truth, axis=0) * FPS
            noise += rate * 10 ** rng.uniform(-3.0, -2.0) * rng.standard_normal((shape[0], 1, 1))
        if kind == "white" and rng.random() < 0.06:  # a camera of 15 frames a second, read at 30
            noise[1:-1:2] = 0.5 * (noise[:-2:2] + noise[2::2])
        if rng.random() < 0.15:  # noise of varying size, of each joint or of the body
            noise *= np.exp(0.7 * _coloured((shape[0], rng.choice([1, 22]), 1), 0.98, rng))
        if rng.random() < 0.12:
            noise *= rng.choice([0.1, 1.0])
            noise += _shaking(truth, rng)
        if rng.random() < 0.05:
            step = 10 ** rng.uniform(-2.5, -1.4)
            noise = np.round((truth + noise) / step) * step - truth
        return noise

    def _real(self, rng: Rng) -> tuple[Floats, Floats]:
        """A clip of the real Kinect and its truth; NaN after the end of a shorter recording."""
        start = self._pairs.start
        clip = rng.choice(len(self._pair_weight), p=self._pair_weight)
        first = start[clip] + int(rng.random() * max(start[clip + 1] - start[clip] - self._frames, 0))
        rows = slice(first, min(first + self._frames, start[clip + 1]))
        observed, truth = np.full((2, self._frames, 22, 3), np.nan)
        there = slice(rows.stop - rows.start)
        observed[there], truth[there] = self._pairs.seen[rows], self._pairs.truth[rows]
        if rng.random() < 0.5:
            observed, truth = (x[:, MIRROR] * (1.0, -1.0, 1.0) for x in (observed, truth))
        return observed, truth

    def _add_outliers(self, observed: Floats, kind: NDArray[np.int64], rng: Rng) -> None:
        """Outliers, exchanged limbs, lost frames and hidden joints, in place; of perfect sensors only the last two."""
        count, frames = observed.shape[:2]
        for clip in range(count):
            noisy = KINDS[kind[clip]] != "perfect"
            if noisy and rng.random() < 0.15:
                hit = rng.random((frames, 22)) < 10 ** rng.uniform(-2.7, -1.5)
                jump = rng.standard_normal((frames, 22, 3))
                jump *= (rng.uniform(0.05, 0.4, (frames, 22)) / np.linalg.norm(jump, axis=-1))[..., None]
                far = (np.linalg.norm(jump, axis=-1) > GATED) & (rng.random((frames, 22)) < 0.9)
                observed[clip] += np.where(hit[..., None], jump, 0.0)
                observed[clip][hit & far] = np.nan
            if noisy and rng.random() < 0.05:
                first, length = rng.integers(1, frames - 1), rng.geometric(1 / 3)
                pair = _LIMBS[rng.integers(len(_LIMBS))]
                rows = slice(first, first + length)
                if rng.random() < 0.5:
                    both = [*pair, *MIRROR[pair]]
                    observed[clip, rows, both] = observed[clip, rows][:, MIRROR[both]].swapaxes(0, 1)
                else:
                    observed[clip, rows, pair] = np.nan
            if rng.random() < 0.08:
                observed[clip, rng.random(frames) < 10 ** rng.uniform(-2.0, -0.5)] = np.nan
            if rng.random() < 0.08:  # joints that flicker
                flickering = (rng.random(22) < rng.choice([0.3, 1.0])) * 10 ** rng.uniform(-1.3, -0.3)
                observed[clip][rng.random((frames, 22)) < flickering] = np.nan
        few = np.flatnonzero(rng.random(count) < 0.15)
        observed[np.ix_(few, np.arange(frames), np.array(ABSENT))] = np.nan
        for clip in np.flatnonzero(rng.random(count) < 0.05):  # sensors of few joints
            observed[clip][:, rng.random(22) < rng.uniform(0.2, 0.8)] = np.nan
        hidden = np.flatnonzero(rng.random(count) < 0.2)
        if len(hidden):
            observed[hidden] = occlude(observed[hidden], rng)


def sound(pairs: Pairs, threshold: float = 0.05) -> NDArray[np.bool_]:
    """(C,) recordings in which Kinect and Vicon differ by less than ``threshold`` metres (median).

    In other recordings, one of the two lost the person.
    """
    error = np.linalg.norm(pairs.seen - pairs.truth, axis=-1)
    return np.array([np.nanmedian(error[a:b]) < threshold for a, b in zip(pairs.start, pairs.start[1:], strict=False)])


def _confidences(count: int, frames: int, rng: Rng) -> Floats:
    """(C, T, 22) confidences: 1 in 70 % of clips, in others different for each joint and slowly varying."""
    time = 2 * np.pi * rng.uniform(0.0, 0.5, (count, 1, 22)) * np.arange(frames)[:, None] / FPS
    middle = rng.uniform(0.3, 1.0, (count, 1, 22))
    unsure = np.clip(middle + 0.2 * np.cos(time + rng.uniform(0, 2 * np.pi, (count, 1, 22))), 0.1, 1.0)
    return np.where((rng.random(count) < 0.3)[:, None, None], unsure, 1.0)


def _coloured(shape: tuple[int, ...], memory: float, rng: Rng) -> Floats:
    """Time-correlated noise of unit variance; see `time_correlated`."""
    return time_correlated(rng.standard_normal(shape), memory)


def _shaking(truth: Floats, rng: Rng) -> Floats:
    """(T, 22, 3) metres, errors of a camera 1 to 4 m away that shakes: joints share its displacement and rotation."""
    frames, amplitude = len(truth), 10 ** rng.uniform(-2.7, -1.4)
    memory = rng.choice([0.0, rng.uniform(0.3, 0.95)])
    towards = rng.standard_normal(3) * (1.0, 1.0, 0.2)
    distance = rng.uniform(1.0, 4.0)
    camera = truth[0, 0] + distance * towards / np.linalg.norm(towards)
    turned = amplitude / distance * rng.choice([0.0, 1.0]) * _coloured((frames, 1, 3), memory, rng)
    return amplitude * _coloured((frames, 1, 3), memory, rng) + np.cross(turned, truth - camera)


def _monocular_errors(truth: Floats, rng: Rng) -> Floats:
    """(T, 22, 3) metres, errors of a monocular network.

    Each bone's depth has coloured noise and jumps, and errors accumulate along the kinematic chain. Errors across the
    line of sight are small.
    """
    frames = len(truth)
    view = rng.standard_normal(3) * (1.0, 1.0, 0.2)
    view /= np.linalg.norm(view)
    depth = 10 ** rng.uniform(-1.6, -0.5) * _coloured((frames, 22), rng.uniform(0.6, 0.97), rng)
    jumps = rng.random((frames, 22)) < 10 ** rng.uniform(-3.0, -1.3)
    guesses = np.cumsum(jumps, axis=0, dtype=np.int64)  # the current level, by index
    levels = rng.standard_normal((guesses.max() + 1, 22)) * rng.uniform(0.0, 0.3)
    depth += np.take_along_axis(levels, guesses, axis=0)
    across = 10 ** rng.uniform(-2.8, -1.8)
    noise = across * _coloured(truth.shape, rng.uniform(0.0, 0.8), rng)
    for joint in range(1, 22):
        bone = np.linalg.norm(truth[:, joint] - truth[:, PARENTS[joint]], axis=-1)
        apart = (bone * depth[:, joint])[:, None] * view
        noise[:, joint] += noise[:, PARENTS[joint]] + apart
    return noise


def _carry(truth: Floats, rng: Rng) -> None:
    """Move a whole clip smoothly, in place.

    It sways by up to 0.5 g at 0.1 to 3 Hz, turns about a camera 1 to 4 m away by up to 1.5 rad/s, or is displaced at
    once.
    """
    time, amplitude = np.arange(len(truth)) / FPS, 10 ** rng.uniform(-1.0, 0.0)
    towards = rng.uniform(0.0, 2 * np.pi)
    camera = truth[0, 0] + rng.uniform(1.0, 4.0) * np.array([np.cos(towards), np.sin(towards), 0.0])
    rate = 2 * np.pi * 10 ** rng.uniform(-1.0, 0.5)
    swung = np.sin(rate * time + rng.uniform(0.0, 2 * np.pi))
    kind = rng.random()
    if kind < 0.45:
        axis = rng.standard_normal(3)
        truth += (min(5.0 / rate**2, 0.5) * amplitude * axis / np.linalg.norm(axis) * swung[:, None])[:, None]
    elif kind < 0.9:
        turns = Rotation.from_euler("z", min(1.5 / rate, 1.0) * amplitude * swung[:, None]).as_matrix()
        truth[:] = np.einsum("tab,tjb->tja", turns, truth - camera) + camera
    else:
        truth[rng.integers(1, len(truth)) :] += 0.2 * amplitude * rng.standard_normal(3)


def _turn(observed: Floats, truth: Floats, rng: Rng) -> None:
    """Turn a clip about its first root by a random rotation or a tilt, in place.

    A third of the clips without unknown joints keep turning about their root, by up to one revolution per second.
    """
    axis = rng.standard_normal(3) * rng.choice([(1.0, 1.0, 1.0), (1.0, 1.0, 0.0)])
    axis /= np.linalg.norm(axis)
    turns, pivot = Rotation.from_rotvec(rng.uniform(0, np.pi) * axis), np.nan_to_num(truth[:1, :1])
    if np.isfinite(truth).all() and rng.random() < 1 / 3:
        angle = np.arange(len(truth)) / FPS * rng.uniform(0.0, 2 * np.pi)
        turns, pivot = turns * Rotation.from_rotvec(angle[:, None] * axis), truth[:, :1].copy()
    for places in (observed, truth):
        places[:] = np.einsum("...ab,...jb->...ja", turns.as_matrix(), places - pivot) + pivot


def _swing(truth: Floats, rng: Rng) -> None:
    """Make a limb swing, in place: 0.5 to 4.5 Hz, amplitude up to 0.7 rad."""
    limb = _SWINGS[rng.integers(len(_SWINGS))]
    side = rng.choice(["left", "right"])
    pivot, *joints = (J[f"{side}_{n}"] for n in limb)
    frequency, phase = rng.uniform(0.5, 4.5), rng.uniform(0, 2 * np.pi)
    angle = rng.uniform(0.1, 0.7) * np.sin(phase + 2 * np.pi * frequency * np.arange(len(truth)) / FPS)
    axis = rng.standard_normal(3)
    turns = Rotation.from_rotvec(angle[:, None] * axis / np.linalg.norm(axis)).as_matrix()
    truth[:, joints] = truth[:, [pivot]] + np.einsum("tab,tjb->tja", turns, truth[:, joints] - truth[:, [pivot]])
