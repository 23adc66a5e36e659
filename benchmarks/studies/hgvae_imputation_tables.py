"""HG-VAE: tables of imputation and prediction."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from cycler import cycler
from matplotlib import color_sequences
from matplotlib.figure import Figure

from steadypose.benchmarks.bench import Bench, Result
from steadypose.benchmarks.results import Table
from steadypose.benchmarks.studies import hgvae_imputation as imputation
from steadypose.benchmarks.studies.hgvae_common import NAMES, Data
from steadypose.prior.models.hgvae.config import SCALE
from steadypose.training.data.hgvae_windows import Windows, standardise
from steadypose.training.networks.hgvae import HGVAE


def sweep(bench: Bench, found: dict[str, HGVAE], data: Data) -> Result:
    """Squared error of imputation, every method, every degree of occlusion."""
    windows = Windows(data.val)
    records: list[dict[str, Any]] = []
    for name, model in found.items():
        first = name == "default"
        for condition, hide in bench.progress.track(
            list(imputation.CONDITIONS.items()), description=f"imputation, {NAMES[name]}"
        ):
            # which joint is hidden matters more than how: a hundred windows are too few to tell
            whole = "whole" in condition
            count = 4 if bench.quick else 512 if whole else 96
            steps = (3,) if bench.quick else (10, 100) if first and not whole else (10,)
            rng = np.random.default_rng(17)
            positions, sizes = windows.draw(count, model.config.frames, rng)
            masks = np.stack([hide((66, model.config.frames), rng) for _ in range(count)])
            answers = imputation.impute_all(model, positions, sizes, masks, steps)
            for method, (x, truth) in answers.items():
                shown = method if first or not method.startswith("HG-VAE") else f"{method}, {NAMES[name]}"
                if not first and shown == method:
                    continue  # what needs no model stands there already
                mse = float(((x - truth)[masks] ** 2).mean()) * 1e6
                records.append({"method": shown, "condition": condition, "windows": count, "mse_mm2": mse})
    by = {(r["method"], r["condition"]): r["mse_mm2"] for r in records}
    methods = list(dict.fromkeys(r["method"] for r in records))
    conditions = list(imputation.CONDITIONS)
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
        shares.plot(
            [100 * s for s in imputation.FEATURES],
            [by[method, f"{100 * s:g} % of entries"] ** 0.5 for s in imputation.FEATURES],
            "o-",
            ms=3,
            label=method,
        )
        bursts.plot(imputation.BURSTS_S, [by[method, f"a limb for {s:g} s"] ** 0.5 for s in imputation.BURSTS_S],
                    "o-", ms=3)  # fmt: skip
    shares.set(xscale="log", yscale="log", xlabel="entries hidden, %", ylabel="error, mm RMS")
    bursts.set(yscale="log", xlabel="a limb hidden for, s")
    figure.legend(*shares.get_legend_handles_labels(), loc="outside lower center", ncol=3, fontsize=7, frameon=False)
    for axis in (shares, bursts):
        axis.grid(alpha=0.3)
    return Result([table], {"imputation": records}, {"hgvae_imputation": figure})


FOUR_JOINTS_DRAWS = 8
"""of four joints of each window; of one joint, each has its turn"""


def whole_joints(bench: Bench, found: dict[str, HGVAE], data: Data) -> Result:
    """Whole joints hidden in every window of the validation people, one after the other, and by person."""
    motion, windows = data.val, Windows(data.val)
    people = motion.subject if len(motion.subject) else np.full(len(motion.clip_start) - 1, "all")
    records: list[dict[str, Any]] = []
    for name, model in found.items():
        frames = model.config.frames
        rows = motion.all_windows(frames, frames)[:: 40 if bench.quick else 1]
        person = people[np.searchsorted(motion.clip_start, rows[:, 0], side="right") - 1]
        positions, sizes = windows.clean(rows, np.zeros(len(rows), dtype=bool))
        rng = np.random.default_rng(0)
        for count, draws in ((1, 21), (4, FOUR_JOINTS_DRAWS)):
            sums: dict[tuple[str, str], float] = {}
            for draw in bench.progress.track(range(draws), description=f"{count} whole joints, {NAMES[name]}"):
                hidden = np.zeros((len(rows), 22), dtype=bool)
                if count == 1:
                    hidden[:, 1 + draw] = True
                else:
                    hidden[:, 1:] = rng.permuted(np.tile(np.arange(21) < count, (len(rows), 1)), axis=1)
                for method, errors in imputation.whole_joints(model, positions, sizes, hidden).items():
                    for who in np.unique(person):
                        key = method, str(who)
                        sums[key] = sums.get(key, 0.0) + float(errors[person == who].sum())
            entries = 3 * frames * count * draws
            for method, who in sums:
                entry = {"weights": NAMES[name], "joints": count, "method": method, "person": who}
                windows_of = int((person == who).sum())
                records.append({**entry, "windows": windows_of, "mse_mm2": sums[method, who] / (entries * windows_of)})
    rows_told = []
    for weights, count, method in dict.fromkeys((r["weights"], r["joints"], r["method"]) for r in records):
        own, mean = ([r for r in records if (r["weights"], r["joints"], r["method"]) == (weights, count, m)]
                     for m in (method, "mean"))  # fmt: skip
        if weights != NAMES["default"] and method in ("mean", "guess"):
            continue  # what needs no model stands there already
        total, of_mean = (sum(r["mse_mm2"] * r["windows"] for r in part) for part in (own, mean))
        by_person = [100 * (a["mse_mm2"] / b["mse_mm2"] - 1) for a, b in zip(own, mean, strict=True)]
        rows_told.append([
            f"{count}", method if weights == NAMES["default"] else f"{method}, {weights}",
            f"{(total / sum(r['windows'] for r in own)) ** 0.5:.1f}", f"{100 * (total / of_mean - 1):.1f} %",
            f"{max(by_person):.0f} to {min(by_person):.0f} %",
        ])  # fmt: skip
    count = sum(r["windows"] for r in records if r["method"] == "mean" and r["joints"] == 1) // len(found)
    table = Table(
        "hgvae-joints", "HG-VAE: whole joints hidden in every window of the validation people",
        ["joints hidden", "method", "mm RMS", "squared error against the mean's", "by person"], rows_told,
        f"All {count} windows of 50 frames, one after the other, as they were recorded; one joint: each of 21 in its "
        f"turn; four: {FOUR_JOINTS_DRAWS} draws a window. In one pass, without ascent.",
    )  # fmt: skip
    return Result([table], {"whole_joints": records})


@torch.no_grad()
def _predicted_mm(predictor: imputation.Predictor, x: torch.Tensor, future: torch.Tensor) -> float:
    off = (predictor(x) - future).unflatten(1, (22, 3)).norm(dim=2)[:, 1:]
    return float(off.mean()) * SCALE * 1000


def prediction(bench: Bench, model: HGVAE, data: Data) -> Result:
    """A predictor fed with imputed windows (figure 5)."""
    frames, count = model.config.frames, 16 if bench.quick else 96
    predictor = imputation.train_predictor(Windows(data.train), frames, 20 if bench.quick else 1500, model)
    x, future, positions, sizes = imputation.predictor_pair(
        Windows(data.val), frames, count, np.random.default_rng(19), model
    )
    clean = _predicted_mm(predictor, x, future)
    records: list[dict[str, Any]] = []
    for share in (0.01, 0.1, 0.3, 0.5):
        rng = np.random.default_rng(23)
        masks = np.stack([imputation.some_features((66, frames), rng, share) for _ in range(count)])
        # and a limb for the last half second: up to the present, where prediction starts
        for mask in masks:
            mask[:, -15:] |= imputation.a_limb((66, frames), rng, 0.5).any(axis=1, keepdims=True)
        answers = imputation.impute_all(model, positions, sizes, masks, (10,))
        for method, (imputed, _) in answers.items():
            filled = standardise(model, imputed)
            records.append({"hidden": share, "method": method, "mm": _predicted_mm(predictor, filled, future)})
    methods = list(dict.fromkeys(r["method"] for r in records))
    by = {(r["method"], r["hidden"]): r["mm"] for r in records}
    table = Table(
        "hgvae-prediction", "HG-VAE: error of a predictor of the next half second, fed with imputed windows, mm",
        ["method", *(f"{100 * s:g} %" for s in (0.01, 0.1, 0.3, 0.5))],
        [[m, *(f"{by[m, s]:.1f}" for s in (0.01, 0.1, 0.3, 0.5))] for m in methods],
        f"Entries hidden at random, and a limb for the last half second. With nothing hidden: {clean:.1f} mm. Mean "
        "over 21 joints about the trunk's path and 15 frames.",
    )  # fmt: skip
    return Result([table], {"prediction": {"clean_mm": clean, "records": records}})
