"""The Kalman filter behind a body's place in the world: root position and velocity, and where its feet stand.

The state holds the places of the standing feet beside the root's, as contact-aided filters of legged robots do
(Bloesch et al., "State Estimation for Legged Robots", RSS 2012). A foot on the ground stays where it is, so its
place relative to the root measures how far the root has moved: the zero-velocity update and the anchor that keeps
errors from adding up are one measurement, and the covariance knows that an anchor is no better placed than the root
was when the foot came down.

The axes are independent: the noise is the same in both horizontal directions, so no correlation between axes
arises, and the filter turns with the world.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

_POSITION, _VELOCITY, _FEET = 0, 1, 2
_UNPLACED = 1e4
"""m², the variance of a foot's place before its first measurement: far more than any root's."""


class RootFilter:
    """Root position and velocity, with white-noise acceleration, and the places of ``feet`` feet.

    Args:
        position: (3,) metres, where the root is first seen.
        sigma: (3,) or a number, metres, the standard deviation of that.
        velocity: (3,) m/s, what it is taken to do there.
        speed: m/s, the standard deviation of that.
        feet: how many points of the feet may stand.
    """

    def __init__(self, position: ArrayLike, sigma: ArrayLike, velocity: ArrayLike, speed: float, feet: int) -> None:
        size = _FEET + feet
        self._x = np.zeros((size, 3))
        self._x[_POSITION], self._x[_VELOCITY] = position, velocity
        self._p = np.zeros((3, size, size))
        self._p[:, _POSITION, _POSITION] = np.square(sigma)
        self._p[:, _VELOCITY, _VELOCITY] = speed**2
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
        covariance[:, axes, :, axes] = self._p[:, :_FEET, :_FEET]
        return covariance.reshape(6, 6)

    @property
    def position_sigma(self) -> Floats:
        """(3,) metres, standard deviation along each axis."""
        return np.sqrt(self._p[:, _POSITION, _POSITION])

    @property
    def standing(self) -> NDArray[np.bool_]:
        """(feet,) which feet stand."""
        return self._standing.copy()

    def predict(self, dt: float, acceleration: float, drift: ArrayLike, slip: float) -> None:
        """Move on by ``dt`` seconds.

        Args:
            dt: seconds, above 0.
            acceleration: density of the white-noise acceleration, m/s² over √Hz.
            drift: density of a random walk of the position, (3,) or a number, m over √s: what is left when velocity
                measurements whose errors last are taken for independent ones.
            slip: density of the random walk of a standing foot, m over √s.
        """
        x, p = self._x, self._p
        x[_POSITION] += dt * x[_VELOCITY]
        p[:, _POSITION] += dt * p[:, _VELOCITY]
        p[:, :, _POSITION] += dt * p[:, :, _VELOCITY]
        q = acceleration**2
        p[:, _POSITION, _POSITION] += q * dt**3 / 3 + np.square(drift) * dt
        p[:, _POSITION, _VELOCITY] += q * dt**2 / 2
        p[:, _VELOCITY, _POSITION] += q * dt**2 / 2
        p[:, _VELOCITY, _VELOCITY] += q * dt
        feet = np.flatnonzero(self._standing) + _FEET
        p[:, feet, feet] += slip**2 * dt

    def observe_position(self, position: Floats, sigma: ArrayLike) -> None:
        """Take a measured root position (3,) in metres with its standard deviation, (3,) or a number.

        Infinite where an axis is not measured.
        """
        row = np.zeros(len(self._x))
        row[_POSITION] = 1.0
        self._correct(row, position, sigma)

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
