"""The smooth stage: a bank of fixed-lag smoothers, mixed joint by joint by a network that sees the whole body.

Beside it, the bank's smoothers are weighed by how well each predicted, which is multiple-model estimation, and knows
two things better. A joint that was lost and is seen again within the delay stands between two sightings, of which the
network is not told. And the network gives what is fast too stiff a smoother where noise is large: there the two are
joined by their variances.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.body.skeleton import PARENTS, limbs
from steadypose.prior.clean.frame import Bools, Floats, Gated
from steadypose.prior.models.mixture.inference import MixtureSmoother
from steadypose.prior.timing.fixed_lag import Smoothed
from steadypose.prior.timing.multiple_model import MultipleModelSmoother
from steadypose.prior.timing.rate import FPS

MOST_DELAY = 16
"""frames, the longest delay that the mixture was trained for"""

COASTS_S, RESTLESS = 0.2, 3.0
"""Seconds after which an arm is not where it coasts to, as far as the mixture states, and by how many times its
deviation a second more. Hidden for one to four seconds, arms are then 2 to 10 % nearer (validation); legs, which stand,
would be 20 % farther."""

SLOW, FAST = 1.5, 3.0
"""m/s from which a joint is joined with what the best predictions say of it, and at which in full: in 4 cm of noise,
joints at 2 to 4 m/s are 7 % nearer, in noise that lasts, where predictions are too sure, accelerations of motion at 2.5
times its speed 9 % worse (validation)."""

_RESTLESS = np.zeros(len(PARENTS))
_RESTLESS[[joint for arm in limbs(("collar", "shoulder", "elbow", "wrist")) for joint in arm]] = RESTLESS


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
        self._models = MultipleModelSmoother(delay_frames, slots, len(PARENTS))
        self._before = np.full((slots, len(PARENTS), 3), np.nan)
        self._unseen = np.zeros((delay_frames + 1, slots, len(PARENTS)), dtype=np.int64)

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        self._mixture.forget(slot)
        self._models.forget(slot)
        self._before[slot] = np.nan
        self._unseen[:, slot] = 0

    def update(self, gated: Gated) -> Smoothed | None:
        """Take the newest frame in; None while there is no frame so long ago."""
        observation = gated.observation
        seen = np.isfinite(gated.positions).all(axis=-1)
        self._unseen = np.concatenate([self._unseen[1:], np.where(seen, 0, self._unseen[-1] + 1)[None]])
        frame = gated.positions, observation.stamp_s, observation.confidence
        by_models = self._models.update(*frame)
        mixed = self._mixture.update(*frame)
        return None if mixed is None or by_models is None else self._joined(mixed, by_models, self._unseen)

    def flush(self) -> list[Smoothed]:
        """The estimates of the last ``delay_frames`` frames (fewer if there were fewer), oldest first."""
        mixed, by_models = self._mixture.flush(), self._models.flush()
        return [
            self._joined(*both, self._unseen[k - len(mixed) :])
            for k, both in enumerate(zip(mixed, by_models, strict=True))
        ]

    def _joined(self, mixed: Smoothed, by_models: Smoothed, unseen: NDArray[np.int64]) -> Smoothed:
        """The answer of the first of the frames of which ``unseen`` (K, S, 22) says for how many a joint was not seen.

        Frames are to be given in order.
        """
        hidden, known = unseen[0] > 0, np.isfinite(by_models.sigma)
        again = hidden & known & (unseen == 0).any(axis=0)
        coasting = mixed.sigma * (1.0 + _RESTLESS * np.maximum(unseen[0] / FPS - COASTS_S, 0.0))
        share = np.where(hidden | ~known, 0.0, self._share(mixed, by_models.sigma))
        share[again] = 1.0
        moved = np.where(share[..., None] > 0.0, by_models.positions - mixed.positions, 0.0)
        sigma = np.where(again, by_models.sigma, np.where(hidden, coasting, mixed.sigma))
        return Smoothed(mixed.stamp_s, mixed.positions + share[..., None] * moved, sigma)

    def _share(self, mixed: Smoothed, sigma: Floats) -> Floats:
        """(S, 22) of the way from the network's answer to the best predictions', of deviation ``sigma``."""
        speed = np.nan_to_num(np.linalg.norm(mixed.positions - self._before, axis=-1)) * FPS
        self._before = mixed.positions
        variance = np.square(mixed.sigma)
        with np.errstate(invalid="ignore"):  # of joints not seen so far
            by_variance = np.nan_to_num(variance / (variance + np.square(sigma)))
        return np.clip((speed - SLOW) / (FAST - SLOW), 0.0, 1.0) * by_variance
