"""Windows of prepared motion as HG-VAE's input."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from steadypose.prior.arrays import Floats
from steadypose.prior.models.hgvae.config import SCALE
from steadypose.prior.models.hgvae.features import body_size, hang_unseen, in_frame_of, to_tracks
from steadypose.training.data.dataset import MotionSet, mirror_offsets
from steadypose.training.networks.hgvae import HGVAE

STRIDES = (1, 1, 1, 2)
"""Frame strides of training windows; a quarter is played at twice the speed, because most recordings are slow."""


class Windows:
    """Random windows of one split of the prepared motion."""

    def __init__(self, motion: MotionSet) -> None:
        self.motion = motion

    def clean(self, rows: NDArray[np.int64], mirrored: NDArray[np.bool_]) -> tuple[Floats, Floats]:
        """Positions (B, T, 22, 3) metres of frames ``rows`` (B, T), some ``mirrored`` (B,), and body sizes (B,)."""
        positions = self.motion.positions[rows]
        positions = torch.where(torch.from_numpy(mirrored)[:, None, None, None], mirror_offsets(positions), positions)
        return positions.numpy().astype(np.float64), body_size(self.motion.offsets[rows[:, 0]].numpy())

    def draw(
        self, count: int, frames: int, rng: np.random.Generator, strides: Sequence[int] = (1,)
    ) -> tuple[Floats, Floats]:
        """Positions (count, T, 22, 3) of random windows, each at one of ``strides`` (2 is twice as fast), and sizes."""
        return self.clean(self.motion.sample(count, frames, strides, rng), rng.random(count) < 0.5)


class Batch(NamedTuple):
    x: Tensor  # (B, 66, T) tracks minus the model's mean, in units of `SCALE`; interpolated where unobserved
    observed: Tensor  # (B, 66, T) 1 where observed
    certainty: Tensor  # (B, 66, T) of x: 1 where observed; elsewhere 0 until it is `completed`
    target: Tensor  # (B, 66, T) ground truth in the same frame
    counts: Tensor  # (B, 1, T) weight in the loss: 1 from the body's first observation on, 0 before it

    @classmethod
    def of(cls, model: HGVAE, seen: Floats, truth: Floats, sizes: Floats) -> Batch:
        """Build a batch from observed and true positions (B, T, 22, 3) metres, NaN where unobserved, and sizes (B,)."""
        tracks = [to_tracks(window, size) for window, size in zip(seen, sizes, strict=True)]
        true = [in_frame_of(t, window, size) for t, window, size in zip(tracks, truth, sizes, strict=True)]
        observed = torch.from_numpy(np.stack([t.observed for t in tracks])).float()
        counts = (observed.amax(dim=1, keepdim=True).cumsum(dim=-1) > 0).float()
        x = standardise(model, np.stack([t.x for t in tracks]))
        return cls(x, observed, observed, standardise(model, np.stack(true)), counts)

    def completed(self, model: HGVAE, bias_sigma: Floats | float) -> Batch:
        """The batch with its unobserved entries completed by the model.

        ``bias_sigma`` (B,) is the sensor's bias, metres along an axis.
        """
        x, certainty = model.completed(self.x, self.observed, bias_sigma)
        return self._replace(x=x, certainty=certainty)

    def joined(self, other: Batch) -> Batch:
        """Both batches as one."""
        return Batch(*(torch.cat(pair) for pair in zip(self, other, strict=True)))


def standardise(model: HGVAE, x: Floats) -> Tensor:
    """Return tracks (B, 66, T) metres minus the model's mean, in units of `SCALE`, without NaN (see `hang_unseen`)."""
    deviations = (x - model.mean.double().numpy()[:, None]) / SCALE
    hang_unseen(deviations)
    return torch.from_numpy(deviations).float()


def mean_tracks(windows: Windows, frames: int, count: int = 2000) -> Tensor:
    """(66,) metres, mean of each track over random training windows."""
    positions, sizes = windows.draw(count, frames, np.random.default_rng(0))
    tracks = [to_tracks(window, size).x for window, size in zip(positions, sizes, strict=True)]
    return torch.from_numpy(np.mean(tracks, axis=(0, 2))).float()
