"""The smooth stage: what a textbook filter makes of the joints seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prior.filters import FixedLagRTS, Smoothed
from prior.window import Window


@dataclass(frozen=True)
class SmoothSettings:
    """What the fixed-lag smoother assumes.

    Attributes:
        measurement_sigma: metres along an axis, the fast noise of a joint seen with full confidence.
        acceleration_density: m²/s³, how freely joints accelerate.
    """

    measurement_sigma: float = 0.02
    acceleration_density: float = 0.5


class Smooth:
    """Gives ``window.smoothed``, the fixed-lag smoother's estimate of the frame ``delay_frames`` before the newest."""

    def __init__(self, settings: SmoothSettings, delay_frames: int, slots: int) -> None:
        self._settings = settings
        self.delay_frames = delay_frames
        self._smoother = FixedLagRTS(delay_frames, settings.acceleration_density, settings.measurement_sigma)

    def reset(self, slot: NDArray[np.bool_]) -> None:
        """Forget the bodies in these slots."""
        self._smoother.forget(np.repeat(slot[:, None], 22, axis=1))

    def update(self, window: Window) -> Window:
        """Take the newest frame's positions in."""
        sigma = self._settings.measurement_sigma / np.clip(window.confidence.newest, 0.1, 1.0)
        smoothed = self._smoother.update(window.positions.newest, float(window.stamp_s.newest), sigma)
        window.smoothed = None if smoothed is None else self._honest(smoothed, window)
        return window

    def flush(self, window: Window) -> list[Smoothed]:
        """The estimates of the last ``delay_frames`` frames (fewer if there were fewer), oldest first."""
        return [self._honest(smoothed, window) for smoothed in self._smoother.flush()]

    def _honest(self, smoothed: Smoothed, window: Window) -> Smoothed:
        """With the standard deviation that the noise found makes of it.

        To smooth such noise more would not help: within a short delay, the answer then lags instead.
        """
        factor = np.maximum(window.noise / self._settings.measurement_sigma, 1.0)
        return smoothed._replace(sigma=smoothed.sigma * factor[:, None])
