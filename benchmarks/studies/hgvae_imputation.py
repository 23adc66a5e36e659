"""HG-VAE's occlusion sweep (figure 4), and whole joints hidden in every window.

Single entries, whole joints, or a limb for a time are hidden; every method gets the same windows. "mean" is the
training mean of each track, "hold" the last observation, "line" linear interpolation in time, "guess" interpolation
relative to the parent, "completion" the completion network's output, from which HG-VAE starts. The paper ascends log
p(z | x) in the missing entries.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import torch
from cycler import cycler
from matplotlib import color_sequences
from matplotlib.figure import Figure
from numpy.typing import NDArray

from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.corruption import LIMBS
from steadypose.benchmarks.results import Result, Table
from steadypose.prior.arrays import Floats
from steadypose.prior.clean.impute import completed_tracks
from steadypose.prior.models.hgvae.config import SCALE
from steadypose.prior.models.hgvae.features import Tracks, from_tracks, in_frame_of, to_tracks
from steadypose.prior.models.hgvae.inference import LiveHGVAE
from steadypose.training.data.dataset import MotionSet
from steadypose.training.data.hgvae_windows import Batch, Windows, standardise
from steadypose.training.networks.hgvae import HGVAE
from steadypose.training.weights import arrays_of

Mask = NDArray[np.bool_]

FEATURES = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 0.5)  # shares of all 3,300 entries that are hidden
BURSTS_S = (0.1, 0.3, 0.5, 1.0)

PAPER_RATE = 0.01  # Adam's learning rate for the entries, metres: the best on windows of training
BIAS_SIGMA = 0.0  # bias of the sensor, metres; the windows are clean


def some_features(shape: tuple[int, int], rng: np.random.Generator, share: float) -> Mask:
    """Hide entries (66, T) independently."""
    return rng.random(shape) < share


def some_joints(shape: tuple[int, int], rng: np.random.Generator, count: int) -> Mask:
    """Hide whole joints (66, T) throughout the window."""
    hidden = np.zeros(shape, dtype=bool)
    hidden.reshape(22, 3, -1)[1 + rng.choice(21, count, replace=False)] = True
    return hidden


def a_limb(shape: tuple[int, int], rng: np.random.Generator, seconds: float) -> Mask:
    """Hide a lower arm or leg (66, T) for some time, somewhere in the window."""
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
    """Run every method over complete windows (B, T, 22, 3) metres of bodies of these sizes (B,), with the entries
    ``masks`` (B, 66, T) hidden; ``steps`` are those of the paper's gradient ascent.

    Returns, by method, (B, 66, T) tracks, and the truth in the same frame, metres of a standard body.
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
    one_pass = []
    for t, x, seen in zip(clean, guess, observed.astype(float), strict=True):
        mean = live.reconstruct(x[None], seen[None], np.array([BIAS_SIGMA])).mean[0]
        one_pass.append(completed_tracks(t._replace(x=x, observed=seen), mean))
    found["HG-VAE, one pass"] = np.stack(one_pass)
    for count in steps:
        found[f"HG-VAE, the paper's ascent, {count} steps"] = ascend_entries(model, line, observed, count)
    return {name: (np.where(masks, x, truth), truth) for name, x in found.items()}


@torch.no_grad()
def impute_whole_joints(model: HGVAE, positions: Floats, sizes: Floats, hidden: Mask) -> dict[str, Floats]:
    """Impute windows (B, T, 22, 3) whose joints ``hidden`` (B, 22) are never observed, by methods that need one pass.

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
    """Impute as in the paper: Adam maximises the score of section 7 over the entries of ``start`` (B, 66, T) metres
    that are not ``observed``, keeping each window's best.
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
    """Hold the last observation (66, T); before the first, hold the first; use the mean if there is none."""
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
    """Interpolate hidden joints as `to_tracks` does, in the frame of the clean window; single entries linearly."""
    joints = observed.reshape(22, 3, -1)
    if (joints != joints[:, :1]).any():
        return line
    seen = np.where(joints[:, 0].T[..., None], window, np.nan)
    tracks = to_tracks(seen, size)
    guessed = in_frame_of(clean, from_tracks(tracks.x, tracks, size), size)
    return np.where(observed, clean.x, guessed)  # NaN if never observed: the model uses the one above


