"""The occlusion sweep (figure 4), and the effect of imputation on a motion predictor (figure 5).

Single entries, whole joints, or a limb for a time are hidden; every method gets the same windows. "mean" is the
training mean of each track, "hold" the last observation, "line" linear interpolation in time, "guess" interpolation
relative to the parent, "completion" the completion network's output, from which HG-VAE starts. The paper ascends log
p(z | x) in the missing entries.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from steadypose.benchmarks.corruption import LIMBS
from steadypose.prior.arrays import Floats
from steadypose.prior.clean.impute import completed_tracks
from steadypose.prior.models.hgvae.config import SCALE
from steadypose.prior.models.hgvae.features import Tracks, from_tracks, in_frame_of, to_tracks
from steadypose.prior.models.hgvae.inference import LiveHGVAE
from steadypose.training.data.hgvae_windows import Batch, Windows, standardise
from steadypose.training.networks.hgvae import HGVAE
from steadypose.training.weights import arrays_of

Mask = NDArray[np.bool_]

FEATURES = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 0.5)
"""Shares of all 3,300 entries."""
BURSTS_S = (0.1, 0.3, 0.5, 1.0)

PAPER_RATE = 0.01
"""Metres: Adam's rate for the entries, by its best result on windows of training."""

BIAS_SIGMA = 0.0
"""Metres: the windows are clean."""


def some_features(shape: tuple[int, int], rng: np.random.Generator, share: float) -> Mask:
    """(66, T) entries hidden independently."""
    return rng.random(shape) < share


def some_joints(shape: tuple[int, int], rng: np.random.Generator, count: int) -> Mask:
    """(66, T) whole joints, all the time."""
    hidden = np.zeros(shape, dtype=bool)
    hidden.reshape(22, 3, -1)[1 + rng.choice(21, count, replace=False)] = True
    return hidden


def a_limb(shape: tuple[int, int], rng: np.random.Generator, seconds: float) -> Mask:
    """(66, T) a lower arm or leg, for a while, somewhere in the window."""
    hidden = np.zeros(shape, dtype=bool)
    length = round(seconds * 30)
    start = int(rng.integers(1, shape[1] - length))
    hidden.reshape(22, 3, -1)[LIMBS[rng.integers(len(LIMBS))], :, start : start + length] = True
    return hidden


CONDITIONS: Mapping[str, Callable[[tuple[int, int], np.random.Generator], Mask]] = {
    **{f"{100 * s:g} % of entries": partial(some_features, share=s) for s in FEATURES},
    **{f"{n} whole joint{'s' if n > 1 else ''}": partial(some_joints, count=n) for n in (1, 4)},
    **{f"a limb for {s:g} s": partial(a_limb, seconds=s) for s in BURSTS_S},
}


def impute_all(
    model: HGVAE, positions: Floats, sizes: Floats, masks: Mask, steps: tuple[int, ...]
) -> dict[str, tuple[Floats, Floats]]:
    """Every method over windows.

    Args:
        positions: (B, T, 22, 3) metres, complete.
        sizes: (B,) of the bodies.
        masks: (B, 66, T) entries to hide.
        steps: of the paper's gradient ascent.

    Returns:
        By method: (B, 66, T) tracks, and the truth in the same frame, metres of a standard body.
    """
    clean = [to_tracks(window, size) for window, size in zip(positions, sizes, strict=True)]
    truth = np.stack([t.x for t in clean])
    observed = ~masks
    mean = model.mean.double().numpy()[:, None]
    hold, line, guess = truth.copy(), truth.copy(), truth.copy()
    for b in range(len(truth)):
        hold[b], line[b] = _held(truth[b], observed[b], mean), _line(truth[b], observed[b], mean)
        guess[b] = _guess(positions[b], sizes[b], clean[b], observed[b], line[b])
    live = LiveHGVAE(model.config, arrays_of(model), 1)
    hung = standardise(model, guess)
    completed, _ = model.completed(hung, torch.from_numpy(observed).float(), BIAS_SIGMA)
    guess_m, completed_m = (x.double().numpy() * SCALE + mean for x in (hung, completed))
    found = {"mean": np.where(masks, mean, truth), "hold": hold, "line": line, "guess": guess_m}
    if model.completion:
        found["completion"] = completed_m
    passes: dict[str, list[Floats]] = {}
    for t, x, seen in zip(clean, guess, observed.astype(float), strict=True):
        tracks = t._replace(x=x, observed=seen)
        reconstruction = live.reconstruct(x[None], seen[None], np.array([BIAS_SIGMA]))
        passes.setdefault("HG-VAE, one pass", []).append(completed_tracks(tracks, reconstruction.mean[0]))
    found |= {name: np.stack(windows) for name, windows in passes.items()}
    for count in steps:
        found[f"HG-VAE, the paper's ascent, {count} steps"] = ascend_entries(model, line, observed, count)
    return {name: (np.where(masks, x, truth), truth) for name, x in found.items()}


@torch.no_grad()
def whole_joints(model: HGVAE, positions: Floats, sizes: Floats, hidden: Mask) -> dict[str, Floats]:
    """Windows (B, T, 22, 3) of which joints ``hidden`` (B, 22) are not seen at all, by methods that need one pass.

    Returns:
        By method: (B,) squared errors in mm^2, summed over axes, frames and hidden joints.
    """
    found: dict[str, list[Floats]] = {}
    for first in range(0, len(positions), 256):
        part = slice(first, first + 256)
        seen = np.where(hidden[part, None, :, None], np.nan, positions[part])
        batch = Batch.of(model, seen, positions[part], sizes[part])
        done = batch.completed(model, BIAS_SIGMA)
        passed = model(done.x, done.certainty).tracks.mean
        for name, x in {
            "mean": torch.zeros_like(batch.x), "guess": batch.x, "completion": done.x, "HG-VAE": passed,
        }.items():  # fmt: skip
            off = (x - batch.target).masked_fill(batch.observed > 0, 0.0).double() * (SCALE * 1000)
            found.setdefault(name, []).append(off.square().sum(dim=(1, 2)).numpy())
    return {name: np.concatenate(parts) for name, parts in found.items()}


