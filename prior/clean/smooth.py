"""The smooth stage: a bank of fixed-lag smoothers, mixed joint by joint by a network that sees the whole body."""

from __future__ import annotations

from dataclasses import dataclass

from steadypose.prior.arrays import Bools
from steadypose.prior.clean.frame import Gated
from steadypose.prior.models.mixture.inference import MixtureSmoother
from steadypose.prior.timing.fixed_lag import Smoothed

MAX_DELAY = 16
"""frames, the longest delay that the mixture was trained for"""


@dataclass(frozen=True)
class SmoothSettings:
    """Settings of the smooth stage: there are no noise parameters to tune.

    Attributes:
        weights: weight set (``default``), or a path to a ``.safetensors`` file.
    """

    weights: str = "default"


class Smooth:
    """The estimate of the frame ``delay_frames`` before the newest, joint by joint, from what passed the gate."""

    def __init__(self, settings: SmoothSettings, delay_frames: int, slots: int) -> None:
        self._mixture = MixtureSmoother(delay_frames, slots, settings.weights)

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        self._mixture.forget(slot)

    def update(self, gated: Gated) -> Smoothed | None:
        """Take in the newest frame; the estimate of the one ``delay_frames`` before, or None while there is none."""
        return self._mixture.update(gated.positions, gated.observation.stamp_s, gated.observation.confidence)

    def skip(self, stamp_s: float) -> float:
        """Take in a frame while there is no body; the stamp of the one ``delay_frames`` before."""
        return self._mixture.skip(stamp_s)

    def flush(self) -> list[Smoothed]:
        """The estimates of the last ``delay_frames`` frames (fewer if there were fewer), oldest first."""
        return self._mixture.flush()
