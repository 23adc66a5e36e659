"""The Kalman filter behind a body's place in the world: root position and velocity, and where its feet stand.

The state holds the sensor's slow error, so that a root seen for long is not taken to be known ever better, and the
places of the standing feet, as contact-aided filters of legged robots do
(Bloesch et al., "State Estimation for Legged Robots", RSS 2012). A foot on the ground stays where it is, so its
place relative to the root measures how far the root has moved: the zero-velocity update and the anchor that keeps
errors from adding up are one measurement, and the covariance knows that an anchor is no better placed than the root
was when the foot came down.

The axes are independent: the noise is the same in both horizontal directions, so no correlation between axes
arises, and the filter turns with the world.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

_POSITION, _VELOCITY, _BIAS, _FEET = 0, 1, 2, 3
_UNPLACED = 1e4
"""m², the variance of a foot's place before its first measurement: far more than any root's."""


@dataclass(frozen=True)
class RootNoise:
    """How the root moves, and how what tells of it errs.

    Attributes:
        acceleration: density of the root's white-noise acceleration, m/s² over √Hz.
        slip: density of the random walk of a standing foot, metres over √s.
        memory_s: seconds for which the sensor's slow error lasts: the time constant of a Gauss-Markov process.
        first_speed: m/s, the standard deviation of a root's first velocity.
    """

    acceleration: float = 3.0
    slip: float = 0.02
    memory_s: float = 0.65
    first_speed: float = 1.0


class RootFilter:
    """Root position and velocity, the sensor's slow error, and the places of ``feet`` points that may stand.

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
        self._p[:, _POSITION, _BIAS] = self._p[:, _BIAS, _POSITION] = -(bias**2)
        self._p[:, _BIAS, _BIAS] = bias**2
        self._p[:, _VELOCITY, _VELOCITY] = noise.first_speed**2
        self._bias = bias
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
        covariance[:, axes, :, axes] = self._p[:, :_BIAS, :_BIAS]
        return covariance.reshape(6, 6)

    @property
    def position_sigma(self) -> Floats:
        """(3,) metres, standard deviation along each axis."""
        return np.sqrt(self._p[:, _POSITION, _POSITION])

    @property
    def standing(self) -> NDArray[np.bool_]:
        """(feet,) which feet stand."""
        return self._standing.copy()

    def predict(self, dt: float, drift: ArrayLike) -> None:
        """Move on by ``dt`` seconds, above 0.

        Args:
            dt: seconds.
            drift: density of a random walk of the position, (3,) or a number, metres over √s: what is left when
                velocity measurements whose errors last are taken for independent ones.
        """
        x, p, noise = self._x, self._p, self._noise
        x[_POSITION] += dt * x[_VELOCITY]
        p[:, _POSITION] += dt * p[:, _VELOCITY]
        p[:, :, _POSITION] += dt * p[:, :, _VELOCITY]
        q = noise.acceleration**2
        p[:, _POSITION, _POSITION] += q * dt**3 / 3 + np.square(drift) * dt
        p[:, _POSITION, _VELOCITY] += q * dt**2 / 2
        p[:, _VELOCITY, _POSITION] += q * dt**2 / 2
        p[:, _VELOCITY, _VELOCITY] += q * dt
        kept = math.exp(-dt / noise.memory_s)
        x[_BIAS] *= kept
        p[:, _BIAS] *= kept
        p[:, :, _BIAS] *= kept
        p[:, _BIAS, _BIAS] += (1.0 - kept**2) * self._bias**2
        feet = np.flatnonzero(self._standing) + _FEET
        p[:, feet, feet] += noise.slip**2 * dt

    def observe_position(self, position: Floats, jitter: float, bias: float) -> None:
        """Take a root position (3,) in metres as the sensor sees it.

        Args:
            position: with both errors of the sensor.
            jitter: metres, the standard deviation of its error from frame to frame.
            bias: metres, that of its slow error from now on.
        """
        self._bias = bias
        row = np.zeros(len(self._x))
        row[_POSITION] = row[_BIAS] = 1.0
        self._correct(row, position, jitter)

    def observe_velocity(self, velocity: Floats, sigma: ArrayLike) -> None:
        """Take a measured root velocity (3,) in m/s with its standard deviation, (3,) or a number."""
        row = np.zeros(len(self._x))
        row[_VELOCITY] = 1.0
        self._correct(row, velocity, sigma)

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
        row = self._foot_row(foot)
        variance = np.einsum("i,aij,j->a", row, self._p, row) + sigma**2
        return float(np.max(np.abs(from_root - row @ self._x) / np.sqrt(variance)))

    def observe_foot_height(self, foot: int, height: float, sigma: float) -> None:
        """Take the height in metres, world, of a standing foot, with its standard deviation."""
        row = np.zeros(len(self._x))
        row[_FEET + foot] = 1.0
        self._correct(row, np.array([0.0, 0.0, height]), np.array([np.inf, np.inf, sigma]))

    def lift(self, foot: int) -> None:
        """Let a foot stand no more."""
        self._standing[foot] = False

    def _foot_row(self, foot: int) -> Floats:
        row = np.zeros(len(self._x))
        row[_FEET + foot], row[_POSITION] = 1.0, -1.0
        return row

    def _correct(self, row: Floats, measured: Floats, sigma: ArrayLike) -> None:
        """The Kalman update with one scalar measurement an axis: measured = row · x + noise."""
        cross = self._p @ row
        gain = cross / (cross @ row + np.square(sigma))[:, None]
        self._x += (gain * (measured - row @ self._x)[:, None]).T
        self._p -= gain[:, :, None] * cross[:, None, :]
