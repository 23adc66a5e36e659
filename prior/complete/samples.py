"""Draws alternatives to a completed motion: samples of what was not observed.

A completion is the expected motion. An alternative differs from it by a smooth Gaussian process. The differences of
joints are correlated as in the Gaussian of postures, given the known joints, and their standard deviations are the
published ones. Alternatives are therefore about as far from the completion as the truth is, and known joints do not
change.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.inverse_kinematics import HELD, fit_lengths, solve_rotations
from steadypose.prior.complete.body import Completed, frames_apart
from steadypose.prior.models.posture import trunk_frame

SMOOTH = 30.0
"""Standard deviation of the Gaussian that smooths the process in time, frames. Hidden limbs then accelerate about as
real ones do."""

CHANGE = 3.0
"""The same for the process given the known joints, frames, which appear and disappear from one frame to the next."""

EASE = 8.0  # time in which an alternative parts from a joint's last observation, frames
KNOWN_SIGMA = 0.02  # standard deviation along an axis of a known joint's difference from a posture, metres of an adult


def draw(
    completed: Completed, sigma: Floats, offsets: Floats, covariance: Floats, random: np.random.Generator
) -> Completed:
    """Draw an alternative to a completion of T frames, with deviations (T, 22) metres along an axis and bones (22, 3).

    ``covariance`` (66, 66) is of joints in the trunk's frame (`LivePosture.covariance`). Frames without positions do
    not change.
    """
    rows = np.isfinite(completed.positions).all(axis=(1, 2))
    joints, known = completed.positions[rows], completed.known[rows]
    size = gaussian_filter1d(sigma[rows], CHANGE, axis=0, mode="nearest")
    size *= -np.expm1(-np.square(frames_apart(known) / EASE))
    steps = _differences(known, covariance, random).reshape(joints.shape)
    joints = joints + size[..., None] * (steps @ trunk_frame(joints).swapaxes(-1, -2))
    joints = np.where(
        known[..., None], completed.positions[rows], fit_lengths(joints, offsets, np.where(known, HELD, 1.0))
    )
    positions, rotations = completed.positions.copy(), completed.rotations.copy()
    partly = ~known.all(axis=1)
    drawn = np.flatnonzero(rows)[partly]
    positions[drawn] = joints[partly]
    rotations[drawn] = solve_rotations(joints[partly], offsets, rotations[drawn])
    return replace(completed, positions=positions, rotations=rotations)


def _differences(known: Bools, covariance: Floats, random: np.random.Generator) -> Floats:
    """(T, 66) a smooth process with unit variance in every entry, given that it is zero at ``known`` (T, 22) joints.

    A draw from the Gaussian minus its expectation, given the drawn values at known joints, is a draw from the
    Gaussian given zeros there (Matheron's rule).
    """
    factor = np.linalg.cholesky(covariance)
    smooth = gaussian_filter1d(random.standard_normal((len(known) + 8 * round(SMOOTH), 66)), SMOOTH, axis=0)
    smooth = smooth[4 * round(SMOOTH) : len(known) + 4 * round(SMOOTH)]
    drawn = (smooth * np.sqrt(2.0 * np.sqrt(np.pi) * SMOOTH)) @ factor.T
    given = np.empty_like(drawn)
    masks, which = np.unique(known, axis=0, return_inverse=True)
    for k, mask in enumerate(masks):
        rows, fixed = which.ravel() == k, np.repeat(mask, 3)
        left = covariance
        off = drawn[rows]
        if fixed.any():
            noisy = covariance[np.ix_(fixed, fixed)] + KNOWN_SIGMA**2 * np.eye(int(fixed.sum()))
            gain = np.linalg.solve(noisy, covariance[fixed]).T
            off = off - off[:, fixed] @ gain.T
            left = covariance - gain @ covariance[fixed]
        given[rows] = off / np.sqrt(np.maximum(np.diag(left), 1e-8))
    return gaussian_filter1d(given, CHANGE, axis=0, mode="nearest")
