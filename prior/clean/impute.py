"""The impute stage: hidden joints, as HG-VAE completes the window.

Completion network and encoder complete a window in one pass. From there, optionally, gradient ascent on the latents
maximises log p(z) + log p(x | z) of the observed entries, each weighted by its confidence, and the decoded window is
the result. The ascent is warm-started: the latents' offsets are kept as the window slides. With the completion network,
one step a frame reduces the error of limbs hidden for 0.5 to 1 s by 5 to 6 % and takes a third of a frame's time more
(benchmarks/NOTEBOOK.md), so by default none is taken.

The paper instead ascends log p(z | x) in the missing entries themselves. That drifts from the truth with every step
(`steadypose evaluate hgvae`): the posterior is narrowest for windows that are easy to encode, not for correct ones.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.clean.frame import BodyWindows, Imputed
from steadypose.prior.compiled import njit
from steadypose.prior.models.hgvae.features import Tracks, from_tracks
from steadypose.prior.models.hgvae.inference import Reconstruction

FIRST_DECAY, SECOND_DECAY = 0.9, 0.99
"""of Adam's first and second moments"""

CARRY_FRAMES = 20.0
"""Frames over which the model's residual at the edge of a gap, added inside it, decays (1/e)."""

EDGE_FRAMES = 3
EDGE_NOISE = 0.005
"""The residual at the edge of a gap is the mean over this many frames where the jitter is larger than this (metres), so
that one frame's noise is not carried into the gap; otherwise that of the last frame."""

SIGMA_SCALE = 1.2
"""Ratio of error to HG-VAE's stated deviation, for limbs hidden for 0.3 to 2 s in validation motion."""


SLOTS_PER_ASCENT = 4
"""Of so many slots, one ascends in a frame; further bodies take turns, so that eight fit into a camera's period."""


@dataclass(frozen=True)
class ImputeSettings:
    """Settings of the impute stage.

    Attributes:
        enabled: whether to impute at all; off, hidden joints keep their last local rotations.
        steps: gradient steps a frame, 1.6 ms each; 0 takes the encoder's pass alone.
        rate: Adam's step size, in units of the latents.
    """

    enabled: bool = True
    steps: int = 0
    rate: float = 0.05


class LatentAscent:
    """Gradient ascent (Adam) of the latents of one body's window, as it slides."""

    def __init__(self, latents: int, settings: ImputeSettings) -> None:
        self._rate = settings.rate
        self._moved = np.zeros(latents)
        self._gained: Floats | float = 0.0
        self._first = np.zeros_like(self._moved)
        self._second = np.zeros_like(self._moved)
        self._count = 0

    def complete(self, windows: BodyWindows, row: int, steps: int) -> Reconstruction:
        """The reconstruction of the window in this row: of the points evaluated, the one of highest score.

        Each of ``steps`` evaluates a point and steps from it; the point after the last step is evaluated in the next
        frame. Without a step, the change of the last evaluated ascent is added to the encoder's reconstruction.
        """
        model, start = windows.model, Reconstruction(*(part[row] for part in windows.reconstruction))
        best, best_at = start, np.zeros_like(self._moved)
        if not steps:
            return best._replace(mean=best.mean + self._gained)
        best_score = model.score(row)
        for step in range(steps):
            at = row
            if step or self._moved.any():
                at = model.scratch_row
                decoded, score = model.decode(row, self._moved), model.score(at)
                if score > best_score:
                    best, best_at, best_score = decoded, self._moved, score
                elif step == 0:  # the kept offsets score worse than the encoder's means: start anew
                    self._moved, at = best_at, row
            self._step(model.gradient(at))
        self._gained = best.mean - start.mean
        return best

    def _step(self, uphill: Floats) -> None:
        self._count += 1
        self._first += (1 - FIRST_DECAY) * (uphill - self._first)
        self._second += (1 - SECOND_DECAY) * (uphill**2 - self._second)
        first = self._first / (1 - FIRST_DECAY**self._count)
        second = self._second / (1 - SECOND_DECAY**self._count)
        self._moved = self._moved + self._rate * first / (np.sqrt(second) + 1e-8)


