"""Calibration of the anomaly score: what clean motion of people whom the model has not seen scores.

Everything is measured as the live node sees it: a sensor of a given error, half of it slow, and some joints missing.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track

from prior.anomaly import MISSING, RATES, SENSOR_SIGMAS, Calibration, deviations, oddities
from prior.body_tracks import to_tracks
from prior.checkpoint import load_weights
from prior.hgvae import HGVAE, SCALE, HGVAEConfig
from prior.motion_windows import MotionSet
from prior.track_windows import Windows, standardise

Floats = NDArray[np.float64]

HELD_BACK = "s08"
"""Whom the calibration does not see, so that false alarms can be counted on somebody."""

WINDOWS = 2000
"""for each error and number of joints missing"""


def calibrate_anomaly(data: Path, weights: str, path: Path) -> None:
    """Measure the scale of the anomaly score on validation motion and write it beside an HG-VAE's weights.

    Args:
        data: ``prepared.npz``.
        weights: which set: ``default`` or ``research``.
        path: of the weights, ``.safetensors``.
    """
    state, config = load_weights(str(path), "hgvae")
    model = HGVAE(HGVAEConfig.from_dict(config))
    model.load_state_dict(state)
    model.eval()
    motion = MotionSet.load(data, weights, "val")
    motion = motion.only(motion.subject != HELD_BACK)
    note = f"what validation people but {HELD_BACK} score; made with the weights by 'steadypose train'"
    calibrate(model, Windows(motion), WINDOWS, seed=0).save(path.with_suffix(".anomaly.json"), note)


def calibrate(model: HGVAE, windows: Windows, count: int, seed: int) -> Calibration:
    """The scale, from ``count`` windows for each condition."""
    rng = np.random.default_rng(seed)
    conditions = [(m, s) for m in range(len(MISSING)) for s in range(len(SENSOR_SIGMAS))]
    mean = np.zeros((len(MISSING), len(SENSOR_SIGMAS), 22))
    spread = np.ones_like(mean)
    quantiles = np.zeros((len(MISSING), len(SENSOR_SIGMAS), len(RATES)))
    for m, s in track(conditions, "calibrating"):
        positions, sizes = windows.draw(count, model.config.frames, rng)
        seen = hide_joints(sensed(positions, SENSOR_SIGMAS[s], rng), MISSING[m], rng)
        logs = score_windows(model, seen, sizes)
        mean[m, s], spread[m, s] = np.nanmean(logs, axis=0), np.nanstd(logs, axis=0)
        z = (logs - mean[m, s]) / spread[m, s]
        quantiles[m, s] = np.quantile(np.nanmax(z, axis=1), 1 - np.array(RATES))
    return Calibration(mean, spread, quantiles)


def sensed(positions: Floats, sigma: float, rng: np.random.Generator) -> Floats:
    """Windows (B, T, 22, 3) as a sensor of error ``sigma`` (metres along an axis) sees them; half of it is slow."""
    count, _, joints, _ = positions.shape
    slow = rng.standard_normal((count, 1, joints, 3))
    return positions + sigma * np.sqrt(0.5) * (slow + rng.standard_normal(positions.shape))


def hide_joints(positions: Floats, count: int, rng: np.random.Generator) -> Floats:
    """Windows (B, T, 22, 3), each without ``count`` joints, at random."""
    hidden = rng.permuted(np.tile(np.arange(22) < count, (len(positions), 1)), axis=1)
    return np.where(hidden[:, None, :, None], np.nan, positions)


@torch.no_grad()
def score_windows(model: HGVAE, seen: Floats, sizes: Floats) -> Floats:
    """(B, 22) log deviations of windows (B, T, 22, 3) of bodies of sizes (B,)."""
    logs = []
    for start in range(0, len(seen), 256):
        part = slice(start, start + 256)
        tracks = [to_tracks(window, size) for window, size in zip(seen[part], sizes[part], strict=True)]
        x, observed = np.stack([t.x for t in tracks]), np.stack([t.observed for t in tracks])
        found = model(standardise(model, x), torch.from_numpy(observed).float()).tracks
        mean = found.mean.double().numpy() * SCALE + model.mean.double().numpy()[:, None]
        sigma = (0.5 * found.log_var).exp().double().numpy() * SCALE
        logs.append(deviations(x, mean, sigma, observed))
    return np.concatenate(logs)


def window_oddity(logs: Floats, calibration: Calibration) -> Floats:
    """(B,) the score of windows from their log deviations (B, 22), on the z-scale of their oddest joint."""
    return oddities(logs, calibration, np.isnan(logs).sum(axis=-1)).max(axis=-1)
