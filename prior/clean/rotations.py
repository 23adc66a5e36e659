"""The stages refine and orient: inverse kinematics, from joint positions to local rotations.

Refine solves the rotations of the newest frames. If enabled, HM-VAE refines them (equations 10 to 13).

Orient solves the published rotations. Two hips 18 cm apart, each with a bias, hardly determine the root's heading, and
a straight limb does not show its twist. Orient therefore solves for the joint positions that the whole body predicts
(`prior.models.posture`), weighted by their deviations. It averages the root's rotation from its own joints and from the
whole body's posture. Filters hold the twist of straight limbs and the usual direction of short bones
(`prior.body.rotation_filters`). Positions do not change.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.inverse_kinematics import solve_rotations
from steadypose.prior.body.kinematics import global_rotations, heading, yaw_matrix
from steadypose.prior.body.rotation_filters import follow_short_bones, follow_twist, unknown_turns, unknown_twist
from steadypose.prior.body.skeleton import PARENT
from steadypose.prior.clean.frame import Estimate, Gated, Person
from steadypose.prior.clean.history import Ring
from steadypose.prior.clean.settings import OrientSettings, RefineSettings
from steadypose.prior.compiled import njit
from steadypose.prior.models.hmvae import LiveHMVAE
from steadypose.prior.models.posture import LivePosture, average_root


class Refine:
    """Local rotations of the last frames: solved from the observed joints and, if enabled, refined by HM-VAE.

    A window N_1 … N_T is encoded to the posterior's mean and decoded. The fuse stage takes its frame ``T - 1 - delay``
    (counted from 0). With the default delay T / 2 this is index T / 2 - 1, the paper's M_{T/2} of equation 12. Smaller
    delays take later frames of the same window, down to the newest. Larger delays keep a frame as decoded at the
    centre. At the start of a stream, windows are padded with the first frame.
    """

    def __init__(self, settings: RefineSettings, delay_frames: int, slots: int) -> None:
        self._reconstruct = LiveHMVAE.load(settings.weights) if settings.enabled else None
        self._window = self._reconstruct.window if self._reconstruct else 1
        self._solved = Ring(self._window, (slots, 22, 3, 3))
        shape = (max(self._window, delay_frames + 1), slots, 22, 3, 3)
        self._decoded = np.broadcast_to(np.eye(3), shape).copy()

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        self._solved.clear(slot)
        self._decoded[:, slot] = np.eye(3)

    def update(self, gated: Gated, person: Person) -> Floats:
        """(K, S, 22, 3, 3) local rotations of the last frames; unobserved joints keep their last rotation."""
        slots = np.flatnonzero(gated.observation.present)
        self._solve(gated.positions, person.offsets, slots)
        kept = self._window // 2 + 1  # from the centre on; earlier frames stay as decoded when they were the centre
        self._decoded[:-1] = self._decoded[1:]
        frames = self._solved.all[:, slots]
        _repeat_first(frames)
        if self._reconstruct and len(slots):
            # remove the heading of the centre frame, as in training; only the root's rotation contains it
            back = yaw_matrix(heading(frames[self._window // 2 - 1, :, 0]))
            x = np.empty((len(slots), self._window, 22, 6), dtype=np.float32)
            _facing_forward(frames, back, x)
            frames = rotations_of(self._reconstruct(x)[:, -kept:], back)
        self._decoded[-kept:, slots] = frames[-kept:]
        return self._decoded

    def _solve(self, positions: Floats, offsets: Floats, slots: NDArray[np.intp]) -> None:
        """Solve the newest frame's rotations."""
        before = self._solved.newest[slots]
        fallback = np.where(np.isnan(before), np.eye(3), before)
        rotations = np.full_like(self._solved.newest, np.nan)
        rotations[slots] = solve_rotations(positions[slots], offsets[slots], fallback)
        self._solved.push(rotations)


