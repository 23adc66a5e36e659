"""Streaming filters from the literature: One-Euro, and a fixed-lag Kalman smoother.

Both take one frame at a time, work on any number of joints at once (arrays of shape (..., 3)), use the real
time between frames, and read a joint with a non-finite coordinate as missing. Nothing here looks at a clock.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from steadypose.prior.compiled import njit

Array = NDArray[np.float64]


class Smoothed(NamedTuple):
    """The estimate of one frame."""

    stamp_s: float
    positions: Array  # (..., 3) metres; NaN for a joint that had not been seen by then
    sigma: Array  # (...) metres, standard deviation of each coordinate; inf where positions are NaN


class OneEuroFilter:
    """Low-pass filter whose cut-off rises with speed (Casiez, Roussel and Vogel, CHI 2012).

    The speed is the norm of the joint's filtered velocity, so the result does not depend on how the axes lie.
    A missing joint holds its last estimate; the next measurement of it is weighted by the time since its last.
    """

    def __init__(self, min_cutoff_hz: float, beta: float, velocity_cutoff_hz: float = 1.0) -> None:
        """`beta` is in Hz per m/s: the cut-off is `min_cutoff_hz + beta * speed`."""
        if min_cutoff_hz <= 0 or velocity_cutoff_hz <= 0 or beta < 0:
            raise ValueError(
                "One-Euro filter: expected cut-offs above 0 Hz and beta of at least 0, "
                f"got {min_cutoff_hz=}, {beta=}, {velocity_cutoff_hz=}"
            )
        self._min_cutoff = min_cutoff_hz
        self._beta = beta
        self._velocity_cutoff = velocity_cutoff_hz
        self.reset()

    def reset(self) -> None:
        self._stamp: float | None = None
        self._seen_at = np.empty(0)
        self._previous = self._estimate = self._velocity = np.empty(0)

    def update(self, positions: ArrayLike, stamp_s: float) -> Array:
        """Take a frame (..., 3) in metres and give its estimate (..., 3); NaN until a joint is first seen."""
        measured = np.asarray(positions, dtype=np.float64)
        seen = _seen(measured)
        if self._stamp is None:
            self._seen_at = np.where(seen, stamp_s, np.nan)
            self._previous = np.where(seen[..., None], measured, np.nan)
            self._estimate = self._previous.copy()
            self._velocity = np.zeros_like(measured)
        else:
            _check_frame(measured, stamp_s, self._estimate.shape, self._stamp)
            known = np.isfinite(self._seen_at)
            step = np.where(known, stamp_s - self._seen_at, 1.0)[..., None]
            velocity = (measured - self._previous) / step
            velocity = self._velocity + _weight(self._velocity_cutoff, step) * (velocity - self._velocity)
            speed = np.linalg.norm(velocity, axis=-1, keepdims=True)
            weight = _weight(self._min_cutoff + self._beta * speed, step)
            estimate = self._estimate + weight * (measured - self._estimate)

            moved, first = (seen & known)[..., None], (seen & ~known)[..., None]
            self._velocity = np.where(moved, velocity, self._velocity)
            self._estimate = np.where(moved, estimate, np.where(first, measured, self._estimate))
            self._previous = np.where(seen[..., None], measured, self._previous)
            self._seen_at = np.where(seen, stamp_s, self._seen_at)
        self._stamp = stamp_s
        return self._estimate.copy()


class FixedLagRTS:
    """Constant-velocity Kalman filter with a Rauch-Tung-Striebel smoother over the last `delay` frames.

    Process: white-noise acceleration (Bar-Shalom, Li and Kirubarajan 2001, equation 6.2.2-12); measurement:
    position with an isotropic error. The three coordinates of a joint then share one 2x2 covariance, and the
    smoother is computed in its augmented-state form (Anderson and Moore 1979, section 7.3): the positions of
    the last frames are updated along with the newest one, by way of their covariance with it. That is the RTS
    result to rounding, without a backward pass: the cost of an update hardly grows with the delay.

    A joint starts at its first measurement, with a velocity of 0 +- `initial_speed` m/s. A missing joint
    coasts, with a standard deviation that says so.
    """

    def __init__(
        self,
        delay: int,
        acceleration_density: ArrayLike,
        measurement_sigma: float = 0.02,
        initial_speed: float = 1.0,
    ) -> None:
        """`delay`: frames of look-ahead. `acceleration_density`: power spectral density of the acceleration in
        m^2/s^3, one for all joints or one each. `measurement_sigma`: metres, where `update` is given none."""
        if delay < 0:
            raise ValueError(f"fixed-lag smoother: expected a delay of 0 frames or more, got {delay}")
        self.delay = delay
        self._density = np.asarray(acceleration_density, dtype=np.float64)
        if (self._density <= 0).any() or measurement_sigma <= 0 or initial_speed <= 0:
            raise ValueError(
                "fixed-lag smoother: expected an acceleration density, measurement sigma and initial speed "
                f"above 0, got {acceleration_density}, {measurement_sigma}, {initial_speed}"
            )
        self._sigma = measurement_sigma
        self._initial_velocity_variance = initial_speed**2
        self.reset()

    def reset(self) -> None:
        self._count = 0

    def _allocate(self, shape: tuple[int, ...]) -> None:
        slots, self._joints = self.delay + 1, shape[:-1]
        count = math.prod(self._joints)
        self._stamps = np.zeros(slots)
        # Of each frame in the ring: its position given all measurements so far, the variance of that, and its
        # covariance with the newest position and velocity. The newest frame's own slot is the filter's state.
        self._position = np.full((slots, count, 3), np.nan)
        self._variance, self._with_position, self._with_velocity = np.zeros((3, slots, count))
        self._velocity, self._velocity_variance = np.zeros((count, 3)), np.zeros(count)
        self._known = np.zeros(count, dtype=bool)
        self._densities = self._flat(self._density)

    def _flat(self, values: ArrayLike) -> Array:
        """(N,) one number for each joint, of values that broadcast to the joints; a copy."""
        flat = np.empty(self._joints)
        flat[...] = values
        return flat.ravel()

    def update(self, positions: ArrayLike, stamp_s: float, sigma: ArrayLike | None = None) -> Smoothed | None:
        """Take a frame; give the estimate of the frame `delay` before it, or None while there is none.

        positions: (..., 3) metres, non-finite where missing. stamp_s: seconds of capture, increasing.
        sigma: standard deviation of a coordinate in metres, one number or (...); inf counts as missing.
        """
        measured = np.array(positions, dtype=np.float64)
        slot, last = self._count % (self.delay + 1), (self._count - 1) % (self.delay + 1)
        if self._count == 0:
            self._allocate(measured.shape)
        else:
            _check_frame(measured, stamp_s, (*self._joints, 3), self._stamps[last])
            _predict(
                slot, last, stamp_s - self._stamps[last], self._densities, self._position, self._variance,
                self._with_position, self._with_velocity, self._velocity, self._velocity_variance,
            )  # fmt: skip
        self._stamps[slot] = stamp_s
        _correct(
            slot, measured.reshape(-1, 3), self._flat(self._sigma if sigma is None else sigma),
            self._initial_velocity_variance, self._position, self._variance, self._with_position, self._with_velocity,
            self._velocity, self._velocity_variance, self._known,
        )  # fmt: skip
        self._count += 1
        return self._at(self._count - 1 - self.delay) if self._count > self.delay else None

    @property
    def velocity(self) -> Array:
        """(..., 3) m/s at the newest frame; 0 for a joint not seen so far."""
        return self._velocity.reshape(*self._joints, 3)

    def predict(self, stamp_s: float) -> Smoothed | None:
        """Where the joints are expected at `stamp_s`, before they are seen; None before the first frame."""
        if self._count == 0:
            return None
        last = (self._count - 1) % (self.delay + 1)
        step = stamp_s - self._stamps[last]
        variance = _ahead(
            step, self._densities, self._with_position[last], self._with_velocity[last], self._velocity_variance
        )
        sigma = np.where(self._known, np.sqrt(variance), np.inf)
        position = self._position[last] + step * self._velocity
        return Smoothed(stamp_s, position.reshape(*self._joints, 3), sigma.reshape(self._joints))

    def forget(self, joints: NDArray[np.bool_]) -> None:
        """Start these joints (...) afresh at their next measurement; estimates still held of them are lost."""
        if self._count:
            flat = joints.ravel()
            self._known &= ~flat
            self._position[:, flat] = np.nan
            self._velocity[flat] = 0.0

    def flush(self) -> list[Smoothed]:
        """Give the estimates still held, oldest first, and start afresh."""
        held = [self._at(frame) for frame in range(max(0, self._count - self.delay), self._count)]
        self.reset()
        return held

    def _at(self, frame: int) -> Smoothed:
        slot = frame % (self.delay + 1)
        positions = self._position[slot].copy()
        # Rounding may leave the variance of a long-settled frame a hair under zero.
        sigma = np.sqrt(np.maximum(self._variance[slot], 0.0))
        sigma[np.isnan(positions[:, 0])] = np.inf
        return Smoothed(float(self._stamps[slot]), positions.reshape(*self._joints, 3), sigma.reshape(self._joints))


# The state of `FixedLagRTS`, as its `_allocate` describes it, of N joints and K frames: compiled, for a stage that
# takes a few frames at a time is all overhead in numpy.


@njit(cache=True)
def _ahead(step, density, variance, covariance, velocity_variance):
    """Variance of a position after ``step`` seconds without a measurement."""
    return variance + step * (2 * covariance + step * (velocity_variance + density * step / 3))


@njit(cache=True)
def _predict(slot, last, step, density, position, variance, with_position, with_velocity, velocity, velocity_variance):
    """Predict the frame ``step`` seconds after the last into ``slot``."""
    for joint in range(len(density)):
        growth, known, covariance = density[joint] * step, velocity_variance[joint], with_velocity[last, joint]
        ahead = _ahead(step, density[joint], with_position[last, joint], covariance, known)
        # The positions of past frames do not move, but their covariance with the newest state does.
        for frame in range(len(position)):
            with_position[frame, joint] += step * with_velocity[frame, joint]
        for axis in range(3):
            position[slot, joint, axis] = position[last, joint, axis] + step * velocity[joint, axis]
        variance[slot, joint] = with_position[slot, joint] = ahead
        with_velocity[slot, joint] = covariance + step * (known + growth / 2)
        velocity_variance[joint] += growth


@njit(cache=True)
def _correct(
    slot, measured, sigma, initial_velocity_variance, position, variance, with_position, with_velocity, velocity,
    velocity_variance, known,
):  # fmt: skip
    """Take in the measurement (N, 3) of the newest frame, which is in ``slot``."""
    for joint in range(len(measured)):
        x, y, z = measured[joint, 0], measured[joint, 1], measured[joint, 2]
        if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z) and math.isfinite(sigma[joint])):
            continue
        noise = sigma[joint] ** 2
        if not known[joint]:
            known[joint] = True
            for frame in range(len(position)):
                with_position[frame, joint] = with_velocity[frame, joint] = 0.0
            for axis in range(3):
                position[slot, joint, axis] = measured[joint, axis]
                velocity[joint, axis] = 0.0
            variance[slot, joint] = with_position[slot, joint] = noise
            velocity_variance[joint] = initial_velocity_variance
            continue
        own, covariance = with_position[slot, joint], with_velocity[slot, joint]
        x, y, z = x - position[slot, joint, 0], y - position[slot, joint, 1], z - position[slot, joint, 2]
        for frame in range(len(position)):
            gain = with_position[frame, joint] / (own + noise)
            position[frame, joint, 0] += gain * x
            position[frame, joint, 1] += gain * y
            position[frame, joint, 2] += gain * z
            variance[frame, joint] -= gain * with_position[frame, joint]
            with_position[frame, joint] -= gain * own
            with_velocity[frame, joint] -= gain * covariance
        gain = covariance / (own + noise)
        velocity[joint, 0] += gain * x
        velocity[joint, 1] += gain * y
        velocity[joint, 2] += gain * z
        velocity_variance[joint] -= gain * covariance


def _seen(measured: Array) -> NDArray[np.bool_]:
    return np.all(np.isfinite(measured), axis=-1)


def _weight(cutoff_hz: ArrayLike, step_s: Array) -> Array:
    """Weight of the new sample in an exponential filter (One-Euro paper, equation 5)."""
    return 1.0 / (1.0 + 1.0 / (2 * np.pi * np.asarray(cutoff_hz) * step_s))


def _check_frame(measured: Array, stamp_s: float, shape: tuple[int, ...], last_stamp_s: float) -> None:
    if measured.shape != shape:
        raise ValueError(f"filter: expected positions of shape {shape} as before, got {measured.shape}")
    if not stamp_s > last_stamp_s:
        raise ValueError(f"filter: expected a stamp after {last_stamp_s} s, got {stamp_s} s")
