"""The correct stage: subtracts a known sensor's systematic error from the observed joints."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from steadypose.prior.arrays import Bools
from steadypose.prior.body.skeleton import finite_joints
from steadypose.prior.clean.frame import Gated
from steadypose.prior.clean.history import Ring
from steadypose.prior.models.sensor_bias import HISTORY, SMOOTHER_DENSITY, LiveCorrection, features, recall, trunk_frame
from steadypose.prior.timing.kalman import ConstantVelocityFilter

FADE = 0.9
"""Decay per frame of the last correction while none can be computed, because the trunk is hidden."""


@dataclass(frozen=True)
class CorrectSettings:
    """Settings of the correct stage.

    Attributes:
        sensor: ``kinect_v2``, or empty for a sensor whose error is not known. A property of the sensor, not of its
            joint layout: another camera with the same joints has other errors.
    """

    sensor: str = ""


class Correct:
    """Adds `CorrectionNet`'s correction to each observed joint, without delay."""

    def __init__(self, settings: CorrectSettings, slots: int) -> None:
        self._net = LiveCorrection.load(settings.sensor, slots)
        self._smoother = ConstantVelocityFilter(SMOOTHER_DENSITY)
        self._history = Ring(HISTORY[-1] + 1, (slots, 22, 3))
        self._correction = np.zeros((slots, 22, 3))

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        if slot.all():
            self._smoother.reset()  # a new stream: its stamps may be earlier
        self._smoother.forget(np.repeat(slot[:, None], 22, axis=1))
        self._history.clear(slot)
        self._correction[slot] = 0.0

    def update(self, gated: Gated) -> Gated:
        """The newest frame, corrected."""
        newest, observation = gated.positions, gated.observation
        smoothed = self._smoother.update(newest, observation.stamp_s)
        self._history.push(np.where(finite_joints(newest)[..., None], smoothed.positions, np.nan))
        slots = np.flatnonzero(observation.present)
        history = recall(self._history.all[:, slots])
        frames = trunk_frame(history[0])
        known = np.isfinite(frames).all(axis=(1, 2))
        self._correction[slots[~known]] *= FADE
        if known.any():
            x = features(history[:, known], observation.sensor_position)
            self._correction[slots[known]] = self._net(x) @ frames[known].swapaxes(-1, -2)
        return replace(gated, positions=newest + self._correction)
