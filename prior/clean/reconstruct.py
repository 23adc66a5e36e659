"""The reconstruct stage: HG-VAE's reconstruction of the window of each body, for denoise, score and impute."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.clean.frame import BodyWindows, Person, SensorNoise
from steadypose.prior.clean.history import History
from steadypose.prior.models.hgvae.features import body_size, to_tracks
from steadypose.prior.models.hgvae.inference import LiveHGVAE

MIN_CONFIDENCE = 0.1
"""Lower bound of the confidence of a joint that passed the gate"""


@dataclass(frozen=True)
class ReconstructSettings:
    """Settings of the reconstruct stage (``[prior.encode]``).

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
        """Reconstruct the windows of the bodies present; None if there is none.

        Args:
            history: of the observations.
            present: (S,) which slots hold a body.
            person: their bones.
            bias_sigma: (S,) metres along an axis, slow error of the sensor, estimated from each body.
        """
        slots = np.flatnonzero(present)
        if not len(slots):
            return None
        size = body_size(person.offsets[slots])
        tracks = to_tracks(history.positions[-self.frames :, slots].swapaxes(0, 1), size)
        by_joint = np.clip(history.confidence[-self.frames :, slots], MIN_CONFIDENCE, 1.0)
        confidence = tracks.observed * np.repeat(by_joint.transpose(1, 2, 0), 3, axis=1)
        reconstruction = self._model.reconstruct(tracks.x, confidence, bias_sigma[slots])
        return BodyWindows(slots, tracks, confidence, size, reconstruction, self._model)
