"""The impute stage: the completion network and HG-VAE estimate hidden joints in one pass.

The paper instead maximises log p(z | x) over the missing entries by gradient ascent. Its error grows with every step
(`steadypose evaluate hgvae`), because the posterior is narrowest for windows that are easy to encode.
"""

from __future__ import annotations

import math

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.clean.frame import BodyWindows, Imputed
from steadypose.prior.compiled import njit
from steadypose.prior.models.hgvae.features import Tracks, from_tracks

CARRY_FRAMES = 20.0  # decay length (1/e) inside a gap of the model's residual at the edge of the gap, frames

EDGE_FRAMES = 3
EDGE_NOISE = 0.005
"""Number of frames over which the residual at the edge of a gap is averaged, and jitter above which it is, metres. The
mean keeps one frame's noise out of the gap. With less jitter, the residual of the last frame is used."""

SIGMA_SCALE = 1.2  # error-to-sigma ratio of HG-VAE for limbs hidden for 0.3 to 2 s in validation motion


def impute(windows: BodyWindows | None, jitter: Floats, frames: int) -> Imputed | None:
    """Complete the last ``frames`` frames, still to be published, of every body that has hidden joints in them; None if
    no body has. ``jitter`` (S,) metres along an axis is each body's."""
    if windows is None:
        return None
    tracks, reconstruction = windows.tracks, windows.reconstruction
    hidden = np.flatnonzero((tracks.observed[..., -frames:] == 0).any(axis=(-2, -1)))
    if not len(hidden):
        return None
    slots, size = windows.slots[hidden], windows.size[hidden]
    tracks = Tracks(*(part[hidden] for part in tracks))
    completed = completed_tracks(tracks, reconstruction.mean[hidden], jitter[slots])[..., -frames:]
    imputed = Imputed(np.full((frames, len(jitter), 22, 3), np.nan), np.full((frames, len(jitter), 22), np.inf))
    imputed.positions[:, slots] = from_tracks(completed, tracks, size).swapaxes(0, 1)
    variance = (reconstruction.sigma[hidden, :, -frames:] ** 2).reshape(-1, 22, 3, frames).mean(axis=2)
    sigma = SIGMA_SCALE * size[:, None, None] * np.sqrt(variance)
    imputed.sigma[:, slots] = sigma.transpose(2, 0, 1)
    return imputed


def completed_tracks(tracks: Tracks, mean: Floats, noise: Floats | float = 0.0) -> Floats:
    """Fill gaps of windows (..., 66, T) metres with their reconstruction ``mean``, continuous at their edges. ``noise``
    (...) is the jitter of the observed joints, metres along an axis."""
    frames = mean.shape[-1]
    off, observed = (part.reshape(-1, frames) for part in (tracks.x - mean, tracks.observed))
    edges = np.empty(mean.shape[:-1], dtype=np.int64)
    edges[...] = np.where(np.asarray(noise)[..., None] > EDGE_NOISE, EDGE_FRAMES, 1)
    return mean + _carried(off, observed, CARRY_FRAMES, edges.ravel()).reshape(mean.shape)


@njit(cache=True)
def _carried(off, observed, fade, edge):
    """(N, T) the model's residuals where observed; in the gaps, extrapolated from both sides with exponential decay.

    ``edge`` (N,) is the number of frames beside a gap over which the residual is averaged.
    """
    nodes, frames = off.shape
    carried = np.zeros((nodes, frames))
    for node in range(nodes):
        last = -1
        for t in range(frames + 1):
            if t < frames:
                if observed[node, t] == 0.0:
                    continue
                carried[node, t] = off[node, t]
            if t > last + 1:
                earlier, later = _beside_gap(off[node], observed[node], last, t, edge[node])
                for u in range(last + 1, t):
                    before, after = u - last, t - u
                    share = 0.0 if last < 0 else (1.0 if t == frames else after / (before + after))
                    carried[node, u] = share * earlier * math.exp(-before / fade)
                    carried[node, u] += (1.0 - share) * later * math.exp(-after / fade)
            last = t
    return carried


@njit(cache=True)
def _beside_gap(off, observed, last, following, edge):
    """The model's residuals just before and after the gap between ``last`` and ``following``; 0 outside the window."""
    earlier = later = 0.0
    count = 0
    for t in range(last, max(last - edge, -1), -1):
        if observed[t] == 0.0:
            break
        earlier += off[t]
        count += 1
    earlier /= max(count, 1)
    count = 0
    for t in range(following, min(following + edge, len(off))):
        if observed[t] == 0.0:
            break
        later += off[t]
        count += 1
    return earlier, later / max(count, 1)
