"""A joint's own smoother over a gap that has ended within the delay: the observations on either side place it.

The estimate is that of a bank of constant-velocity Kalman filters, each with the position at the time in question as a
further state (fixed-point smoothing), weighted by their likelihoods. Nothing else of the body enters: over 0.2 s that
is nearer than what the body tells.
"""

from __future__ import annotations

import math

import numpy as np

from steadypose.prior.compiled import njit
from steadypose.prior.timing.rate import FPS

DENSITIES = np.array([0.05, 0.3, 1.8, 10.0, 60.0])
"""Process densities of the filters, m²/s³."""

BEFORE = 14
"""Frames before the gap that are used, at most."""

MIN_NOISE = 1e-3
"""Standard deviation of the measurements along an axis, at least; metres."""

FIRST_SPEED = 3.0
"""Standard deviation of the velocity along an axis, before it is measured; m/s."""


@njit(cache=True)
def bridge(track, at, noise, place):
    """Write where a joint was, given its observations before and after; returns its deviation along an axis, metres.

    Args:
        track: (T, 3) metres, NaN where it was not observed.
        at: frame in question.
        noise: standard deviation of the observations along an axis, metres.
        place: (3,) metres, written; NaN where the track has no observation before ``at``.
    """
    last = at
    while last >= 0 and math.isnan(track[last, 0]):
        last -= 1
    if last < 0:
        for axis in range(3):
            place[axis] = np.nan
        return np.inf
    count, square = len(DENSITIES), max(noise, MIN_NOISE) ** 2
    places, variances, likelihoods = np.empty((count, 3)), np.empty(count), np.empty(count)
    for k in range(count):
        likelihoods[k], variances[k] = _fixed_point(
            track, max(last - BEFORE + 1, 0), at, DENSITIES[k], square, places[k]
        )
    most, total, variance = likelihoods.max(), 0.0, 0.0
    for k in range(count):
        likelihoods[k] = math.exp(likelihoods[k] - most)
        total += likelihoods[k]
    for axis in range(3):
        place[axis] = 0.0
        for k in range(count):
            place[axis] += likelihoods[k] / total * places[k, axis]
    for k in range(count):
        apart = 0.0
        for axis in range(3):
            apart += (places[k, axis] - place[axis]) ** 2
        variance += likelihoods[k] / total * (variances[k] + apart / 3.0)
    return math.sqrt(variance)


@njit(cache=True)
def _fixed_point(track, first, at, density, square, place):
    """One filter: the log-likelihood of the track from frame ``first`` on, and the variance of ``place`` (3,)."""
    dt, likelihood, begun = 1.0 / FPS, 0.0, False
    mean, gain = np.zeros((3, 3)), np.zeros(3)  # position, velocity, position in question
    p = np.zeros((3, 3))
    for t in range(first, len(track)):
        observed = not math.isnan(track[t, 0])
        if not begun:
            if observed:
                begun = True
                p[0, 0], p[1, 1] = square, FIRST_SPEED**2
                for axis in range(3):
                    mean[0, axis] = track[t, axis]
        else:
            for axis in range(3):
                mean[0, axis] += dt * mean[1, axis]
            p[0, 0] += 2.0 * dt * p[0, 1] + dt * dt * p[1, 1] + density * dt**3 / 3.0
            p[0, 1] += dt * p[1, 1] + density * dt**2 / 2.0
            p[0, 2] += dt * p[1, 2]
            p[1, 1] += density * dt
            p[1, 0], p[2, 0] = p[0, 1], p[0, 2]
            if observed:
                innovation = p[0, 0] + square
                for k in range(3):
                    gain[k] = p[k, 0] / innovation
                for axis in range(3):
                    off = track[t, axis] - mean[0, axis]
                    likelihood -= 0.5 * off * off / innovation
                    for k in range(3):
                        mean[k, axis] += gain[k] * off
                likelihood -= 1.5 * math.log(innovation)
                row = p[0].copy()
                for k in range(3):
                    for m in range(3):
                        p[k, m] -= gain[k] * row[m]
        if t == at:
            for axis in range(3):
                mean[2, axis] = mean[0, axis]
            p[2, 0] = p[0, 2] = p[2, 2] = p[0, 0]
            p[2, 1] = p[1, 2] = p[0, 1]
    for axis in range(3):
        place[axis] = mean[2, axis]
    return likelihood, p[2, 2]
