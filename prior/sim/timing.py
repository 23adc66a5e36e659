"""Smooth functions of time that motions are made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from steadypose.prior.arrays import Floats


def minimum_jerk(progress: ArrayLike) -> Floats:
    """Flash and Hogan (1985)'s course of a reach: from 0 to 1 over ``progress`` 0..1, at rest at both ends."""
    u = np.clip(np.asarray(progress, dtype=np.float64), 0.0, 1.0)
    return u**3 * (10.0 - 15.0 * u + 6.0 * u**2)


@dataclass(frozen=True)
class Key:
    """Between ``start`` and ``end`` (seconds) a track goes over to ``value``."""

    start: float
    end: float
    value: ArrayLike


def track(times: Floats, initial: ArrayLike, keys: Sequence[Key]) -> Floats:
    """A value that goes from key to key, twice continuously differentiable.

    Each key adds its difference from the one before, on a minimum-jerk course. Keys that overlap in time blend:
    the track then passes near the first without stopping, as a hand does at a via-point.

    Args:
        times: (T,) seconds.
        initial: (...) value before the first key.
        keys: in order.

    Returns:
        (T, ...).
    """
    previous = np.asarray(initial, dtype=np.float64)
    value = np.broadcast_to(previous, (len(times), *previous.shape)).copy()
    for key in keys:
        target = np.asarray(key.value, dtype=np.float64)
        gain = minimum_jerk((times - key.start) / (key.end - key.start))
        value += gain.reshape(-1, *(1,) * target.ndim) * (target - previous)
        previous = target
    return value


def drift(rng: np.random.Generator, times: Floats, std: ArrayLike, slowest_s: float, fastest_s: float) -> Floats:
    """Aimless smooth motion: six sinusoids a channel with random periods and phases.

    Args:
        rng: source of the periods and phases.
        times: (T,) seconds.
        std: (C,) standard deviation of each channel over a long time.
        slowest_s: longest period in seconds.
        fastest_s: shortest period in seconds.

    Returns:
        (T, C).
    """
    std = np.atleast_1d(np.asarray(std, dtype=np.float64))
    waves = 6
    period = np.exp(rng.uniform(np.log(fastest_s), np.log(slowest_s), (waves, len(std))))
    phase = rng.uniform(0.0, 2 * np.pi, (waves, len(std)))
    # Slow sway is wider than fast tremble: amplitude in proportion to the period.
    amplitude = period / np.sqrt((period**2).sum(axis=0) / 2)
    angle = 2 * np.pi * times[:, None, None] / period + phase
    return std * (amplitude * np.sin(angle)).sum(axis=1)
