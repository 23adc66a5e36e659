"""The smooth stage: what a textbook filter makes of the joints seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from steadypose.prior.clean.frame import Bools, Floats, Gated
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

_COASTING_SIGMA = 0.05
"""Metres: a joint whose place is known less well coasts unseen."""


class Smooth:
    """A fixed-lag smoother: the estimate of the frame ``delay_frames`` before the newest, joint by joint.

    Whatever takes its place takes the same: a `Gated` frame at a time, and gives positions and standard deviations.
    """

    def __init__(self, settings: SmoothSettings, delay_frames: int, slots: int) -> None:
        self._jitter_sigma = settings.measurement_sigma
        self._delay_frames = delay_frames
        # The time constant goes with the fourth root of the density: here, with that of the delay.
        density = settings.acceleration_density * min(1.0, _LONG / max(delay_frames, 1))
        self._smoother = FixedLagRTS(delay_frames, density, settings.measurement_sigma)
        self._follower = Follower(_MEMORY[delay_frames]) if delay_frames < len(_MEMORY) else None
        self._last = np.full((slots, 22, 3), np.nan)

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        self._smoother.forget(np.repeat(slot[:, None], 22, axis=1))
        self._last[slot] = np.nan

    def update(self, gated: Gated) -> Smoothed | None:
        """Take the newest frame in; None while there is no frame so long ago."""
        sigma = self._jitter_sigma / np.clip(gated.observation.confidence, 0.1, 1.0)
        smoothed = self._smoother.update(gated.positions, gated.observation.stamp_s, sigma)
        return None if smoothed is None else self._rescaled(self._followed(smoothed), gated.jitter)

    def flush(self, jitter: Floats) -> list[Smoothed]:
        """The estimates of the last ``delay_frames`` frames (fewer if there were fewer), oldest first.

        Args:
            jitter: (S,) metres, as the gate last found it.
        """
        held = [self._rescaled(self._followed(smoothed), jitter) for smoothed in self._smoother.flush()]
        self._last[:] = np.nan
        return held

    def _followed(self, smoothed: Smoothed) -> Smoothed:
        """What follows the estimate, if its delay is short; where it is new, or coasts unseen, the estimate."""
        if self._follower is None:
            return smoothed
        known = np.isfinite(self._last[..., 0]) & (smoothed.sigma < _COASTING_SIGMA)
        step = self._smoother.velocity / FPS if self._delay_frames == 0 else smoothed.positions - self._last
        step = np.where(np.isfinite(self._last), step, 0.0)
        self._last = smoothed.positions.copy()
        return smoothed._replace(positions=self._follower.update(smoothed.positions, step, known))

    def _rescaled(self, smoothed: Smoothed, jitter: Floats) -> Smoothed:
        """With the standard deviation that the jitter found makes of it.

        To smooth such noise more would not help: within a short delay, the answer then lags instead.
        """
        factor = np.maximum(jitter / self._jitter_sigma, 1.0)
        return smoothed._replace(sigma=smoothed.sigma * factor[:, None])
