"""The Kalman filter behind a body's place in the world: root position and velocity, and where its feet stand.

Neither what the sensor nor what the network says errs independently from frame to frame, so both slow errors are in
the state: a root seen for long is not taken to be known ever better, and one that coasts strays as errors that last
make it. So are the places of the standing feet, as in contact-aided filters of legged robots (Bloesch et al., "State
Estimation for Legged Robots", RSS 2012). A foot on the ground stays where it is, so its place relative to the root
measures how far the root has moved: the zero-velocity update and the anchor that keeps errors from adding up are one
measurement, and the covariance knows that an anchor is no better placed than the root was when the foot came down.

The axes are independent: the noise is the same in both horizontal directions, so no correlation between axes
arises, and the filter turns with the world.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

_POSITION, _VELOCITY, _SENSOR, _NETWORK, _FEET = 0, 1, 2, 3, 4
"""Of the state. The slow errors of sensor and network are in units of their present standard deviations."""
_UNPLACED = 1e4
"""m², the variance of a foot's place before its first measurement: far more than any root's."""


@dataclass(frozen=True)
class RootNoise:
    """How the root moves, and for how long what tells of it errs.

    Attributes:
        acceleration: density of the root's white-noise acceleration, m/s² over √Hz.
        slip: density of the random walk of a standing foot, metres over √s: less of it the foot than its image.
        sensor_memory_s: the time constant of the sensor's slow error, a Gauss-Markov process, of a root at rest.
        sensor_memory_m: metres of travel after which a moving root's is forgotten as well, as a camera's error is.
        network_memory_s: (3,) or a number, that of the network's.
        first_speed: m/s, the standard deviation of a root's first velocity.
    """

    acceleration: float = 3.0
    slip: float = 0.1
    sensor_memory_s: float = 0.65
    sensor_memory_m: float = 0.03
    network_memory_s: ArrayLike = 0.15
    first_speed: float = 1.0


class RootFilter:
    """Root position and velocity, slow errors, and the places of ``feet`` points that may stand.

    Args:
        noise: of all but the measurements.
        position: (3,) metres, where the root is first seen.
        jitter: metres, the standard deviation of the sensor's error from frame to frame.
        bias: metres, the standard deviation of its slow error.
        velocity: (3,) m/s, what the root is taken to do there.
        feet: how many points of the feet may stand.
    """

    def __init__(
        self, noise: RootNoise, position: ArrayLike, jitter: float, bias: float, velocity: ArrayLike, feet: int
    ) -> None:
        self._noise = noise
        size = _FEET + feet
        self._x = np.zeros((size, 3))
        self._x[_POSITION], self._x[_VELOCITY] = position, velocity
        self._p = np.zeros((3, size, size))
        self._p[:, _POSITION, _POSITION] = jitter**2 + bias**2
        self._p[:, _POSITION, _SENSOR] = self._p[:, _SENSOR, _POSITION] = -bias
        self._p[:, _SENSOR, _SENSOR] = self._p[:, _NETWORK, _NETWORK] = 1.0
        self._p[:, _VELOCITY, _VELOCITY] = noise.first_speed**2
        self._standing = np.zeros(feet, dtype=bool)

    @property
    def position(self) -> Floats:
        """(3,) metres, world."""
        return self._x[_POSITION].copy()

    @property
    def velocity(self) -> Floats:
        """(3,) m/s, world."""
        return self._x[_VELOCITY].copy()

    @property
    def covariance(self) -> Floats:
        """(6, 6) of [position, velocity]: m², m²/s, m²/s²."""
        covariance = np.zeros((2, 3, 2, 3))
        axes = np.arange(3)
        covariance[:, axes, :, axes] = self._p[:, :_SENSOR, :_SENSOR]
        return covariance.reshape(6, 6)

    @property
    def position_sigma(self) -> Floats:
        """(3,) metres, standard deviation along each axis."""
        return np.sqrt(self._p[:, _POSITION, _POSITION])

    @property
    def standing(self) -> NDArray[np.bool_]:
        """(feet,) which feet stand."""
        return self._standing.copy()

    def predict(self, dt: float) -> None:
        """Move on by ``dt`` seconds, above 0."""
        noise = self._noise
        speed = math.hypot(*self._x[_VELOCITY, :2])  # not the height, which the floor has a say in
        kept = np.empty((2, 3))
        kept[0] = math.exp(-dt * (1.0 / noise.sensor_memory_s + speed / noise.sensor_memory_m))
        kept[1] = np.exp(-dt / np.asarray(noise.network_memory_s))
        _predict(self._x, self._p, dt, noise.acceleration**2, kept, noise.slip**2 * dt * self._standing)

    def observe_position(self, position: Floats, jitter: float, bias: float) -> None:
        """Take a root position (3,) in metres as the sensor sees it.

        Args:
            position: with both errors of the sensor.
            jitter: metres, the standard deviation of its error from frame to frame.
            bias: metres, that of its slow error.
        """
        self._correct(self._row({_POSITION: 1.0, _SENSOR: bias}), position, jitter)

    def observe_velocity(self, velocity: Floats, jitter: ArrayLike, bias: ArrayLike) -> None:
        """Take a root velocity (3,) in m/s as the network says it.

        Args:
            velocity: with both errors of the network.
            jitter: (3,) or a number, m/s, the standard deviation of its error from frame to frame.
            bias: (3,) or a number, m/s, that of its slow error.
        """
        self._correct(self._row({_VELOCITY: 1.0, _NETWORK: bias}), velocity, jitter)

    def plant(self, foot: int, from_root: Floats, sigma: float) -> None:
        """Let a foot stand from now on, (3,) metres ``from_root`` with the standard deviation of that."""
        k = _FEET + foot
        self._x[k] = self._x[_POSITION] + from_root
        self._p[:, k, :] = 0.0
        self._p[:, :, k] = 0.0
        self._p[:, k, k] = _UNPLACED
        self._standing[foot] = True
        self.observe_foot(foot, from_root, sigma)

    def observe_foot(self, foot: int, from_root: Floats, sigma: float) -> None:
        """Take the place (3,) metres of a standing foot ``from_root``, with its standard deviation in metres."""
        self._correct(self._foot_row(foot), from_root, sigma)

    def foot_surprise(self, foot: int, from_root: Floats, sigma: float) -> float:
        """How many standard deviations a standing foot is from where it should be, along the worst axis."""
        return _surprise(self._x, self._p, self._foot_row(foot), from_root, sigma)

    def observe_foot_height(self, foot: int, height: float, sigma: float) -> None:
        """Take the height in metres, world, of a standing foot, with its standard deviation."""
        self._correct(self._row({_FEET + foot: 1.0}), np.array([0.0, 0.0, height]), np.array([np.inf, np.inf, sigma]))

    def lift(self, foot: int) -> None:
        """Let a foot stand no more."""
        self._standing[foot] = False

    def _foot_row(self, foot: int) -> Floats:
        return self._row({_FEET + foot: 1.0, _POSITION: -1.0})

    def _row(self, entries: Mapping[int, ArrayLike]) -> Floats:
        """(3, size) how a measurement depends on the state, along each axis."""
        row = np.zeros((3, len(self._x)))
        for place, value in entries.items():
            row[:, place] = value
        return row

    def _correct(self, row: Floats, measured: Floats, sigma: ArrayLike) -> None:
        """The Kalman update with one scalar measurement an axis: measured = row · x + noise."""
        deviation = np.empty(3)
        deviation[:] = sigma
        _correct(self._x, self._p, row, measured, deviation)


# Compiled: a body needs some ten of these a frame, and numpy takes 30 µs for each.


@njit("(f8[:,::1], f8[:,:,::1], f8, f8, f8[:,::1], f8[::1])", cache=True)
def _predict(x, p, dt, density, kept, slip):
    """Move state (size, 3) and covariances (3, size, size) on in place; ``kept`` (2, 3) is left of the slow errors."""
    for a in range(3):
        x[_POSITION, a] += dt * x[_VELOCITY, a]
        for k in range(len(x)):
            p[a, _POSITION, k] += dt * p[a, _VELOCITY, k]
        for k in range(len(x)):
            p[a, k, _POSITION] += dt * p[a, k, _VELOCITY]
        p[a, _POSITION, _POSITION] += density * dt**3 / 3
        p[a, _POSITION, _VELOCITY] += density * dt**2 / 2
        p[a, _VELOCITY, _POSITION] += density * dt**2 / 2
        p[a, _VELOCITY, _VELOCITY] += density * dt
        for which, error in enumerate((_SENSOR, _NETWORK)):
            left = kept[which, a]
            x[error, a] *= left
            for k in range(len(x)):
                p[a, error, k] *= left
            for k in range(len(x)):
                p[a, k, error] *= left
            p[a, error, error] += 1.0 - left**2
        for k in range(len(slip)):
            p[a, _FEET + k, _FEET + k] += slip[k]


@njit("(f8[:,::1], f8[:,:,::1], f8[:,::1], f8[::1], f8[::1])", cache=True)
def _correct(x, p, row, measured, sigma):
    """Correct state and covariances in place by one measurement (3,) along each axis: measured = row · x + noise."""
    size = len(x)
    for a in range(3):
        cross = np.zeros(size)
        innovation, variance = measured[a], sigma[a] ** 2
        for i in range(size):
            for j in range(size):
                cross[i] += p[a, i, j] * row[a, j]
            innovation -= row[a, i] * x[i, a]
            variance += row[a, i] * cross[i]
        for i in range(size):
            x[i, a] += cross[i] / variance * innovation
            for j in range(size):
                p[a, i, j] -= cross[i] / variance * cross[j]


@njit("f8(f8[:,::1], f8[:,:,::1], f8[:,::1], f8[::1], f8)", cache=True)
def _surprise(x, p, row, measured, sigma):
    """Standard deviations between a measurement (3,) and what the state has it at, along the worst axis."""
    worst = 0.0
    for a in range(3):
        innovation, variance = measured[a], sigma**2
        for i in range(len(x)):
            innovation -= row[a, i] * x[i, a]
            for j in range(len(x)):
                variance += row[a, i] * p[a, i, j] * row[a, j]
        worst = max(worst, abs(innovation) / np.sqrt(variance))
    return worst
