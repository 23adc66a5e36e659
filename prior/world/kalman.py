"""The Kalman filter of a body's trajectory: position and velocity of the root, and positions of the feet.

The errors of the sensor's observations and of the network's predictions are correlated in time. They are therefore part
of the state. The filter does not become overconfident about a root that is observed for long, and the uncertainty of a
coasting root grows as fast as correlated errors accumulate.

The positions of the feet are part of the state as well, as in contact-aided filters of legged robots (Bloesch et al.,
"State Estimation for Legged Robots", RSS 2012). A resting foot stays in place. Its apparent motion is the sensor's
error, which the filter estimates, and forgets when the foot lifts, so an anchor takes effect and ends gradually. While
the root is hidden, the distance to the same foot measures how far the root has moved. One measurement is thus
zero-velocity update and anchor against accumulating errors, and the covariance includes the uncertainty of the anchor's
position.

Observations are smoothed, so their errors are smooth too. Each error is the second-order Gauss-Markov process of a
critically damped spring: after time t, (1 + wt) exp(-wt) of it is left. The axes are independent. The noise is equal in
both horizontal directions, so the axes stay uncorrelated and the filter is equivariant under rotations about z.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from steadypose.prior.arrays import Floats
from steadypose.prior.compiled import njit

_POSITION, _VELOCITY, _SENSOR, _SENSOR_RATE, _NETWORK, _FEET = 0, 1, 2, 3, 4, 5
"""Indices into the state. Errors are in units of their current standard deviations, their rates in those times w."""
_FOOT, _FOOT_ERROR, _FOOT_RATE, _OF_FOOT = 0, 1, 2, 3
"""Indices into a foot's part of the state: its position, the sensor's error of it, that error's rate; and its size."""


@dataclass(frozen=True)
class BodyNoise:
    """Process noise of root and feet, and correlation times of measurement errors."""

    acceleration: float = 3.0  # m/s² over √Hz, density of the white-noise acceleration of a root at rest
    acceleration_at_speed: float = 1.0  # 1/√s, increase of that density for each m/s of the root's speed
    # metres over √s, densities of the random walk of a foot that rests, that rolls under load, and that is in the air
    rest: float = 0.006
    load: float = 0.2
    swing: float = 4.0
    slip_at_speed: float = 0.5
    """s/m, relative increase of the random walk of feet at rest and under load for each m/s of the root's speed, as
    these feet roll and slide, or are wrongly taken for standing"""
    sensor_rate: float = 12.0  # 1/s, w of the sensor's errors of a point at rest
    sensor_memory_m: float = 0.03
    """metres of travel with which a moving root's error decays in addition, as a camera's error does"""
    network_memory_s: ArrayLike = 0.15
    """(3,) or a number, seconds, time constant of the network's error, a Gauss-Markov process"""
    first_speed: float = 1.0  # m/s, standard deviation of a root's first velocity

    def density(self, speed: float) -> float:
        """Power spectral density of the white-noise acceleration of a root at ``speed`` m/s, in m²/s³."""
        return (self.acceleration + self.acceleration_at_speed * speed) ** 2

    def walk(self, load: Floats, rest: Floats, speed: float) -> Floats:
        """(feet,) m²/s of the feet's random walks, from the probabilities (feet,) of ``load`` and ``rest``."""
        slip = math.log(1.0 + self.slip_at_speed * speed)
        rolls = np.maximum(load - rest, 0.0)
        walk = rest * (math.log(self.rest) + slip) + rolls * (math.log(self.load) + slip)
        walk += (1.0 - rest - rolls) * math.log(self.swing)
        return np.exp(2.0 * walk)


