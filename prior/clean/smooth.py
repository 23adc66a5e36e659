"""The smooth stage: what a textbook filter makes of the joints seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.clean.frame import Window
from steadypose.prior.timing.fixed_lag import FixedLagRTS, Follower, Smoothed
from steadypose.prior.timing.rate import FPS


@dataclass(frozen=True)
class SmoothSettings:
    """What the fixed-lag smoother assumes.

    Attributes:
        measurement_sigma: metres along an axis, the fast noise of a joint seen with full confidence.
        acceleration_density: m²/s³, how freely joints accelerate.
    """

    measurement_sigma: float = 0.02
    acceleration_density: float = 0.5


_MEMORY = (0.25, 0.4, 0.5)
"""Of what follows the smoother, by delay in frames: an answer without later frames jumps with the newest measurement.
At a Kinect it takes 29 % of the jitter for 3 % of the position error at once, 7 % for nothing two frames later."""

_LONG = 2.75
"""Frames. With a longer delay, a longer memory costs no lag."""

_SURE = 0.05
"""Metres: a joint whose place is known less well coasts unseen."""


class Smooth:
    """Gives ``window.smoothed``, the fixed-lag smoother's estimate of the frame ``delay_frames`` before the newest."""

    def __init__(self, settings: SmoothSettings, delay_frames: int, slots: int) -> None:
        self._settings = settings
        self.delay_frames = delay_frames
        # The time constant goes with the fourth root of the density: here, with that of the delay.
        density = settings.acceleration_density * min(1.0, _LONG / max(delay_frames, 1))
        self._smoother = FixedLagRTS(delay_frames, density, settings.measurement_sigma)
        self._follower = Follower(_MEMORY[delay_frames]) if delay_frames < len(_MEMORY) else None
        self._last = np.full((slots, 22, 3), np.nan)

    def reset(self, slot: NDArray[np.bool_]) -> None:
        """Forget the bodies in these slots."""
        self._smoother.forget(np.repeat(slot[:, None], 22, axis=1))
        self._last[slot] = np.nan

    def update(self, window: Window) -> Window:
        """Take the newest frame's positions in."""
        sigma = self._settings.measurement_sigma / np.clip(window.confidence.newest, 0.1, 1.0)
        smoothed = self._smoother.update(window.positions.newest, float(window.stamp_s.newest), sigma)
        window.smoothed = None if smoothed is None else self._honest(self._followed(smoothed), window)
        return window

    def flush(self, window: Window) -> list[Smoothed]:
        """The estimates of the last ``delay_frames`` frames (fewer if there were fewer), oldest first."""
        held = [self._honest(self._followed(smoothed), window) for smoothed in self._smoother.flush()]
        self._last[:] = np.nan
        return held

    def _followed(self, smoothed: Smoothed) -> Smoothed:
        """What follows the estimate, if its delay is short; where it is new, or coasts unseen, the estimate."""
        if self._follower is None:
            return smoothed
        known = np.isfinite(self._last[..., 0]) & (smoothed.sigma < _SURE)
        step = self._smoother.velocity / FPS if self.delay_frames == 0 else smoothed.positions - self._last
        step = np.where(np.isfinite(self._last), step, 0.0)
        self._last = smoothed.positions.copy()
        return smoothed._replace(positions=self._follower.update(smoothed.positions, step, known))

    def _honest(self, smoothed: Smoothed, window: Window) -> Smoothed:
        """With the standard deviation that the noise found makes of it.

        To smooth such noise more would not help: within a short delay, the answer then lags instead.
        """
        factor = np.maximum(window.noise / self._settings.measurement_sigma, 1.0)
        return smoothed._replace(sigma=smoothed.sigma * factor[:, None])
