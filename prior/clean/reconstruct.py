"""What HG-VAE makes of the window of each body: to denoise, score and impute by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from steadypose.prior.clean.frame import BodyWindows, Bools, Floats, Person, SensorNoise
from steadypose.prior.clean.history import History
from steadypose.prior.models.hgvae.features import body_size, to_tracks
from steadypose.prior.models.hgvae.inference import LiveHGVAE

MIN_CONFIDENCE = 0.1
"""of a joint that passed the gate"""


@dataclass(frozen=True)
class ReconstructSettings:
    """Which HG-VAE.

    Attributes:
        weights: weight set (``default``, ``research``) or a path to a ``.safetensors`` file.
    """

    weights: str = "default"


class Reconstruct:
    """Runs HG-VAE once over the last frames of the bodies present."""

    def __init__(self, settings: ReconstructSettings, noise: SensorNoise, slots: int) -> None:
        self._model = LiveHGVAE.load(settings.weights, noise.total_sigma, slots)
        self.frames = self._model.frames

    def update(self, history: History, present: Bools, person: Person, bias_sigma: Floats) -> BodyWindows | None:
        """What HG-VAE makes of the windows of the bodies ``present`` (S,), None if there is none.

        ``bias_sigma`` (S,) metres along an axis is the slow error found of what is seen of each.
        """
        slots = np.flatnonzero(present)
        if not len(slots):
            return None
        size = body_size(person.offsets[slots])
        tracks = to_tracks(history.positions[-self.frames :, slots].swapaxes(0, 1), size)
        of_joints = np.clip(history.confidence[-self.frames :, slots], MIN_CONFIDENCE, 1.0)
        confidence = tracks.observed * np.repeat(of_joints.transpose(1, 2, 0), 3, axis=1)
        reconstruction = self._model.reconstruct(tracks.x, confidence, bias_sigma[slots])
        return BodyWindows(slots, tracks, confidence, size, reconstruction, self._model)