def sweep(bench: Bench, model: HGVAE, motion: MotionSet) -> Result:
    windows = Windows(motion)
    records: list[dict[str, Any]] = []
    for condition, hide in bench.progress.track(CONDITIONS.items(), description="imputation", total=len(CONDITIONS)):
        # which joint is hidden matters more than how, and a hundred windows are too few to tell
        whole = "whole" in condition
        count = 4 if bench.quick else 512 if whole else 96
        rng = np.random.default_rng(17)
        positions, sizes = windows.draw(count, model.config.frames, rng)
        masks = np.stack([hide((66, model.config.frames), rng) for _ in range(count)])
        steps = (3,) if bench.quick else (10,) if whole else (10, 100)
        for method, (x, truth) in impute_all(model, positions, sizes, masks, steps).items():
            mse = float(((x - truth)[masks] ** 2).mean()) * 1e6
            records.append({"method": method, "condition": condition, "windows": count, "mse_mm2": mse})
    by = {(r["method"], r["condition"]): r["mse_mm2"] for r in records}
    methods = list(dict.fromkeys(r["method"] for r in records))
    conditions = list(CONDITIONS)
    table = Table(
        "hgvae-imputation", "HG-VAE: error of imputed entries, mm RMS (change of the squared error against the mean)",
        ["hidden", *methods],
        [[c, *(f"{by[m, c] ** 0.5:.1f} ({100 * (by[m, c] / by['mean', c] - 1):.0f} %)" if (m, c) in by else "–"
               for m in methods)] for c in conditions],
        "Clean windows of 50 frames of validation people; one coordinate's error, hidden entries only. 'guess' is the "
        "line beside the joint above, 'completion' what the network makes of it, from which HG-VAE starts; the paper's "
        "ascent moves the entries up log p(z|x).",
    )  # fmt: skip
    figure = Figure(figsize=(9.5, 4.8), layout="constrained")
    shares, bursts = figure.subplots(1, 2, subplot_kw={"prop_cycle": cycler(color=color_sequences["tab20"])})
    for method in methods:
        of_entries = [by[method, f"{100 * s:g} % of entries"] ** 0.5 for s in FEATURES]
        shares.plot([100 * s for s in FEATURES], of_entries, "o-", ms=3, label=method)
        bursts.plot(BURSTS_S, [by[method, f"a limb for {s:g} s"] ** 0.5 for s in BURSTS_S], "o-", ms=3)
    shares.set(xscale="log", yscale="log", xlabel="entries hidden, %", ylabel="error, mm RMS")
    bursts.set(yscale="log", xlabel="a limb hidden for, s")
    figure.legend(*shares.get_legend_handles_labels(), loc="outside lower center", ncol=3, fontsize=7, frameon=False)
    for axis in (shares, bursts):
        axis.grid(alpha=0.3)
    return Result([table], {"imputation": records}, {"hgvae_imputation": figure})


FOUR_JOINTS_DRAWS = 8
"""Number of draws of four joints in each window; single joints are each hidden in turn."""


def whole_joints(bench: Bench, model: HGVAE, motion: MotionSet) -> Result:
    """Measure whole joints hidden in every window of the validation people, one after the other, and by person."""
    people = motion.subject if len(motion.subject) else np.full(len(motion.clip_start) - 1, "all")
    frames = model.config.frames
    rows = motion.all_windows(frames, frames)[:: 40 if bench.quick else 1]
    person = people[np.searchsorted(motion.clip_start, rows[:, 0], side="right") - 1]
    positions, sizes = Windows(motion).clean(rows, np.zeros(len(rows), dtype=bool))
    rng = np.random.default_rng(0)
    records: list[dict[str, Any]] = []
    for count, draws in ((1, 21), (4, FOUR_JOINTS_DRAWS)):
        sums: dict[str, Floats] = {}
        for draw in bench.progress.track(range(draws), description=f"{count} whole joints"):
            hidden = np.zeros((len(rows), 22), dtype=bool)
            if count == 1:
                hidden[:, 1 + draw] = True
            else:
                hidden[:, 1:] = rng.permuted(np.tile(np.arange(21) < count, (len(rows), 1)), axis=1)
            for method, errors in impute_whole_joints(model, positions, sizes, hidden).items():
                sums[method] = sums.get(method, np.zeros(len(rows))) + errors
        for method, of_window in sums.items():
            mse = of_window / (3 * frames * count * draws)
            by_person = {str(who): float(mse[person == who].mean()) for who in np.unique(person)}
            records.append({"joints": count, "method": method, "mse_mm2": float(mse.mean()), "by_person": by_person})
    table = Table(
        "hgvae-joints", "HG-VAE: whole joints hidden in every window of the validation people",
        ["joints hidden", "method", "mm RMS", "squared error against the mean's", "by person"],
        [_against_mean(record, records) for record in records],
        f"All {len(rows)} windows of 50 frames, one after the other, as they were recorded; one joint: each of 21 in "
        f"its turn; four: {FOUR_JOINTS_DRAWS} draws a window. In one pass, without ascent.",
    )  # fmt: skip
    return Result([table], {"whole_joints": records, "windows": len(rows)})


def _against_mean(record: dict[str, Any], records: list[dict[str, Any]]) -> list[str]:
    mean = next(r for r in records if r["joints"] == record["joints"] and r["method"] == "mean")
    apart = [100 * (record["by_person"][who] / of_mean - 1) for who, of_mean in mean["by_person"].items()]
    return [
        str(record["joints"]), record["method"], f"{record['mse_mm2'] ** 0.5:.1f}",
        f"{100 * (record['mse_mm2'] / mean['mse_mm2'] - 1):.1f} %", f"{max(apart):.0f} to {min(apart):.0f} %",
    ]  # fmt: skip
