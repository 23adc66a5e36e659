"""Errors against the ground truth of a recording, if it has one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.topics import POSE_CLEAN, POSE_RAW, POSE_TRUTH, POSE_WORLD
from steadypose.nodes.commands.plot.history import History, Track

MAX_TRUTH_GAP_S = 0.05
"""the furthest that a true pose may be from the stamp it is compared at"""


class TrackError(NamedTuple):
    """How far a track is from the truth."""

    time: NDArray[np.float64]
    """(T,) seconds"""
    mean: NDArray[np.float64]
    """(T,) metres, over the joints given"""
    by_joint: NDArray[np.float64]
    """(22,) metres, over time"""


def errors_of(history: History, body: int) -> dict[str, TrackError]:
    """Errors of a body's joints on each topic."""
    truth = [person for person in history.tracks.get(POSE_TRUTH, {}).values() if len(person.time) > 1]
    found = {}
    for topic in (POSE_RAW, POSE_CLEAN, POSE_WORLD):
        track = history.track(topic, body)
        if track is None or not truth:
            continue
        joints = np.stack([_distances(track, person, placed=history.calibrated) for person in truth])
        means = np.stack([nan_mean(distances, axis=1) for distances in joints])
        some = np.flatnonzero(np.isfinite(means).any(axis=0))
        if len(some):
            # the sensor's ids need not be those of the truth: the nearest person is the one that is meant
            nearest = np.nanargmin(means[:, some], axis=0)
            found[topic] = TrackError(track.time[some], means[nearest, some], nan_mean(joints[nearest, some], axis=0))
    return found


def _distances(track: Track, truth: Track, *, placed: bool) -> NDArray[np.float64]:
    """(T, 22) metres from a track's joints to the true ones at the same moments; NaN where either is missing.

    Args:
        placed: whether the track's place in the world is known; if not, it is first put where it fits best.
    """
    index = np.clip(np.searchsorted(truth.time, track.time), 1, len(truth.time) - 1)
    before, after = truth.time[index - 1], truth.time[index]
    share = np.clip((track.time - before) / np.maximum(after - before, 1e-9), 0, 1)[:, None, None]
    expected = truth.positions[index - 1] * (1 - share) + truth.positions[index] * share
    far = np.minimum(np.abs(track.time - before), np.abs(after - track.time)) > MAX_TRUTH_GAP_S
    expected[far] = np.nan
    positions = track.positions if placed else _aligned(track.positions, expected)
    return np.linalg.norm(positions - expected, axis=2)


def _aligned(positions: NDArray[np.float64], expected: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions (T, 22, 3), shifted and turned about the vertical, once for all, to where they fit the expected."""
    both = np.isfinite(positions).all(axis=2) & np.isfinite(expected).all(axis=2)
    if not both.any():
        return positions
    origin, target = positions[both].mean(axis=0), expected[both].mean(axis=0)
    p, q = positions[both] - origin, expected[both] - target
    turn = np.arctan2(np.sum(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]), np.sum(p[:, 0] * q[:, 0] + p[:, 1] * q[:, 1]))
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    return (positions - origin) @ rotation.T + target


def nan_mean(values: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """The mean of what is not NaN; NaN where all is."""
    counted = np.isfinite(values)
    total = np.where(counted, values, 0.0).sum(axis=axis)
    number = counted.sum(axis=axis)
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)
