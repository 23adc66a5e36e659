"""Baselines of completion: they fill gaps, or hidden parts of a body, without a network.

Each returns local rotations and the root of whole windows, as `prior.complete.body.Fill`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp
from sklearn.metrics import pairwise_distances_argmin

from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import heading, yaw_matrix
from steadypose.training.data.dataset import MotionSet

InBetween = Callable[[Floats, Floats, Floats], tuple[Floats, Floats]]
"""Maps clips (C, T, 22, 3) metres, NaN in the gap, with rotations (C, T, 22, 3, 3) and bones (C, 22, 3), to the filled
rotations and roots (C, T, 3)."""


def zero_velocity(positions: Floats, rotations: Floats, offsets: Floats) -> tuple[Floats, Floats]:
    """Hold the last pose before the gap."""
    known = np.isfinite(positions[0, :, 0, 0])
    rows = np.maximum.accumulate(np.where(known, np.arange(len(known)), 0))
    return rotations[:, rows], positions[:, rows, 0]


def slerp_and_lerp(positions: Floats, rotations: Floats, offsets: Floats) -> tuple[Floats, Floats]:
    """Interpolate rotations along the shortest arc, and the root along a line."""
    rows = np.flatnonzero(np.isfinite(positions[0, :, 0, 0]))
    times = np.arange(positions.shape[1])
    turned = np.empty_like(rotations)
    for clip in range(len(rotations)):
        for joint in range(22):
            arc = Slerp(rows, Rotation.from_matrix(rotations[clip, rows, joint]))
            turned[clip, :, joint] = arc(times).as_matrix()
    root = positions[:, rows, 0]
    places = [np.interp(times, rows, root[c, :, k]) for c in range(len(root)) for k in range(3)]
    return turned, np.reshape(places, (len(root), 3, -1)).swapaxes(1, 2)


def cubic_spline(positions: Floats, rotations: Floats, offsets: Floats) -> tuple[Floats, Floats]:
    """Fit a natural cubic spline through all known roots and quaternions, and normalise the quaternions."""
    rows = np.flatnonzero(np.isfinite(positions[0, :, 0, 0]))
    times = np.arange(positions.shape[1])
    q = Rotation.from_matrix(rotations[:, rows].reshape(-1, 3, 3)).as_quat().reshape(len(positions), len(rows), 22, 4)
    for t in range(1, len(rows)):  # keep the sign of the quaternion before
        q[:, t] *= np.where((q[:, t] * q[:, t - 1]).sum(axis=-1, keepdims=True) < 0, -1.0, 1.0)
    between = CubicSpline(rows, q, axis=1, bc_type="natural")(times)
    turned = Rotation.from_quat(between.reshape(-1, 4)).as_matrix().reshape(*between.shape[:3], 3, 3)
    return turned, CubicSpline(rows, positions[:, rows, 0], axis=1, bc_type="natural")(times)


class NearestWindow:
    """The training window nearest in the known joints, fitted between the known ends.

    Its deviation from slerp and lerp between its own ends is added to slerp and lerp between the known ends.
    """

    def __init__(self, motion: MotionSet, step: int = 5) -> None:
        self._motion, self._step = motion, step

    def __call__(self, positions: Floats, rotations: Floats, offsets: Floats) -> tuple[Floats, Floats]:
        frames = positions.shape[1]
        known = np.flatnonzero(np.isfinite(positions[0, :, 0, 0]))
        asked = known[[0, len(known) // 2, -2, -1]]
        windows = self._motion.all_windows(frames, self._step)
        bank = self._motion.positions[windows[:, asked]].double().numpy()
        facing = heading(self._motion.rotations[windows[:, known[-2]], 0].double().numpy())
        bank = _seen_from(bank, facing)
        query = _seen_from(positions[:, asked], heading(rotations[:, known[-2], 0]))
        nearest = windows[pairwise_distances_argmin(query.reshape(len(query), -1), bank.reshape(len(bank), -1))]
        there, there_root = (
            self._motion.rotations[nearest].double().numpy(),
            self._motion.positions[nearest, 0].double().numpy(),
        )
        shown = np.where(np.isfinite(positions), 0.0, np.nan)
        shown[:, :, 0] += there_root
        line, line_root = slerp_and_lerp(shown, there, offsets)
        own, own_root = slerp_and_lerp(positions, rotations, offsets)
        turn = yaw_matrix(heading(rotations[:, known[-2], 0]) - heading(there[:, known[-2], 0]))[:, None]
        there, line = there.copy(), line.copy()
        for poses in (there, line):
            poses[:, :, 0] = turn @ poses[:, :, 0]
        answer = own @ (line.swapaxes(-1, -2) @ there)
        return answer, own_root + (turn @ (there_root - line_root)[..., None])[..., 0]


def _seen_from(joints: Floats, yaw: Floats) -> Floats:
    """Return joints (N, K, 22, 3) rotated so that the body faces +x, with the last but one's root at the origin."""
    return (joints - joints[:, -2, None, :1]) @ yaw_matrix(yaw)[:, None]


class NearestPose:
    """Fills always hidden parts of a body from the training window nearest in the other joints."""

    EVERY = 5

    def __init__(self, motion: MotionSet, frames: int, step: int = 10) -> None:
        self._motion = motion
        self._windows = motion.all_windows(frames, step)
        rows = self._windows[:, :: self.EVERY]
        facing = heading(motion.rotations[rows[:, 0], 0].double().numpy())
        self._bank = _about_root(motion.positions[rows].numpy(), facing).astype(np.float32)

    def __call__(self, positions: Floats, truth_yaw: Floats, hidden: Sequence[int]) -> Floats:
        """Fill the joints ``hidden`` of clips (C, T, 22, 3) metres, about the known root; ``truth_yaw`` (C,) radians is
        the heading in the first frame.
        """
        seen = np.setdiff1d(np.arange(22), hidden)
        query = _about_root(positions[:, :: self.EVERY], truth_yaw)[:, :, seen]
        bank = self._bank[:, :, seen].reshape(len(self._bank), -1)
        windows = self._windows[pairwise_distances_argmin(query.reshape(len(query), -1), bank)]
        facing = heading(self._motion.rotations[windows[:, 0], 0].double().numpy())
        there = _about_root(self._motion.positions[windows].double().numpy(), facing)
        back = there @ yaw_matrix(truth_yaw).swapaxes(-1, -2)[:, None] + positions[:, :, :1]
        return np.where(np.isfinite(positions), positions, back)


def _about_root(joints: NDArray[np.floating], yaw: Floats) -> Floats:
    return (joints - joints[:, :, :1]) @ yaw_matrix(yaw)[:, None]
