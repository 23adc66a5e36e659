"""The Kalman filter behind a body's place in the world: root position and velocity, and where its feet are.

Neither the sensor's observations nor the network's predictions err independently from frame to frame, so all biases are
in the state: a root seen for long is not taken to be known ever better, and one that coasts strays as errors that last
make it. So are the places of the feet, as in contact-aided filters of legged robots (Bloesch et al., "State Estimation
for Legged Robots", RSS 2012). A foot that rests stays where it is; what it seems to move is the sensor's error, which
the filter so learns, and forgets when the foot lifts: a planted foot is an anchor that is eased in and out. Against a
hidden root the same foot measures how far the root has moved: the zero-velocity update and the anchor that keeps
errors from adding up are one measurement, and the covariance knows that an anchor is no better placed than it was
seen.

Observations have been smoothed, so their errors are smooth as well: each is the second-order Gauss-Markov process of a
critically damped spring, (1 + wt) exp(-wt) of it left after t. The axes are independent: the noise is the same in both
horizontal directions, so no correlation between axes arises, and the filter turns with the world.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from steadypose.prior.arrays import Floats
from steadypose.prior.compiled import njit

_POSITION, _VELOCITY, _SENSOR, _SENSOR_RATE, _NETWORK, _FEET = 0, 1, 2, 3, 4, 5
"""Of the state. Errors are in units of their present standard deviations, their rates in those times their w."""
_FOOT, _FOOT_ERROR, _FOOT_RATE, _OF_FOOT = 0, 1, 2, 3
"""Of a foot's part of the state: its place, the sensor's error of it, the rate of that."""


@dataclass(frozen=True)
class BodyNoise:
    """How root and feet move, and for how long measurements of them err.

    Attributes:
        acceleration: density of the white-noise acceleration of a root at rest, m/s² over √Hz.
        acceleration_at_speed: what each m/s of its speed adds to that, 1/√s.
        rest, load, swing: densities of the random walk of a foot that rests, of one that rolls under load, and of one
            in the air, metres over √s.
        slip_at_speed: s/m, by how much more each m/s of the root's speed lets feet at rest and under load walk: they
            roll, slide, and are taken to stand when they do not.
        sensor_rate: 1/s, w of the sensor's errors of what is at rest.
        sensor_memory_m: metres of travel by which a moving root's is forgotten as well, as a camera's error is.
        network_memory_s: (3,) or a number, the time constant of the network's error, a Gauss-Markov process.
        first_speed: m/s, the standard deviation of a root's first velocity.
    """

    acceleration: float = 3.0
    acceleration_at_speed: float = 1.0
    rest: float = 0.006
    load: float = 0.2
    swing: float = 4.0
    slip_at_speed: float = 0.5
    sensor_rate: float = 12.0
    sensor_memory_m: float = 0.03
    network_memory_s: ArrayLike = 0.15
    first_speed: float = 1.0

    def density(self, speed: float) -> float:
        """Power spectral density of the white-noise acceleration of a root at ``speed`` m/s: m²/s³."""
        return (self.acceleration + self.acceleration_at_speed * speed) ** 2

    def walk(self, load: Floats, rest: Floats, speed: float) -> Floats:
        """(feet,) m²/s of the feet's random walks, by the probabilities (feet,) that each bears load, and rests."""
        slip = math.log(1.0 + self.slip_at_speed * speed)
        rolls = np.maximum(load - rest, 0.0)
        walk = rest * (math.log(self.rest) + slip) + rolls * (math.log(self.load) + slip)
        walk += (1.0 - rest - rolls) * math.log(self.swing)
        return np.exp(2.0 * walk)


