"""The smooth stage: a bank of fixed-lag smoothers, mixed joint by joint by a network that sees the whole body.

Beside it, the bank's smoothers are weighed by how well each predicted, which is multiple-model estimation, and knows
two things better. A joint that was lost and is seen again within the delay stands between two sightings, of which the
network is not told. And the network gives what is fast too stiff a smoother where noise is large: there the two are
joined by their variances.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from steadypose.prior.body.skeleton import PARENTS
from steadypose.prior.clean.frame import Bools, Floats, Gated
from steadypose.prior.clean.history import History
from steadypose.prior.models.mixture.bank import DENSITIES, MEASUREMENT_SIGMA
from steadypose.prior.models.mixture.inference import MixtureSmoother
from steadypose.prior.timing.fixed_lag import Smoothed
from steadypose.prior.timing.multiple_model import MultipleModelSmoother
from steadypose.prior.timing.rate import FPS

MOST_DELAY = 16
"""frames, the longest delay that the mixture was trained for"""

LOOSEST = 400.0
"""m²/s³, the process density of one more smoother than the mixture has: without it, what moves at 2.5 times its speed
in 2 mm of noise is 10 % farther off between two sightings (validation)."""

SLOW, FAST = 1.5, 3.0
"""m/s from which a joint is joined with what the best predictions say of it, and at which in full: in 4 cm of noise,
joints at 2 to 4 m/s are 7 % nearer, in noise that lasts, where predictions are too sure, accelerations of motion at 2.5
times its speed 9 % worse (validation)."""


@dataclass(frozen=True)
class SmoothSettings:
    """Which mixture; there is nothing to tell it of the sensor or of the motion.

    Attributes:
        weights: weight set (``default``), or a path to a ``.safetensors`` file.
    """

    weights: str = "default"


class Smooth:
    """The estimate of the frame ``delay_frames`` before the newest, joint by joint, from what passed the gate."""

    def __init__(self, settings: SmoothSettings, delay_frames: int, slots: int) -> None:
        if not 0 <= delay_frames <= MOST_DELAY:
            raise ValueError(f"delay: expected 0 to {MOST_DELAY} frames, got {delay_frames}")
        self._mixture = MixtureSmoother(delay_frames, slots, settings.weights)
        densities = np.append(DENSITIES, LOOSEST)
        self._models = MultipleModelSmoother(delay_frames, slots, len(PARENTS), densities, MEASUREMENT_SIGMA)
        self._before = np.full((slots, len(PARENTS), 3), np.nan)
        self._apart = np.zeros((slots, len(PARENTS), 3))

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        self._mixture.forget(slot)
        self._models.forget(slot)
        self._before[slot] = np.nan
        self._apart[slot] = 0.0

    def update(self, gated: Gated, history: History) -> Smoothed | None:
        """Take the newest frame in, which ``history`` has; None while there is no frame so long ago."""
        frame = gated.positions, gated.observation.stamp_s, gated.observation.confidence
        by_models = self._models.update(*frame)
        mixed = self._mixture.update(*frame)
        return (
            None if mixed is None or by_models is None else self._joined(mixed, by_models, history, self._mixture.delay)
        )

    def flush(self, history: History) -> list[Smoothed]:
        """The estimates of the last ``delay_frames`` frames (fewer if there were fewer), oldest first."""
        mixed, by_models = self._mixture.flush(), self._models.flush()
        backs = reversed(range(len(mixed)))
        return [self._joined(a, b, history, back) for a, b, back in zip(mixed, by_models, backs, strict=True)]

    def _joined(self, mixed: Smoothed, by_models: Smoothed, history: History, back: int) -> Smoothed:
        """The answer of the frame ``back`` before the newest; frames are to be given in order."""
        hidden, known = history.unseen_s[-1 - back] > 0, np.isfinite(by_models.sigma)
        share = np.where(hidden | ~known, 0.0, self._share(mixed, by_models.sigma))
        again = hidden & known & history.seen_since(back)
        to_models = np.nan_to_num(by_models.positions - mixed.positions)
        positions = mixed.positions + share[..., None] * to_models
        # the two differ by what noise either lets through: a body that flickers is not to jump from one to the other
        self._apart = np.where(hidden[..., None], self._apart, np.nan_to_num(positions - by_models.positions))
        kept = np.where(hidden.all(axis=1)[:, None, None], self._apart, 0.0)
        positions = np.where(again[..., None], by_models.positions + kept, positions)
        return Smoothed(mixed.stamp_s, positions, np.where(again, by_models.sigma, mixed.sigma))

    def _share(self, mixed: Smoothed, sigma: Floats) -> Floats:
        """(S, 22) of the way from the network's answer to the best predictions', of deviation ``sigma``."""
        speed = np.nan_to_num(np.linalg.norm(mixed.positions - self._before, axis=-1)) * FPS
        self._before = mixed.positions
        variance = np.square(mixed.sigma)
        with np.errstate(invalid="ignore"):  # of joints not seen so far
            by_variance = np.nan_to_num(variance / (variance + np.square(sigma)))
        return np.clip((speed - SLOW) / (FAST - SLOW), 0.0, 1.0) * by_variance
