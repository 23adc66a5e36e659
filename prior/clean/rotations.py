"""The stages refine and orient: inverse kinematics, from joint positions to local rotations.

Refine solves the rotations of the newest frames. If enabled, HM-VAE refines them (equations 10 to 13).

Orient solves the published rotations. Two hips 18 cm apart, each with a bias, hardly determine the root's heading, and
a straight limb does not show its twist. Orient therefore solves for the joint positions that the whole body predicts
(`prior.models.posture`), weighted by their deviations. It averages the root's rotation from its own joints and from the
whole body's posture. Filters hold the twist of straight limbs and the usual direction of short bones
(`prior.body.rotation_filters`). Positions do not change.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Bools, Floats, Floats32
from steadypose.prior.body.inverse_kinematics import solve_rotations
from steadypose.prior.body.kinematics import global_rotations, heading, yaw_matrix
from steadypose.prior.body.rotation_filters import UNKNOWN_TURNS, UNKNOWN_TWIST, follow_short_bones, follow_twist
from steadypose.prior.body.skeleton import PARENT
from steadypose.prior.clean.frame import Estimate, Gated, Person
from steadypose.prior.clean.history import Ring
from steadypose.prior.clean.settings import OrientSettings, RefineSettings
from steadypose.prior.models.hmvae import LiveHMVAE
from steadypose.prior.models.pelvis import average_root
from steadypose.prior.models.posture import LivePosture

LIMIT = 1.5
"""Limit of the moves of joints, in their standard deviations: few training people raise an arm as high as some do."""


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
        if self._reconstruct and len(slots):
            first = np.isnan(frames[..., 0, 0, 0]).sum(axis=0)  # of a new body
            frames = frames[np.maximum(np.arange(self._window)[:, None], first), np.arange(len(slots))]
            # remove the heading of the centre frame, as in training; only the root's rotation contains it
            back = yaw_matrix(heading(frames[self._window // 2 - 1, :, 0]))
            frames[:, :, 0] = _product(back.swapaxes(-1, -2), frames[:, :, 0])
            x = frames[..., :2].swapaxes(-1, -2).reshape(*frames.shape[:3], 6).swapaxes(0, 1).astype(np.float32)
            frames = _rotations_of(self._reconstruct(x)[:, -kept:].swapaxes(0, 1))
            frames[:, :, 0] = _product(back, frames[:, :, 0])
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
        self._twist, self._turns = (np.tile(of_body, (slots, 1, 1)) for of_body in (UNKNOWN_TWIST, UNKNOWN_TURNS))

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        self._twist[slot], self._turns[slot] = UNKNOWN_TWIST, UNKNOWN_TURNS

    def update(self, estimate: Estimate) -> Estimate:
        """Return the estimate with rotations solved from the whole body. Call it with frames in order."""
        slots = np.flatnonzero(np.isfinite(estimate.positions).all(axis=(1, 2)))
        if not len(slots):
            return estimate
        positions, sigma, offsets = estimate.positions[slots], estimate.sigma[slots], estimate.offsets[slots]
        expected = self._posture(positions, sigma, np.linalg.norm(offsets, axis=-1), limit=LIMIT)
        root = average_root(self._posture.root(expected), positions, sigma, offsets)
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


def _product(a: Floats, b: Floats) -> Floats:
    """Return ``a @ b``. The product of matrices in BLAS rounds differently on each processor."""
    return (a[..., None] * b[..., None, :, :]).sum(axis=-2)


def _rotations_of(x: Floats32) -> Floats:
    """Convert first two columns (..., 6) to rotations (..., 3, 3), like the network's `from_6d`."""
    first, second = x[..., :3], x[..., 3:]
    first = first / np.sqrt(np.square(first).sum(axis=-1, keepdims=True, dtype=np.float64))
    second = second - (first * second).sum(axis=-1, keepdims=True) * first
    second /= np.linalg.norm(second, axis=-1, keepdims=True)
    return np.stack([first, second, np.cross(first, second)], axis=-1)
