"""The encode stage: what HG-VAE makes of the window of each body, for the stages that score and impute."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from prior.body_tracks import Tracks, body_size, to_tracks
from prior.checkpoint import load_weights
from prior.hgvae import HGVAE, HGVAEConfig
from prior.hgvae_live import LiveHGVAE, Look
from prior.window import Window

LEAST_TRUST = 0.1
"""in a joint that passed the gate"""


@dataclass(frozen=True)
class EncodeSettings:
    """Which HG-VAE.

    Attributes:
        weights: weight set (``default``, ``research``) or a path to a ``.safetensors`` file.
    """

    weights: str = "default"


class Encoded(NamedTuple):
    """One body's window, seen and as the model would have it.

    Attributes:
        tracks: what was seen, in the body's frame.
        trust: (66, T) how far to believe each entry: the confidence of its joint, 0 where it was not seen.
        size: of the body, as `body_size` gives it.
        look: what the model makes of it.
        model: that looked, and still stands at this window.
    """

    tracks: Tracks
    trust: NDArray[np.float64]
    size: float
    look: Look
    model: LiveHGVAE


class Encode:
    """Runs HG-VAE once over the last frames of each body and keeps the result in ``window.encoded``."""

    delay_frames = 0

    def __init__(self, settings: EncodeSettings, sensor_sigma: float, slots: int) -> None:
        state, config = load_weights(settings.weights, "hgvae")
        model = HGVAE(HGVAEConfig.from_dict(config))
        model.load_state_dict(state)
        first = LiveHGVAE(model, sensor_sigma)
        # loops are compiled at their first call, or loaded: not while a frame waits
        tracks = to_tracks(np.zeros((first.frames, 22, 3)), 1.0)
        first.look(tracks.x, tracks.observed)
        first.gradient()
        self._models = [first, *(first.another() for _ in range(slots - 1))]
        self.frames = first.frames

    def reset(self, slot: NDArray[np.bool_]) -> None:
        """Nothing is kept here."""

    def update(self, window: Window) -> Window:
        """Encode the window of every body present."""
        window.encoded = [None] * window.slots
        for slot in np.flatnonzero(window.present):
            size = float(body_size(window.offsets[slot]))
            tracks = to_tracks(window.positions.all[-self.frames :, slot], size)
            confidence = np.clip(window.confidence.all[-self.frames :, slot], LEAST_TRUST, 1.0)
            trust = tracks.observed * np.repeat(confidence.T, 3, axis=0)
            model = self._models[slot]
            window.encoded[slot] = Encoded(tracks, trust, size, model.look(tracks.x, trust), model)
        return window
