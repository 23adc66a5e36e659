"""Interpolation of tracks between the frames in which each is known: slerp, lerp, and natural cubic splines."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Bools, Floats, Floats32
from steadypose.prior.compiled import njit


class Line(NamedTuple):
    """Interpolation of each track of B windows: here 22 rotations and, last, the root's position."""

    before: NDArray[np.int64]  # (B, T, 23) index of the last known frame; of the next one if there is none before
    after: NDArray[np.int64]  # (B, T, 23) index of the next known frame; of the last one if there is none after
    weight: Floats32  # (B, T, 23) float32, interpolation weight from 0 (before) to 1 (after)
    known: Bools  # (B, T, 23) whether the frame itself is known
    ever: Bools  # (B, 23) whether any frame is known


def draw_line(known: Bools) -> Line:
    """Build the line of K tracks from the frames in which each is ``known`` (B, T, K)."""
    shape = known.shape
    before, after = np.zeros(shape, dtype=np.int64), np.zeros(shape, dtype=np.int64)
    weight = np.zeros(shape, dtype=np.float32)
    _neighbours(known, before, after, weight)
    return Line(before, after, weight, known, np.asarray(known.any(axis=1)))


def lerp(values: Floats, line: Line, tracks: slice) -> Floats:
    """(B, T, K, d) values interpolated linearly between known frames; 0 for tracks that are never known."""
    first = np.take_along_axis(values, line.before[..., tracks, None], axis=1)
    second = np.take_along_axis(values, line.after[..., tracks, None], axis=1)
    weight = line.weight[..., tracks, None]
    return np.where(line.ever[:, None, tracks, None], (1 - weight) * first + weight * second, 0.0)


def anchored(values: Floats, line: Line, tracks: slice) -> Floats:
    """Subtract from a network's output (B, T, K, d) for these tracks the line through its values at known frames."""
    return values - lerp(values, line, tracks)


@njit(cache=True)
def _neighbours(known, before, after, weight):
    count, frames, tracks = known.shape
    for row in range(count):
        for k in range(tracks):
            last = -1
            for t in range(frames):
                if known[row, t, k]:
                    last = t
                before[row, t, k] = last
            last = -1
            for t in range(frames - 1, -1, -1):
                if known[row, t, k]:
                    last = t
                after[row, t, k] = last
            for t in range(frames):
                a, b = before[row, t, k], after[row, t, k]
                if a < 0 and b < 0:
                    before[row, t, k] = after[row, t, k] = 0
                elif a < 0:
                    before[row, t, k] = b
                elif b < 0:
                    after[row, t, k] = a
                elif b > a:
                    weight[row, t, k] = (t - a) / (b - a)


@njit(cache=True)
def write_splines(values, known, out):
    """Write the natural cubic spline through a track's known frames between them, if there are more than two.

    All tracks but the last are quaternions, each with the sign that is nearer to the one before.
    """
    count, frames, tracks, size = values.shape
    at, q = np.empty(frames, np.int64), np.empty((frames, size))
    above, curve = np.empty(frames), np.empty(frames)
    for row in range(count):
        for k in range(tracks):
            knots = 0
            for t in range(frames):
                if known[row, t, k]:
                    q[knots] = values[row, t, k]
                    if knots > 0 and k < tracks - 1 and (q[knots] * q[knots - 1]).sum() < 0:
                        q[knots] *= -1.0
                    at[knots] = t
                    knots += 1
            if knots < 3 or knots == frames:
                continue
            for i in range(size):
                # second derivatives at the knots, 0 at the first and last: a tridiagonal system, by elimination
                above[0] = curve[0] = curve[knots - 1] = 0.0
                for n in range(1, knots - 1):
                    left, right = at[n] - at[n - 1], at[n + 1] - at[n]
                    pivot = 2.0 * (left + right) - left * above[n - 1]
                    above[n] = right / pivot
                    turn = (q[n + 1, i] - q[n, i]) / right - (q[n, i] - q[n - 1, i]) / left
                    curve[n] = (6.0 * turn - left * curve[n - 1]) / pivot
                for n in range(knots - 2, 0, -1):
                    curve[n] -= above[n] * curve[n + 1]
                for n in range(knots - 1):
                    length = at[n + 1] - at[n]
                    for t in range(at[n] + 1, at[n + 1]):
                        s = (t - at[n]) / length
                        bend = ((1 - s) ** 3 - 1 + s) * curve[n] + (s**3 - s) * curve[n + 1]
                        out[row, t, k, i] = (1 - s) * q[n, i] + s * q[n + 1, i] + bend * length * length / 6.0


@njit(cache=True)
def write_slerp(q, before, after, weight, ever, usual, out):
    """Write the quaternions (B, T, K, 4) interpolated along a `Line`; ``usual`` (K, 4) where a track is never known."""
    count, frames, joints = q.shape[:3]
    for row in range(count):
        for t in range(frames):
            for j in range(joints):
                if not ever[row, j]:
                    out[row, t, j] = usual[j]
                    continue
                a, b = q[row, before[row, t, j], j], q[row, after[row, t, j], j]
                cos = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
                sign = 1.0 if cos >= 0 else -1.0
                angle = math.acos(min(abs(cos), 1.0))
                w = weight[row, t, j]
                first, second = 1.0 - w, w
                if angle > 1e-4:
                    first, second = math.sin(first * angle) / math.sin(angle), math.sin(w * angle) / math.sin(angle)
                length = 0.0
                for i in range(4):
                    out[row, t, j, i] = first * a[i] + sign * second * b[i]
                    length += out[row, t, j, i] ** 2
                for i in range(4):
                    out[row, t, j, i] /= math.sqrt(length)
