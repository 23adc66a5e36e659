"""HG-VAE's input: windows of root-relative joints (*tracks*) of a body of standard size that faces forward.

The root is a smooth trajectory, the *path*: a filtered mean of the trunk's observed joints, which neither jitters
with one noisy joint nor jumps when a joint disappears. Motion up to 2 Hz is in the path, and faster motion (of a camera
that bounces, for example) as far as it exceeds the noise. The track of every joint except the pelvis is its position
relative to the path. The pelvis's track is relative to the path's mean, so it contains the locomotion. Unobserved
entries are interpolated, as a start for the completion network: in a gap, a joint's offset from its parent is
interpolated linearly; before the first and after the last observation, the offset is held.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.body.skeleton import HIPS, PARENT, REST_OFFSETS, REST_POSITIONS, SHOULDERS, TRUNK, J
from steadypose.prior.compiled import njit

_SIDES = np.array([HIPS, SHOULDERS])
_TALL = np.array([J[n] for n in ("left_knee", "left_ankle", "right_knee", "right_ankle", "spine1", "spine2", "spine3",
                                 "neck")])  # fmt: skip
_STANDARD = float(np.linalg.norm(REST_OFFSETS[_TALL], axis=-1).sum())
_KEPT = 8
"""Number of cosine coefficients of the path that are kept whatever the noise: up to 2 Hz for a window of 50 frames."""

_LEAST_VARIANCE = 1e-12  # least variance of a frequency of the path, m², so that its filter is defined


class Tracks(NamedTuple):
    """Windows, each in its body's frame."""

    x: NDArray[np.float64]
    """(..., 66, T) metres of a body of standard size; node ``3 * joint + axis``. NaN for a joint never observed"""
    observed: NDArray[np.float64]  # (..., 66, T) 1 where observed, else 0
    path: NDArray[np.float64]
    """(..., T, 3) metres, world, origin of all joints except the pelvis, whose origin is the path's mean"""
    yaw: NDArray[np.float64]  # (...) radians, mean heading of the window


def body_size(offsets: NDArray[np.floating]) -> NDArray[np.float64]:
    """(...) total length of legs and spine with bones (..., 22, 3), relative to the generic adult's."""
    return np.sqrt((offsets[..., _TALL, :] ** 2).sum(axis=-1)).sum(axis=-1) / _STANDARD


def to_tracks(
    positions: NDArray[np.float64],
    size: NDArray[np.floating] | float,
    noise_ratio: NDArray[np.floating] | float = math.inf,
) -> Tracks:
    """Convert windows to tracks.

    Args:
        positions: (..., T, 22, 3) metres, z up, NaN where missing.
        size: (...) sizes of the bodies (`body_size`).
        noise_ratio: (...) largest ratio of the deviation of the trunk's noise at any frequency to that at the highest
            frequencies, where it is measured. If it is infinite, the path is low-passed at 2 Hz.
    """
    batch, frames = positions.shape[:-3], positions.shape[-3]
    windows = np.ascontiguousarray(positions, dtype=np.float64).reshape(-1, frames, 22, 3)
    sizes, ratios = np.empty(batch), np.empty(batch)
    sizes[...], ratios[...] = size, noise_ratio
    x, observed = np.empty((2, len(windows), 66, frames))
    path, yaw = np.empty((len(windows), frames, 3)), np.empty(len(windows))
    _to_tracks(windows, sizes.ravel(), ratios.ravel(), _cosines(frames), x, observed, path, yaw)
    return Tracks(*(part.reshape((*batch, *part.shape[1:])) for part in (x, observed, path, yaw)))


def in_frame_of(tracks: Tracks, positions: NDArray[np.float64], size: float) -> NDArray[np.float64]:
    """Convert other positions (T, 22, 3), such as ground truth, to tracks (66, T) in the frame of ``tracks``."""
    local = positions - tracks.path[:, None]
    local[:, 0] = positions[:, 0] - tracks.path.mean(axis=0)
    c, s = math.cos(tracks.yaw), math.sin(tracks.yaw)
    local = local @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) / size
    return local.transpose(1, 2, 0).reshape(66, -1)


def from_tracks(x: NDArray[np.float64], tracks: Tracks, size: NDArray[np.floating] | float) -> NDArray[np.float64]:
    """Convert tracks of the last K frames to joint positions (..., K, 22, 3) metres, world: the inverse of `to_tracks`.

    Args:
        x: (..., 66, K) tracks of those frames.
        tracks: the windows of T >= K frames that define the frames of ``x``.
        size: (...) sizes of the bodies (`body_size`).
    """
    batch, frames = x.shape[:-2], x.shape[-1]
    sizes, world = np.empty(batch), np.empty((*batch, frames, 22, 3))
    sizes[...] = size
    flat = np.ascontiguousarray(x).reshape(-1, 66, frames), tracks.path.reshape(-1, *tracks.path.shape[-2:])
    _from_tracks(*flat, tracks.yaw.ravel(), sizes.ravel(), world.reshape(-1, frames, 22, 3))
    return world


