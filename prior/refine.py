"""Refinement: encode a window, decode it, keep one frame, slide by one (HM-VAE, equations 10 to 13)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from prior.checkpoint import load_weights
from prior.hmvae import HMVAE, HMVAEConfig
from prior.hmvae_live import LiveHMVAE
from prior.kinematics import heading, yaw_matrix
from prior.window import Window


@dataclass(frozen=True)
class RefineSettings:
    """Whether, and with which weights, to refine.

    Attributes:
        enabled: whether to; off, the solved rotations pass as they are.
        weights: weight set (``default``, ``research``) or a path to a ``.safetensors`` file.
    """

    enabled: bool = True
    weights: str = "default"


class Refine:
    """Centre-frame refinement by HM-VAE, with a delay of one's choice.

    A window N_1 … N_T goes through the posterior's mean and the decoder, and its frame ``T - 1 - delay`` (counted
    from 0) is kept by the fusion that follows. With the default delay T / 2 that is index T / 2 - 1, the paper's
    M_{T/2} of equation 12. Smaller delays keep later frames of the same windows, down to 0, the newest; with larger
    ones, which other stages may ask for, a frame keeps what it was as the centre. At the start of a stream, windows
    are filled up with the first frame.
    """

    def __init__(self, settings: RefineSettings, delay_frames: int) -> None:
        self._enabled = settings.enabled
        state, config = load_weights(settings.weights, "hmvae")
        model = HMVAE(HMVAEConfig.from_dict(config))
        model.load_state_dict(state)
        self._reconstruct = LiveHMVAE(model)
        self.window = model.config.window
        if not 0 <= delay_frames <= 2 * self.window:
            raise ValueError(
                f"delay: expected 0 to {2 * self.window} frames (twice the model's window), got {delay_frames}"
            )
        self.delay_frames = delay_frames

    def reset(self, slot: NDArray[np.bool_]) -> None:
        """Nothing is kept here."""

    def update(self, window: Window) -> Window:
        """Write ``window.decoded`` for every body present, all of them in one batch."""
        slots = np.flatnonzero(window.present)
        frames = window.rotations.all[-self.window :, slots]
        kept = self.window // 2 + 1  # from the centre on; before it, a frame stays as it was decoded
        window.decoded[:-1] = window.decoded[1:]
        missing = np.isnan(frames[..., 0, 0, 0]).sum(axis=0)  # a body younger than the window repeats its first frame
        order = np.maximum(np.arange(self.window)[:, None], missing)
        frames = frames[order, np.arange(len(slots))]
        if not self._enabled or not len(slots):
            window.decoded[-kept:, slots] = frames[-kept:]
            return window
        # The body faces +x in the centre frame, as in training; only the root's rotation knows.
        back = yaw_matrix(heading(frames[self.window // 2 - 1, :, 0]))
        root = back.swapaxes(-1, -2) @ frames[:, :, 0]
        x = np.empty((len(slots), self.window, 22, 6), dtype=np.float32)
        for k in range(2):  # the first two columns of each rotation, as `to_6d`
            x[..., 3 * k : 3 * k + 3] = frames[..., k].swapaxes(0, 1)
            x[:, :, 0, 3 * k : 3 * k + 3] = root[..., k].swapaxes(0, 1)
        decoded = rotations_of(self._reconstruct(x)[:, -kept:])
        decoded[:, :, 0] = back[:, None] @ decoded[:, :, 0]
        window.decoded[-kept:, slots] = decoded.swapaxes(0, 1)
        return window


def rotations_of(x: NDArray[np.float32]) -> NDArray[np.float64]:
    """As `prior.hmvae.from_6d`: (..., 6) to rotation matrices (..., 3, 3)."""
    rotations = np.empty((*x.shape[:-1], 3, 3))
    _rotations_of(np.ascontiguousarray(x).reshape(-1, 6), rotations.reshape(-1, 3, 3))
    return rotations


@njit("(f4[:,::1], f8[:,:,::1])", cache=True)
def _rotations_of(x, rotations):
    for k in range(len(x)):
        r = rotations[k]
        along = length = rest = 0.0
        for i in range(3):
            length += x[k, i] * x[k, i]
        for i in range(3):
            r[i, 0] = x[k, i] / max(np.sqrt(length), 1e-12)
            along += r[i, 0] * x[k, 3 + i]
        for i in range(3):
            r[i, 1] = x[k, 3 + i] - along * r[i, 0]
            rest += r[i, 1] * r[i, 1]
        for i in range(3):
            r[i, 1] /= max(np.sqrt(rest), 1e-12)
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            r[i, 2] = r[a, 0] * r[b, 1] - r[b, 0] * r[a, 1]