class BodyFilter:
    """Kalman filter of root position and velocity, positions of ``feet`` points of the feet, and biases.

    It starts from the first observed position (3,) of the root, metres, and a velocity (3,) m/s; ``jitter`` and
    ``bias`` are standard deviations of the sensor's white noise and of its bias, metres. ``placed`` (feet,) is
    which feet have a position.
    """

    def __init__(
        self, noise: BodyNoise, position: ArrayLike, jitter: float, bias: float, velocity: ArrayLike, feet: int
    ) -> None:
        self._noise = noise
        size = _FEET + _OF_FOOT * feet
        self._x = np.zeros((size, 3))
        self._x[_POSITION], self._x[_VELOCITY] = position, velocity
        self._p = np.zeros((3, size, size))
        self._p[:, _POSITION, _POSITION] = jitter**2 + bias**2
        self._p[:, _POSITION, _SENSOR] = self._p[:, _SENSOR, _POSITION] = -bias
        self._p[:, _VELOCITY, _VELOCITY] = noise.first_speed**2
        errors = [_SENSOR, _SENSOR_RATE, _NETWORK]
        for k in range(feet):
            errors += [_index(k, _FOOT_ERROR), _index(k, _FOOT_RATE)]
        self._p[:, errors, errors] = 1.0
        self.placed = np.zeros(feet, dtype=bool)
        self._from_root = np.zeros(feet, dtype=bool)

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
    def feet(self) -> Floats:
        """(feet, 3) metres, world."""
        return self._x[_FEET::_OF_FOOT].copy()

    @property
    def feet_sigma(self) -> Floats:
        """(feet, 3) metres, standard deviation along each axis."""
        places = np.arange(_FEET, len(self._x), _OF_FOOT)
        return np.sqrt(self._p[:, places, places].T)

    @property
    def feet_off(self) -> Floats:
        """(feet,) distance from each foot to its observation along the worst axis, in standard deviations."""
        return np.abs(self._x[_FEET + _FOOT_ERROR :: _OF_FOOT]).max(axis=1)

    def predict(self, dt: float, load: Floats, rest: Floats) -> None:
        """Predict over ``dt`` seconds, above 0, given the feet's probabilities (feet,) of ``load`` and ``rest``."""
        noise = self._noise
        speed = math.hypot(*self._x[_VELOCITY, :2])  # horizontal speed only, because the floor affects the vertical one
        rates = np.full(1 + len(load), noise.sensor_rate)
        rates[0] += speed / noise.sensor_memory_m
        kept = np.exp(-dt / np.broadcast_to(np.asarray(noise.network_memory_s, dtype=np.float64), (3,)))
        _predict(self._x, self._p, dt, noise.density(speed), rates * dt, kept, noise.walk(load, rest, speed) * dt)

    def observe_position(self, position: Floats, jitter: float, bias: float) -> None:
        """Update with an observed root position (3,) metres; ``jitter`` and ``bias`` are its errors' deviations."""
        self._correct({_POSITION: 1.0, _SENSOR: bias}, position, jitter)

    def observe_velocity(self, velocity: Floats, jitter: ArrayLike, bias: ArrayLike) -> None:
        """Update with the network's root velocity (3,) m/s and the deviations of its errors, (3,) m/s or a number."""
        self._correct({_VELOCITY: 1.0, _NETWORK: bias}, velocity, jitter)

    def observe_foot(self, foot: int, place: Floats, jitter: float, bias: float, *, from_root: bool) -> None:
        """Update with the observed position (3,) metres of a foot, in the world or relative to the root.

        The position has both errors of the sensor. Errors relative to the root differ from those in the world, so the
        estimated error is forgotten when the frame changes.
        """
        if not self.placed[foot]:
            self._place(foot, place + self._x[_POSITION] if from_root else place, jitter, bias, from_root)
            return
        if self._from_root[foot] != from_root:
            self._forget_error(foot)
            self._from_root[foot] = from_root
        entries = {_index(foot, _FOOT): 1.0, _index(foot, _FOOT_ERROR): bias}
        self._correct({**entries, _POSITION: -1.0} if from_root else entries, place, jitter)

    def observe_foot_height(self, foot: int, height: float, sigma: float) -> None:
        """Update with the height of a foot and its standard deviation, metres, world."""
        self._correct({_index(foot, _FOOT): 1.0}, np.array([0, 0, height]), np.array([np.inf, np.inf, sigma]))

    def lose(self, foot: int) -> None:
        """Forget the position of a foot."""
        self.placed[foot] = False

    def _place(self, foot: int, place: Floats, jitter: float, bias: float, from_root: bool) -> None:
        """Initialise a foot at its first observation."""
        at, error, p = _index(foot, _FOOT), _index(foot, _FOOT_ERROR), self._p
        self._forget_error(foot)
        self._x[at] = place
        p[:, at, :] = p[:, :, at] = 0.0
        if from_root:
            p[:, at, :] = p[:, _POSITION, :]
            p[:, :, at] = p[:, :, _POSITION]
        p[:, at, at] = p[:, _POSITION, _POSITION] * from_root + jitter**2 + bias**2
        p[:, at, error] = p[:, error, at] = -bias
        self.placed[foot], self._from_root[foot] = True, from_root

    def _forget_error(self, foot: int) -> None:
        for part in (_index(foot, _FOOT_ERROR), _index(foot, _FOOT_RATE)):
            self._x[part] = 0.0
            self._p[:, part, :] = self._p[:, :, part] = 0.0
            self._p[:, part, part] = 1.0

    def _correct(self, entries: Mapping[int, ArrayLike], measured: Floats, sigma: ArrayLike) -> None:
        """Kalman update with one scalar measurement per axis: measured = sum of entries · x + noise."""
        rows = np.array(list(entries), dtype=np.int64)
        values, deviation = np.empty((len(rows), 3)), np.empty(3)
        for k, value in enumerate(entries.values()):
            values[k] = value
        deviation[:] = sigma
        _correct(self._x, self._p, rows, values, measured.astype(np.float64), deviation)


