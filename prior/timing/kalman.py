"""A Kalman filter of joints, frame by frame, with the actual time between frames."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.compiled import njit

INITIAL_SPEED = 1.0  # standard deviation of a joint's first velocity along an axis, m/s


class Smoothed(NamedTuple):
    """The estimate of one frame."""

    stamp_s: float  # seconds
    positions: Floats  # (..., 3) metres; NaN for a joint that has not been observed yet
    sigma: Floats  # (...) metres, standard deviation along an axis; inf where positions are NaN
    step: Floats | None = None
    """(..., 3) metres, motion to the next frame, estimated from the same observations; None without a later frame"""


class ConstantVelocityFilter:
    """Constant-velocity Kalman filter of any number of joints.

    The process is white-noise acceleration (Bar-Shalom, Li and Kirubarajan 2001, equation 6.2.2-12). The measurement is
    a position with an isotropic error. The three coordinates of a joint therefore share one 2x2 covariance. A joint
    starts at its first measurement, with a velocity of 0 ± `INITIAL_SPEED`. A missing joint is extrapolated, and its
    standard deviation increases.

    Args:
        acceleration_density: m²/s³, power spectral density of the acceleration.
        measurement_sigma: metres along an axis, standard deviation of a measurement.
    """

    def __init__(self, acceleration_density: float, measurement_sigma: float = 0.02) -> None:
        self._density, self._sigma = acceleration_density, measurement_sigma
        self.reset()

    def reset(self) -> None:
        """Start anew at the next frame, with any stamp."""
        self._stamp_s: float | None = None

    def update(self, positions: ArrayLike, stamp_s: float) -> Smoothed:
        """Process a frame (..., 3) metres, non-finite where missing, of an increasing stamp in seconds; returns its
        estimate."""
        measured = np.array(positions, dtype=np.float64)
        if self._stamp_s is None:
            self._joints = measured.shape[:-1]
            count = math.prod(self._joints)
            self._position, self._velocity = np.full((count, 3), np.nan), np.zeros((count, 3))
            self._covariance = np.zeros((3, count))  # variance of position, covariance of both, variance of velocity
            self._known = np.zeros(count, dtype=bool)
        else:
            if not stamp_s > self._stamp_s:
                raise ValueError(f"filter: expected a stamp after {self._stamp_s} s, got {stamp_s} s")
            _predict(stamp_s - self._stamp_s, self._density, self._position, self._velocity, self._covariance)
        self._stamp_s = stamp_s
        _correct(measured.reshape(-1, 3), self._sigma, self._position, self._velocity, self._covariance, self._known)
        return self._estimate(stamp_s, self._position.copy(), self._covariance[0])

    @property
    def velocity(self) -> Floats:
        """(..., 3) m/s at the newest frame; 0 for a joint that has not been observed yet."""
        return self._velocity.reshape(*self._joints, 3)

    def predict(self, stamp_s: float) -> Smoothed | None:
        """Predict the joints at ``stamp_s``, before they are observed; None before the first frame."""
        if self._stamp_s is None:
            return None
        step = stamp_s - self._stamp_s
        variance = _ahead(step, self._density, *self._covariance)
        return self._estimate(stamp_s, self._position + step * self._velocity, variance)

    def forget(self, joints: Bools) -> None:
        """Start these joints (...) anew at their next measurement."""
        if self._stamp_s is not None:
            flat = joints.ravel()
            self._known &= ~flat
            self._position[flat] = np.nan
            self._velocity[flat] = 0.0

    def _estimate(self, stamp_s: float, positions: Floats, variance: Floats) -> Smoothed:
        # rounding can make the variance of a settled joint slightly negative
        sigma = np.where(self._known, np.sqrt(np.maximum(variance, 0.0)), np.inf)
        return Smoothed(stamp_s, positions.reshape(*self._joints, 3), sigma.reshape(self._joints))


@njit(cache=True)
def _ahead(step, density, variance, covariance, velocity_variance):
    """Variance of a position after ``step`` seconds without a measurement."""
    return variance + step * (2 * covariance + step * (velocity_variance + density * step / 3))


@njit(cache=True)
def _predict(step, density, position, velocity, covariance):
    """Predict joints (N, 3) ``step`` seconds ahead."""
    growth = density * step
    for joint in range(len(position)):
        own, both, known = covariance[0, joint], covariance[1, joint], covariance[2, joint]
        for axis in range(3):
            position[joint, axis] += step * velocity[joint, axis]
        covariance[0, joint] = _ahead(step, density, own, both, known)
        covariance[1, joint] = both + step * (known + growth / 2)
        covariance[2, joint] = known + growth


@njit(cache=True)
def _correct(measured, sigma, position, velocity, covariance, known):
    """Update with the measurement (N, 3) of the newest frame."""
    noise = sigma**2
    for joint in range(len(measured)):
        if not math.isfinite(measured[joint, 0] + measured[joint, 1] + measured[joint, 2]):
            continue
        if not known[joint]:
            known[joint] = True
            for axis in range(3):
                position[joint, axis] = measured[joint, axis]
                velocity[joint, axis] = 0.0
            covariance[0, joint], covariance[1, joint], covariance[2, joint] = noise, 0.0, INITIAL_SPEED**2
            continue
        own, both = covariance[0, joint], covariance[1, joint]
        gain, velocity_gain = own / (own + noise), both / (own + noise)
        for axis in range(3):
            off = measured[joint, axis] - position[joint, axis]
            position[joint, axis] += gain * off
            velocity[joint, axis] += velocity_gain * off
        covariance[0, joint] -= gain * own
        covariance[1, joint] -= gain * both
        covariance[2, joint] -= velocity_gain * both