class Impute:
    """Completes the last frames of every body with hidden joints."""

    def __init__(self, settings: ImputeSettings, delay_frames: int, slots: int, counters: Counter[str]) -> None:
        if settings.steps < 0 or settings.rate <= 0:
            raise ValueError(f"impute: expected steps >= 0 and rate > 0, got {settings.steps} and {settings.rate:g}")
        self._settings, self._counters = settings, counters
        self._frames = delay_frames + 1
        self._ascents: list[LatentAscent | None] = [None] * slots
        self._updates = 0

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        for k in np.flatnonzero(slot):
            self._ascents[k] = None

    def _turn(self, slot: int) -> bool:
        """Whether it is this body's turn to ascend; see `SLOTS_PER_ASCENT`."""
        ascending = [k for k, ascent in enumerate(self._ascents) if ascent or k == slot]
        turns = -(-len(ascending) // max(1, len(self._ascents) // SLOTS_PER_ASCENT))
        return (ascending.index(slot) + self._updates) % turns == 0

    def update(self, windows: BodyWindows | None, jitter: Floats, *, hurry: bool) -> Imputed | None:
        """Complete the windows of bodies with joints hidden in the frames that are still to be answered.

        Args:
            windows: the newest; None if no body is present.
            jitter: (S,) metres along an axis, of each body.
            hurry: whether to skip the ascent, for a live node that falls behind.
        """
        self._updates += 1
        frames, slots = self._frames, len(self._ascents)
        if windows is None:
            self._ascents = [None] * slots
            return None
        tracks, reconstruction = windows.tracks, windows.reconstruction
        seen = np.asarray(tracks.observed[..., -frames:].all(axis=-1))
        # a joint never seen in the window is one that the sensor does not have: no ascent for it
        lost = np.asarray((tracks.observed.any(axis=-1) & ~seen).any(axis=-1))
        mean = reconstruction.mean.copy()
        for row, slot in enumerate(windows.slots):
            if seen[row].all():
                self._ascents[slot] = None
                continue
            steps = self._settings.steps if lost[row] and self._turn(slot) else 0
            if hurry and steps:
                self._counters["imputation_skipped"] += 1
                steps = 0
            ascent = self._ascents[slot] or LatentAscent(windows.model.latents, self._settings)
            self._ascents[slot] = ascent
            mean[row] = ascent.complete(windows, row, steps).mean
        hidden = np.flatnonzero(~seen.all(axis=-1))
        of, size = windows.slots[hidden], windows.size[hidden]
        tracks = Tracks(*(part[hidden] for part in tracks))
        completed = completed_tracks(tracks, mean[hidden], jitter[of])[..., -frames:]
        imputed = Imputed(np.full((frames, slots, 22, 3), np.nan), np.full((frames, slots, 22), np.inf))
        imputed.positions[:, of] = from_tracks(completed, tracks, size).swapaxes(0, 1)
        # of the encoder's pass: after an ascent the stated deviation is too small
        variance = (reconstruction.sigma[hidden, :, -frames:] ** 2).reshape(-1, 22, 3, frames).mean(axis=2)
        sigma = SIGMA_SCALE * size[:, None, None] * np.sqrt(variance)
        imputed.sigma[:, of] = sigma.transpose(2, 0, 1)
        return imputed


def completed_tracks(tracks: Tracks, mean: Floats, noise: Floats | float = 0.0) -> Floats:
    """(..., 66, T) metres: observed entries, and the reconstruction elsewhere, continuous at the edges of gaps.

    Args:
        tracks: observed windows (..., 66, T).
        mean: (..., 66, T) metres, their reconstruction.
        noise: (...) metres along an axis, jitter of the observed joints.
    """
    frames = mean.shape[-1]
    off, observed = (part.reshape(-1, frames) for part in (tracks.x - mean, tracks.observed))
    edges = np.empty(mean.shape[:-1], dtype=np.int64)
    edges[...] = np.where(np.asarray(noise)[..., None] > EDGE_NOISE, EDGE_FRAMES, 1)
    return mean + _carried(off, observed, CARRY_FRAMES, edges.ravel()).reshape(mean.shape)


@njit(cache=True)
def _carried(off, observed, fade, edge):
    """(N, T) the model's residuals where observed, extrapolated from either side into the gaps, where they decay.

    ``edge`` (N,): frames beside a gap over which the residual is averaged.
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
    """The model's residual just before and just after a gap, from ``last`` to ``following``; 0 beyond the window."""
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
