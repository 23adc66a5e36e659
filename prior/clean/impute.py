"""The impute stage: where the joints are that nobody saw, as HG-VAE completes the window.

The encoder, given the completion network's guess and told which entries were observed, completes a window in one pass.
From there the latents may climb log p(z) + log p(x | z) of the entries observed, each weighted by its confidence, and
what they decode to is the answer. The climb goes on from frame to frame: how far the latents were moved is kept as the
window slides. Since the completion network is there, a step a frame brings limbs hidden for 0.5 to 1 s nearer to the
truth by 5 to 6 %, and takes a third of a frame's time again (docs/experiments.md): none is taken unless asked for.

The paper moves the missing entries themselves, up log p(z | x). That drifts away from the truth with every step
(`steadypose evaluate hgvae`): the posterior is surest of windows that the encoder finds easy, not of those that are
right.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np
from numba import njit

from steadypose.prior.clean.frame import BodyWindows, Bools, Floats, Imputed
from steadypose.prior.models.hgvae.features import Tracks, from_tracks
from steadypose.prior.models.hgvae.inference import Reconstruction

FIRST_DECAY, SECOND_DECAY = 0.9, 0.99
"""of Adam's moments"""

CARRY_FRAMES = 20.0
"""Frames over which what the model was off at the edge of a gap fades inside it."""

EDGE_FRAMES = 3
"""Frames beside a gap over which what the model is off is averaged, where a single one would carry its noise into the
gap: where joints jump about by more than"""
EDGE_NOISE = 0.005
"""metres. Without noise the last frame knows best."""

SIGMA_FOUND = 1.2
"""Times the standard deviation that the model states: what limbs hidden for 0.3 to 2 s are off on validation motion."""


CLIMBING = 4
"""One slot in so many climbs in one frame; if more bodies are to, each has its turn, so that eight fit into a camera's
period."""


@dataclass(frozen=True)
class ImputeSettings:
    """How far to climb.

    Attributes:
        enabled: whether to impute at all; off, hidden joints follow the refinement model.
        steps: gradient steps a frame, 1.6 ms each; 0 takes what one pass through the encoder gives.
        rate: of a step, in units of the latents, as Adam has it.
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
        """What the model makes of the window in this row: of the points visited, the one of highest score.

        Each of ``steps`` looks at a point and takes a step from it; where the last one leads is seen in the next frame.
        Without a step, what the ascent had gained when it was last looked at is added to the new start.
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
                look, score = model.decode(row, self._moved), model.score(at)
                if score > best_score:
                    best, best_at, best_score = look, self._moved, score
                elif step == 0:  # where the ascent had come to is worth less than a new start
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
    """Every body's joints of the last frames, as the model completes its window."""

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
        """Whether it is this body's turn to climb: of many, so many in each frame."""
        climbing = [k for k, ascent in enumerate(self._ascents) if ascent or k == slot]
        turns = -(-len(climbing) // max(1, len(self._ascents) // CLIMBING))
        return (climbing.index(slot) + self._updates) % turns == 0

    def update(self, windows: BodyWindows | None, jitter: Floats, *, hurry: bool) -> Imputed | None:
        """Complete the windows of those of whom something is hidden in the frames that are still to be answered.

        Args:
            windows: the newest; nobody is there if None.
            jitter: (S,) metres, of each body's joints.
            hurry: whether to do without the ascent: a live node that falls behind says so.
        """
        self._updates += 1
        frames, slots = self._frames, len(self._ascents)
        if windows is None:
            self._ascents = [None] * slots
            return None
        tracks, found = windows.tracks, windows.reconstruction
        seen = np.asarray(tracks.observed[..., -frames:].all(axis=-1))
        # A joint never seen in the window is one that the sensor does not have: that takes no climb.
        lost = np.asarray((tracks.observed.any(axis=-1) & ~seen).any(axis=-1))
        mean = found.mean.copy()
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
        # at the start: where the ascent ends, the model is surer than it is right
        variance = (found.sigma[hidden, :, -frames:] ** 2).reshape(-1, 22, 3, frames).mean(axis=2)
        sigma = SIGMA_FOUND * size[:, None, None] * np.sqrt(variance)
        imputed.sigma[:, of] = sigma.transpose(2, 0, 1)
        return imputed


def completed_tracks(tracks: Tracks, mean: Floats, noise: Floats | float = 0.0) -> Floats:
    """(..., 66, T) metres: what was seen, and what the model makes of the rest, ``mean``, without a jump at the edge of
    a gap; ``noise`` (...) metres, how much the joints seen jump about."""
    frames = mean.shape[-1]
    off, observed = (part.reshape(-1, frames) for part in (tracks.x - mean, tracks.observed))
    edges = np.empty(mean.shape[:-1], dtype=np.int64)
    edges[...] = np.where(np.asarray(noise)[..., None] > EDGE_NOISE, EDGE_FRAMES, 1)
    return mean + _carried(off, observed, CARRY_FRAMES, edges.ravel()).reshape(mean.shape)


@njit(cache=True)
def _carried(off, observed, fade, edge):
    """(N, T) what the model was off where observed, carried from either side into the gaps, where it fades.

    ``edge`` (N,): over how many frames beside a gap the mean is taken.
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
    """What the model was off just before and just after a gap, from ``last`` to ``following``; 0 beyond the window."""
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