def hang_unseen(deviations: NDArray[np.floating]) -> None:
    """Give each joint that was never observed (NaN) its parent's deviation, in place. ``deviations`` (..., 66, T) are
    differences from the mean tracks."""
    _hang_unseen(deviations.reshape(-1, 22, 3, deviations.shape[-1]))


_bases: dict[int, NDArray[np.float64]] = {}


def _cosines(frames: int) -> NDArray[np.float64]:
    """(T, T) orthonormal cosine transform; row k is the k-th frequency."""
    if frames not in _bases:
        k, n = np.arange(frames)[:, None], np.arange(frames)
        basis = np.sqrt(2 / frames) * np.cos(np.pi / (2 * frames) * (2 * n + 1) * k)
        basis[0] /= np.sqrt(2)
        _bases[frames] = basis
    return _bases[frames]


# ---------------------------------------------------------------------------------------------------------------
# Compiled, without vectors in the loops over joints and frames: allocating them would take most of the time.


@njit(cache=True)
def _to_tracks(windows, sizes, noise_ratios, cosines, all_x, all_observed, all_path, yaws):
    """Write the four parts of `Tracks` for B windows (B, T, 22, 3)."""
    frames, joints = windows.shape[1:3]
    still = np.zeros(frames)
    middle = np.empty((frames, 3))
    for window in range(len(windows)):
        positions, x, observed = windows[window], all_x[window], all_observed[window]
        yaw = yaws[window] = _heading(positions)
        path = all_path[window]
        _write_path(positions, yaw, sizes[window], noise_ratios[window], cosines, path)
        for axis in range(3):
            mean = _mean(path, axis)
            for t in range(frames):
                middle[t, axis] = mean
        c, s = math.cos(yaw) / sizes[window], math.sin(yaw) / sizes[window]
        for j in range(joints):
            origin = middle if j == 0 else path
            missing = 0
            for t in range(frames):
                a = positions[t, j, 0] - origin[t, 0]
                b = positions[t, j, 1] - origin[t, 1]
                x[3 * j, t] = c * a + s * b
                x[3 * j + 1, t] = c * b - s * a
                x[3 * j + 2, t] = (positions[t, j, 2] - origin[t, 2]) / sizes[window]
                missing += math.isnan(a)
                for axis in range(3):
                    observed[3 * j + axis, t] = 0.0 if math.isnan(a) else 1.0
            if missing == 0:
                continue
            parent = PARENT[j]
            while parent > 0 and math.isnan(x[3 * parent, 0]):
                parent = PARENT[parent]
            for axis in range(3):
                # relative to the nearest ancestor that was ever observed, whose gaps are already filled
                _bridge(x[3 * j + axis], x[3 * parent + axis] if parent > 0 else still)


@njit(cache=True)
def _observed_throughout(positions):
    """(9,) which joints of the trunk are observed in every frame in which any of them is."""
    whole = np.ones(len(TRUNK), dtype=np.bool_)
    for t in range(len(positions)):
        some = False
        for k in range(len(TRUNK)):
            some |= not math.isnan(positions[t, TRUNK[k], 0])
        for k in range(len(TRUNK)):
            whole[k] &= not (some and math.isnan(positions[t, TRUNK[k], 0]))
    return whole