class Orient:
    """Orientations of S bodies, frame by frame."""

    def __init__(self, settings: OrientSettings, slots: int) -> None:
        self._posture = LivePosture.load(settings.weights)
        self._twist, self._turns = unknown_twist(slots), unknown_turns(slots)

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        self._twist[slot], self._turns[slot] = unknown_twist(1), unknown_turns(1)

    def update(self, estimate: Estimate) -> Estimate:
        """Return the estimate with rotations solved from the whole body. Call it with frames in order."""
        slots = np.flatnonzero(np.isfinite(estimate.positions).all(axis=(1, 2)))
        if not len(slots):
            return estimate
        positions, sigma, offsets = estimate.positions[slots], estimate.sigma[slots], estimate.offsets[slots]
        expected = self._posture(positions, sigma, offsets)
        root = average_root(expected, positions, sigma, offsets)
        turned = global_rotations(solve_rotations(expected.positions, offsets, estimate.rotations[slots], root))
        twist, turns = self._twist[slots], self._turns[slots]
        follow_twist(turned, offsets, sigma, twist)
        follow_short_bones(turned, offsets, sigma, turns)
        self._twist[slots], self._turns[slots] = twist, turns
        local = turned.copy()
        local[:, 1:] = turned[:, PARENT[1:]].swapaxes(-1, -2) @ turned[:, 1:]
        rotations = estimate.rotations.copy()
        rotations[slots] = local
        return replace(estimate, rotations=rotations)


@njit(cache=True)
def _repeat_first(frames):
    """Fill the frames (T, B, 22, 3, 3) before a new body's first frame with that frame."""
    for row in range(frames.shape[1]):
        first = 0
        while first < len(frames) - 1 and math.isnan(frames[first, row, 0, 0, 0]):
            first += 1
        for t in range(first):
            for joint in range(frames.shape[2]):
                for i in range(3):
                    for j in range(3):
                        frames[t, row, joint, i, j] = frames[first, row, joint, i, j]


@njit(cache=True)
def _facing_forward(frames, back, x):
    """Write the first two columns of rotations (T, B, 22, 3, 3) to ``x`` (B, T, 22, 6), like the network's `to_6d`.

    The root's rotations are turned by the inverse of ``back`` (B, 3, 3).
    """
    for row in range(len(x)):
        for t in range(len(frames)):
            for column in range(2):
                for i in range(3):
                    turned = 0.0
                    for k in range(3):
                        turned += back[row, k, i] * frames[t, row, 0, k, column]
                    x[row, t, 0, 3 * column + i] = turned
                    for joint in range(1, 22):
                        x[row, t, joint, 3 * column + i] = frames[t, row, joint, i, column]


@njit(cache=True)
def rotations_of(x, back):
    """(T, B, 22, 3, 3) rotations of ``x`` (B, T, 22, 6), like the network's `from_6d`, with the root turned by
    ``back``."""
    rotations = np.empty((x.shape[1], len(x), 22, 3, 3))
    root = np.empty((3, 3))
    for row in range(len(x)):
        for t in range(x.shape[1]):
            for joint in range(22):
                _orthonormal(x[row, t, joint], rotations[t, row, joint])
            for i in range(3):
                for j in range(3):
                    root[i, j] = rotations[t, row, 0, i, j]
            for i in range(3):
                for j in range(3):
                    rotations[t, row, 0, i, j] = (
                        back[row, i, 0] * root[0, j] + back[row, i, 1] * root[1, j] + back[row, i, 2] * root[2, j]
                    )
    return rotations


@njit(cache=True)
def _orthonormal(x, r):
    """Write the rotation ``r`` (3, 3) that Gram-Schmidt orthonormalisation of the two columns ``x`` (6,) gives."""
    along = length = rest = 0.0
    for i in range(3):
        length += x[i] * x[i]
    for i in range(3):
        r[i, 0] = x[i] / max(math.sqrt(length), 1e-12)
        along += r[i, 0] * x[3 + i]
    for i in range(3):
        r[i, 1] = x[3 + i] - along * r[i, 0]
        rest += r[i, 1] * r[i, 1]
    for i in range(3):
        r[i, 1] /= max(math.sqrt(rest), 1e-12)
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        r[i, 2] = r[a, 0] * r[b, 1] - r[b, 0] * r[a, 1]