def ascend_entries(model: HGVAE, start: Floats, observed: Mask, steps: int) -> Floats:
    """The paper's imputation: Adam on the missing entries, up the score of section 7, keeping each window's best.

    Args:
        start: (B, 66, T) metres, the entries observed and a guess of the others.
        observed: (B, 66, T)
        steps: of Adam.
    """
    x = standardise(model, start)
    seen = torch.from_numpy(observed)
    moved = torch.zeros_like(x, requires_grad=True)
    optimiser = torch.optim.Adam([moved], lr=PAPER_RATE / SCALE)
    best, best_score = x.clone(), torch.full((len(x),), -torch.inf)
    for step in range(steps + 1):
        tried = torch.where(seen, x, x + moved)
        score = model(tried, torch.ones_like(tried)).log_prior.sum(dim=1)
        better = score.detach() > best_score
        best[better], best_score[better] = tried.detach()[better], score.detach()[better]
        if step < steps:
            optimiser.zero_grad()
            (-score.sum()).backward(inputs=[moved])
            optimiser.step()
    return best.double().numpy() * SCALE + model.mean.double().numpy()[:, None]


def _held(track: Floats, observed: Mask, mean: Floats) -> Floats:
    """(66, T) the last observation; before the first, that one; the mean where there is none."""
    last = np.maximum.accumulate(np.where(observed, np.arange(track.shape[1]), -1), axis=1)
    first = np.where(observed.any(axis=1), observed.argmax(axis=1), 0)[:, None]
    held = np.take_along_axis(track, np.where(last < 0, first, last), axis=1)
    return np.where(observed.any(axis=1, keepdims=True), held, mean)


def _line(track: Floats, observed: Mask, mean: Floats) -> Floats:
    frames = np.arange(track.shape[1])
    return np.stack([
        np.interp(frames, frames[seen], row[seen]) if seen.any() else np.full(len(row), middle)
        for row, seen, middle in zip(track, observed, mean[:, 0], strict=True)
    ])  # fmt: skip


def _guess(window: Floats, size: float, clean: Tracks, observed: Mask, line: Floats) -> Floats:
    """The interpolation of `to_tracks` for hidden joints, in the frame of the clean window; linear for single
    entries."""
    joints = observed.reshape(22, 3, -1)
    if (joints != joints[:, :1]).any():
        return line
    seen = np.where(joints[:, 0].T[..., None], window, np.nan)
    tracks = to_tracks(seen, size)
    guessed = in_frame_of(clean, from_tracks(tracks.x, tracks, size), size)
    return np.where(observed, clean.x, guessed)  # NaN for a joint never seen: the model hangs it from the one above


class Predictor(nn.Module):
    """A small predictor of the half second after a window: the displacement of each track from its last entry."""

    FUTURE = 15

    def __init__(self, frames: int) -> None:
        super().__init__()
        self.net = nn.Sequential(
            nn.Linear(66 * frames, 256), nn.GELU(), nn.Linear(256, 256), nn.GELU(), nn.Linear(256, 66 * self.FUTURE)
        )

    def forward(self, x: Tensor) -> Tensor:
        """(B, 66, T) to (B, 66, FUTURE), in the same frame and scale."""
        return x[..., -1:] + self.net(x.flatten(1)).unflatten(1, (66, self.FUTURE))


def train_predictor(windows: Windows, frames: int, steps: int, model: HGVAE) -> Predictor:
    """On clean windows; ``model`` says the scale."""
    torch.manual_seed(0)
    predictor = Predictor(frames)
    optimiser = torch.optim.Adam(predictor.parameters(), lr=5e-4)
    for step in range(steps):
        x, future = predictor_pair(windows, frames, 64, np.random.default_rng((1, step)), model)[:2]
        loss = (predictor(x) - future).abs().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return predictor.eval()


def predictor_pair(
    windows: Windows, frames: int, count: int, rng: np.random.Generator, model: HGVAE
) -> tuple[Tensor, Tensor, Floats, Floats]:
    """Windows (B, 66, T) and what follows (B, 66, FUTURE), and the positions and body sizes they are made of."""
    positions, sizes = windows.draw(count, frames + Predictor.FUTURE, rng)
    past, future = positions[:, :frames], positions[:, frames:]
    tracks = [to_tracks(window, size) for window, size in zip(past, sizes, strict=True)]
    x = standardise(model, np.stack([t.x for t in tracks]))
    ahead = [_after(t, window, size) for t, window, size in zip(tracks, future, sizes, strict=True)]
    return x, standardise(model, np.stack(ahead)), past, sizes


def _after(tracks: Tracks, positions: Floats, size: float) -> Floats:
    """(66, FUTURE) tracks of later frames, about where the path ends."""
    there = tracks._replace(path=np.repeat(tracks.path[-1:], len(positions), axis=0))
    later = in_frame_of(there, positions, size)
    later[:3] = in_frame_of(tracks._replace(path=np.repeat(tracks.path.mean(axis=0)[None], len(positions), axis=0)),
                            positions, size)[:3]  # fmt: skip
    return later