class BodyFilter:
    """Root position and velocity, the places of ``feet`` points of the feet, and biases.

    Args:
        noise: of all but the measurements.
        position: (3,) metres, where the root is first seen.
        jitter: metres, the standard deviation of the sensor's error from frame to frame.
        bias: metres, the standard deviation of its slow bias.
        velocity: (3,) m/s, what the root is taken to do there.
        feet: how many points of the feet there are.
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
        self._placed = np.zeros(feet, dtype=bool)
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
    def placed(self) -> NDArray[np.bool_]:
        """(feet,) which feet have a place."""
        return self._placed.copy()

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
        """(feet,) by how many standard deviations the sensor has each foot elsewhere, along the worst axis."""
        return np.abs(self._x[_FEET + _FOOT_ERROR :: _OF_FOOT]).max(axis=1)

    def predict(self, dt: float, load: Floats, rest: Floats) -> None:
        """Move on by ``dt`` seconds, above 0; (feet,) probabilities that each foot bears load, and that it rests."""
        noise = self._noise
        speed = math.hypot(*self._x[_VELOCITY, :2])  # not the height, which the floor has a say in
        rates = np.full(1 + len(load), noise.sensor_rate)
        rates[0] += speed / noise.sensor_memory_m
        kept = np.exp(-dt / np.broadcast_to(np.asarray(noise.network_memory_s, dtype=np.float64), (3,)))
        _predict(self._x, self._p, dt, noise.density(speed), rates * dt, kept, noise.walk(load, rest, speed) * dt)

    def observe_position(self, position: Floats, jitter: float, bias: float) -> None:
        """Take a root position (3,) in metres as the sensor sees it.

        Args:
            position: with both errors of the sensor.
            jitter: metres, the standard deviation of its error from frame to frame.
            bias: metres, that of its slow bias.
        """
        self._correct({_POSITION: 1.0, _SENSOR: bias}, position, jitter)

    def observe_velocity(self, velocity: Floats, jitter: ArrayLike, bias: ArrayLike) -> None:
        """Take a root velocity (3,) in m/s as the network predicts it.

        Args:
            velocity: with both errors of the network.
            jitter: (3,) or a number, m/s, the standard deviation of its error from frame to frame.
            bias: (3,) or a number, m/s, that of its slow bias.
        """
        self._correct({_VELOCITY: 1.0, _NETWORK: bias}, velocity, jitter)

    def observe_foot(self, foot: int, place: Floats, jitter: float, bias: float, *, from_root: bool) -> None:
        """Take the place (3,) metres of a foot, in the world or from the root, with both errors of the sensor.

        Against the root these are other errors than in the world: what was learned of the ones does not hold for the
        others.
        """
        if not self._placed[foot]:
            self._place(foot, place + self._x[_POSITION] if from_root else place, jitter, bias, from_root)
            return
        if self._from_root[foot] != from_root:
            self._forget_error(foot)
            self._from_root[foot] = from_root
        entries = {_index(foot, _FOOT): 1.0, _index(foot, _FOOT_ERROR): bias}
        self._correct({**entries, _POSITION: -1.0} if from_root else entries, place, jitter)

    def observe_foot_height(self, foot: int, height: float, sigma: float) -> None:
        """Take the height in metres, world, of a foot, with its standard deviation."""
        self._correct({_index(foot, _FOOT): 1.0}, np.array([0, 0, height]), np.array([np.inf, np.inf, sigma]))

    def lose(self, foot: int) -> None:
        """Forget where a foot is."""
        self._placed[foot] = False

    def _place(self, foot: int, place: Floats, jitter: float, bias: float, from_root: bool) -> None:
        """Put a foot where it is first seen."""
        at, error, p = _index(foot, _FOOT), _index(foot, _FOOT_ERROR), self._p
        self._forget_error(foot)
        self._x[at] = place
        p[:, at, :] = p[:, :, at] = 0.0
        if from_root:
            p[:, at, :] = p[:, _POSITION, :]
            p[:, :, at] = p[:, :, _POSITION]
        p[:, at, at] = p[:, _POSITION, _POSITION] * from_root + jitter**2 + bias**2
        p[:, at, error] = p[:, error, at] = -bias
        self._placed[foot], self._from_root[foot] = True, from_root

    def _forget_error(self, foot: int) -> None:
        for part in (_index(foot, _FOOT_ERROR), _index(foot, _FOOT_RATE)):
            self._x[part] = 0.0
            self._p[:, part, :] = self._p[:, :, part] = 0.0
            self._p[:, part, part] = 1.0

    def _correct(self, entries: Mapping[int, ArrayLike], measured: Floats, sigma: ArrayLike) -> None:
        """The Kalman update with one scalar measurement an axis: measured = sum of entries · x + noise."""
        rows = np.array(list(entries), dtype=np.int64)
        values, deviation = np.empty((len(rows), 3)), np.empty(3)
        for k, value in enumerate(entries.values()):
            values[k] = value
        deviation[:] = sigma
        _correct(self._x, self._p, rows, values, measured.astype(np.float64), deviation)


def _index(foot: int, part: int) -> int:
    return _FEET + _OF_FOOT * foot + part


# Compiled: a body needs some ten of these a frame, and numpy takes 30 µs for each.


@njit(cache=True)
def _spring(x, p, a, at, angle):
    """Move one error, at ``at`` and its rate after it, on by ``angle`` = w dt, along axis ``a``, in place."""
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
    """Move state (size, 3) and covariances (3, size, size) on in place.

    ``angles`` (1 + feet,) are w dt of the errors of root and feet, ``kept`` (3,) is left of the network's, ``walk``
    (feet,) m² is added to the feet's variances.
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
    """Correct state and covariances in place by one measurement (3,) along each axis: measured = values · x[rows]."""
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