@njit(cache=True)
def _write_path(positions, yaw, size, noise_ratio, cosines, path):
    """Write the path (T, 3): the trunk's centre, whose fast part passes a Wiener filter.

    The filter multiplies each frequency by the signal's share of the variance. That of signal and noise is the mean
    over neighbouring frequencies and the three axes; the noise's is that of the highest third of the frequencies, times
    the square of ``noise_ratio``. The fast part is that of the joints observed throughout, because the centre of all
    jumps where one comes or goes.
    """
    frames = len(positions)
    whole = _observed_throughout(positions)
    coefficients = np.dot(cosines, _centre(positions, yaw, size, np.ones(len(whole), dtype=np.bool_)))
    fast = coefficients
    if whole.any() and not whole.all():
        fast = np.dot(cosines, _centre(positions, yaw, size, whole))
    square = np.zeros(frames)
    for k in range(frames):
        for axis in range(3):
            square[k] += fast[k, axis] ** 2 / 3.0
    noise = math.inf
    if whole.any():
        noise = noise_ratio**2 * max(_mean_of(square, 2 * frames // 3, frames), _LEAST_VARIANCE)
    for k in range(_KEPT, frames):
        variance = _mean_of(square, max(k - 1, _KEPT), min(k + 2, frames))
        signal = max(0.0, 1.0 - noise / max(variance, _LEAST_VARIANCE))
        for axis in range(3):
            coefficients[k, axis] = signal * fast[k, axis]
    along = np.dot(np.ascontiguousarray(coefficients.T), cosines)
    for t in range(frames):
        for axis in range(3):
            path[t, axis] = along[axis, t]


@njit(cache=True)
def _mean_of(values, first, end):
    total = 0.0
    for k in range(first, end):
        total += values[k]
    return total / (end - first)


@njit(cache=True)
def _from_tracks(x, path, yaws, sizes, world):
    """Write ``world`` (B, K, 22, 3) for B windows, from tracks (B, 66, K) and paths (B, T, 3)."""
    frames = x.shape[2]
    middle = np.empty(3)
    for window in range(len(x)):
        c, s = math.cos(yaws[window]), math.sin(yaws[window])
        for axis in range(3):
            middle[axis] = _mean(path[window], axis)
        for t in range(frames):
            along = path[window, path.shape[1] - frames + t]
            for joint in range(22):
                origin = middle if joint == 0 else along
                a, b = sizes[window] * x[window, 3 * joint, t], sizes[window] * x[window, 3 * joint + 1, t]
                world[window, t, joint, 0] = c * a - s * b + origin[0]
                world[window, t, joint, 1] = s * a + c * b + origin[1]
                world[window, t, joint, 2] = sizes[window] * x[window, 3 * joint + 2, t] + origin[2]


@njit(cache=True)
def _mean(path, axis):
    total = 0.0
    for t in range(len(path)):
        total += path[t, axis]
    return total / len(path)


@njit(cache=True)
def _hang_unseen(deviations):
    """Compute `hang_unseen` for (N, 22, 3, T)."""
    for row in range(len(deviations)):
        window = deviations[row]
        for joint in range(len(PARENT)):
            parent = PARENT[joint]
            if math.isnan(window[joint, 0, 0]):
                for axis in range(3):
                    for t in range(window.shape[-1]):
                        # the pelvis's own track has another origin
                        window[joint, axis, t] = window[parent, axis, t] if parent > 0 else 0.0


@njit(cache=True)
def _bridge(track, above):
    """Fill the gaps of a track (T,), in place: interpolate its offset from ``above`` linearly, hold it at the ends."""
    frames = len(track)
    last = -1
    for t in range(frames + 1):
        if t < frames and math.isnan(track[t]):
            continue
        if t == frames and last < 0:
            return
        for u in range(last + 1, t):
            share = 1.0 if last < 0 else (0.0 if t == frames else (u - last) / (t - last))
            beside = 0.0
            if last >= 0:
                beside += (1.0 - share) * (track[last] - above[last])
            if t < frames:
                beside += share * (track[t] - above[t])
            track[u] = above[u] + beside
        last = t


@njit(cache=True)
def _heading(positions):
    """Return `prior.body.kinematics.heading` of the mean vector from right to left, over hips and shoulders."""
    a = b = 0.0
    for t in range(len(positions)):
        for k in range(len(_SIDES)):
            left, right = _SIDES[k]
            dx = positions[t, left, 0] - positions[t, right, 0]
            dy = positions[t, left, 1] - positions[t, right, 1]
            if not math.isnan(dx):
                a += dx
                b += dy
    return math.atan2(-a, b)


@njit(cache=True)
def _centre(positions, yaw, size, among):
    """(T, 3) pelvis position from those joints of the trunk that are ``among`` (9,) and observed; interpolated or held
    where none is."""
    frames = len(positions)
    c, s = math.cos(yaw), math.sin(yaw)
    centre = np.zeros((frames, 3))
    weight = np.zeros(frames)
    lies, seen = np.zeros(3), np.zeros(3)
    for k in range(len(TRUNK)):
        if not among[k]:
            continue
        j, count = TRUNK[k], 0
        for axis in range(3):
            seen[axis] = 0.0
        for t in range(frames):
            if not math.isnan(positions[t, j, 0]) and not math.isnan(positions[t, 0, 0]):
                for axis in range(3):
                    seen[axis] += positions[t, j, axis] - positions[t, 0, axis]
                count += 1
        # the joint's offset from the pelvis: as observed in this window, or a generic body's
        lies[0] = size * (c * REST_POSITIONS[j, 0] - s * REST_POSITIONS[j, 1])
        lies[1] = size * (s * REST_POSITIONS[j, 0] + c * REST_POSITIONS[j, 1])
        lies[2] = size * REST_POSITIONS[j, 2]
        for axis in range(3):
            if count:
                lies[axis] = seen[axis] / count
        for t in range(frames):
            if not math.isnan(positions[t, j, 0]):
                for axis in range(3):
                    centre[t, axis] += positions[t, j, axis] - lies[axis]
                weight[t] += 1.0
    last = -1
    for t in range(frames):
        if weight[t] == 0.0:
            continue
        for axis in range(3):
            centre[t, axis] /= weight[t]
        for u in range(last + 1, t):
            share = 1.0 if last < 0 else (u - last) / (t - last)
            for axis in range(3):
                centre[u, axis] = share * centre[t, axis] + (1.0 - share) * centre[max(last, 0), axis]
        last = t
    for u in range(last + 1, frames):
        for axis in range(3):
            centre[u, axis] = centre[max(last, 0), axis]
    return centre
