"""The encode stage: what HG-VAE makes of the window of each body, for the stages that score and impute."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.clean.frame import Window
from steadypose.prior.models.hgvae.features import Tracks, body_size, to_tracks
from steadypose.prior.models.hgvae.inference import LiveHGVAE, Reconstruction

LEAST_TRUST = 0.1
"""in a joint that passed the gate"""

BRIDGED = 3
"""Frames: when so many at most were lost whole, joints went in a straight line. The model knows limbs that are hidden,
not bodies that flicker, and would pass the flicker on."""


@dataclass(frozen=True)
class EncodeSettings:
    """Which HG-VAE.

    Attributes:
        weights: weight set (``default``, ``research``) or a path to a ``.safetensors`` file.
    """

    weights: str = "default"


class Encoded(NamedTuple):
    """The windows of the bodies present, seen and as the model would have them.

    Attributes:
        slots: (B,) whose windows these are.
        tracks: what was seen, each in its body's frame.
        trust: (B, 66, T) how far to believe each entry: the confidence of its joint, 0 where it was not seen.
        size: (B,) of the bodies, as `body_size` gives it.
        look: what the model makes of them.
        model: that looked, and still stands at these windows.
    """

    slots: NDArray[np.intp]
    tracks: Tracks
    trust: NDArray[np.float64]
    size: NDArray[np.float64]
    look: Reconstruction
    model: LiveHGVAE


class Encode:
    """Runs HG-VAE once over the last frames of the bodies present and keeps the result in ``window.encoded``."""

    delay_frames = 0

    def __init__(self, settings: EncodeSettings, sensor_sigma: float, slow: float, slots: int) -> None:
        self._model = LiveHGVAE.load(settings.weights, sensor_sigma, slow, slots)
        self._lost = np.zeros(slots, dtype=np.int64)
        self.frames = self._model.frames

    def reset(self, slot: NDArray[np.bool_]) -> None:
        """Forget the bodies in these slots."""
        self._lost[slot] = 0

    def update(self, window: Window) -> Window:
        """Encode the windows of the bodies present."""
        self._bridge(window)
        slots = np.flatnonzero(window.present)
        window.encoded = None
        if not len(slots):
            return window
        size = body_size(window.offsets[slots])
        tracks = to_tracks(window.positions.all[-self.frames :, slots].swapaxes(0, 1), size)
        confidence = np.clip(window.confidence.all[-self.frames :, slots], LEAST_TRUST, 1.0)
        trust = tracks.observed * np.repeat(confidence.transpose(1, 2, 0), 3, axis=1)
        look = self._model.reconstruct(tracks.x, trust)
        window.encoded = Encoded(slots, tracks, trust, size, look, self._model)
        return window

    def _bridge(self, window: Window) -> None:
        """Fill the frames of which nothing was seen, once the body is seen again."""
        seen = np.isfinite(window.positions.newest[..., 0]).any(axis=1)
        for slot in np.flatnonzero(seen & (self._lost > 0) & (self._lost <= BRIDGED)).tolist():
            lost = int(self._lost[slot])
            before, now = window.positions.all[-2 - lost][slot], window.positions.newest[slot]
            for back in range(1, lost + 1):
                window.positions.amend(back, slot, now + back / (lost + 1) * (before - now))
        self._lost = np.where(seen, 0, self._lost + 1)