def _index(foot: int, part: int) -> int:
    return _FEET + _OF_FOOT * foot + part


# Compiled, because a body needs about ten of these calls per frame and numpy takes 30 µs for each.


@njit(cache=True)
def _spring(x, p, a, at, angle):
    """Predict the error at index ``at``, and its rate at the next, over ``angle`` = w dt along axis ``a``, in place."""
    left = math.exp(-angle)
    f00, f01, f10, f11 = left * (1 + angle), left * angle, -left * angle, left * (1 - angle)
    first, second = x[at, a], x[at + 1, a]
    x[at, a], x[at + 1, a] = f00 * first + f01 * second, f10 * first + f11 * second
    for i in range(len(x)):
        first, second = p[a, at, i], p[a, at + 1, i]
        p[a, at, i], p[a, at + 1, i] = f00 * first + f01 * second, f10 * first + f11 * second
    for i in range(len(x)):
        first, second = p[a, i, at], p[a, i, at + 1]
        p[a, i, at], p[a, i, at + 1] = f00 * first + f01 * second, f10 * first + f11 * second
    p[a, at, at] += 1.0 - f00**2 - f01**2
    p[a, at + 1, at + 1] += 1.0 - f10**2 - f11**2
    p[a, at, at + 1] -= f00 * f10 + f01 * f11
    p[a, at + 1, at] -= f00 * f10 + f01 * f11


@njit("(f8[:,::1], f8[:,:,::1], f8, f8, f8[::1], f8[::1], f8[::1])", cache=True)
def _predict(x, p, dt, density, angles, kept, walk):
    """Predict state (size, 3) and covariances (3, size, size), in place.

    ``angles`` (1 + feet,) are w dt of the errors of root and feet. ``kept`` (3,) is the share of the network's error
    that is left. ``walk`` (feet,) m² is added to the feet's variances.
    """
    for a in range(3):
        x[_POSITION, a] += dt * x[_VELOCITY, a]
        for i in range(len(x)):
            p[a, _POSITION, i] += dt * p[a, _VELOCITY, i]
        for i in range(len(x)):
            p[a, i, _POSITION] += dt * p[a, i, _VELOCITY]
        p[a, _POSITION, _POSITION] += density * dt**3 / 3
        p[a, _POSITION, _VELOCITY] += density * dt**2 / 2
        p[a, _VELOCITY, _POSITION] += density * dt**2 / 2
        p[a, _VELOCITY, _VELOCITY] += density * dt
        _spring(x, p, a, _SENSOR, angles[0])
        x[_NETWORK, a] *= kept[a]
        for i in range(len(x)):
            p[a, _NETWORK, i] *= kept[a]
        for i in range(len(x)):
            p[a, i, _NETWORK] *= kept[a]
        p[a, _NETWORK, _NETWORK] += 1.0 - kept[a] ** 2
        for k in range(len(walk)):
            at = _FEET + _OF_FOOT * k
            p[a, at, at] += walk[k]
            _spring(x, p, a, at + _FOOT_ERROR, angles[1 + k])


@njit("(f8[:,::1], f8[:,:,::1], i8[::1], f8[:,::1], f8[::1], f8[::1])", cache=True)
def _correct(x, p, rows, values, measured, sigma):
    """Correct state and covariances, in place, with one measurement (3,) per axis: measured = values · x[rows]."""
    size = len(x)
    cross = np.empty(size)
    for a in range(3):
        innovation, variance = measured[a], sigma[a] ** 2
        for i in range(size):
            cross[i] = 0.0
            for k in range(len(rows)):
                cross[i] += p[a, i, rows[k]] * values[k, a]
        for k in range(len(rows)):
            innovation -= values[k, a] * x[rows[k], a]
            variance += values[k, a] * cross[rows[k]]
        for i in range(size):
            x[i, a] += cross[i] / variance * innovation
            for j in range(size):
                p[a, i, j] -= cross[i] / variance * cross[j]
