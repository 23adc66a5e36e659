"""All that the HG-VAE paper does, on our data: likelihood and depth, anomalies, imputation, actions.

Windows of 50 frames of validation people. Nothing here is comparable with the paper's figures, which are on AMASS.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cycler import cycler
from matplotlib import color_sequences
from matplotlib.figure import Figure
from numpy.typing import NDArray
from sklearn.decomposition import PCA
from sklearn.metrics import roc_auc_score, roc_curve
from sklearn.neighbors import KNeighborsClassifier

from steadypose.benchmarks.bench import Bench, Result
from steadypose.benchmarks.hgvae import imputation, models
from steadypose.benchmarks.hgvae.faults import FAULTS, HELD, held
from steadypose.benchmarks.machine import ROOT
from steadypose.benchmarks.motion import as_set, digest
from steadypose.benchmarks.results import Table
from steadypose.msgs.types import JOINTS
from steadypose.prior.body.skeleton import PARENTS
from steadypose.prior.models.hgvae.anomaly import RATES as QUANTILES
from steadypose.prior.models.hgvae.anomaly import Calibration
from steadypose.prior.models.hgvae.config import SCALE, HGVAEConfig
from steadypose.prior.models.hgvae.faults import FaultNet, load_fault_net
from steadypose.prior.models.hgvae.features import to_tracks
from steadypose.prior.models.hgvae.network import HGVAE
from steadypose.prior.models.hgvae.train import evidence
from steadypose.prior.models.hgvae.train_faults import score_windows
from steadypose.prior.models.hgvae.windows import Batch, Windows, standardise
from steadypose.prior.models.torch_weights import load_network
from steadypose.prior.models.weights_io import WEIGHTS
from steadypose.prior.motion.corruption import sensed
from steadypose.prior.motion.dataset import MotionSet

Floats = NDArray[np.float64]

SENSORS = {"motion capture, 3 mm": 0.003, "camera, 20 mm": 0.02}
RATES = (0.05, 0.01)
"""Of false alarms asked for."""
NAMES = {"default": "live", "wide-default": "wide (256 features)", "research": "live, research weights"}


def run(bench: Bench) -> Result:
    """All tables and pictures; models for the tables are trained on the way, or found in ``runs``."""
    found = {name: model for name in NAMES if (model := _model(name)) is not None}
    data = _Data(bench)
    results = [
        _likelihood(bench, found, data),
        _anomalies(bench, found["default"], data),
        _sweep(bench, found, data),
        _whole_joints(bench, found, data),
        _prediction(bench, found["default"], data),
        _depth(bench, data),
        _actions(bench, data),
    ]
    return Result(
        [table for result in results for table in result.tables],
        {"data": data.source} | {key: value for result in results for key, value in result.data.items()},
        {name: figure for result in results for name, figure in result.figures.items()},
    )


class _Data:
    """Training and validation windows, of prepared motion or of the project's own people."""

    def __init__(self, bench: Bench) -> None:
        self.prepared = bench.data if bench.data.is_file() else None
        if self.prepared:
            self.train, self.val = (MotionSet.load(self.prepared, "default", s) for s in ("train", "val"))
            self.source: dict[str, Any] = {"file": self.prepared.name, "sha256": digest(self.prepared)}
        else:
            self.train, self.val = as_set(bench.training_clips()), as_set(bench.clips(90, 60))
            self.source = {"simulated people": True}
        self._kept = tempfile.TemporaryDirectory()

    def runs(self, bench: Bench) -> Path:
        """Where models trained for tables are kept; a quick run's are not."""
        if bench.quick or not self.prepared:
            return Path(self._kept.name)
        return ROOT / "runs" / f"hgvae-tables-{self.source['sha256']}"


def _model(name: str) -> HGVAE | None:
    if not (WEIGHTS / f"hgvae-{name}.safetensors").is_file():
        return None
    return load_network(HGVAE, HGVAEConfig.from_dict, name, "hgvae")


@torch.no_grad()
def _elbo(model: HGVAE, windows: Windows, count: int) -> dict[str, float]:
    positions, sizes = windows.draw(count, model.config.frames, np.random.default_rng(7))
    torch.manual_seed(7)
    parts = []
    for start in range(0, count, 128):
        part = slice(start, start + 128)
        whole = Batch.of(model, positions[part], positions[part], sizes[part])
        likelihood, kl = evidence(model(whole.x, whole.believed, spread=torch.ones(len(whole.x), 1)), whole.target)
        off = (model(whole.x, whole.believed).tracks.mean - whole.target) * SCALE * 1000
        parts.append(torch.stack([likelihood, kl, off.square().mean(dim=(1, 2))], dim=1))
    likelihood, kl, square = torch.cat(parts).mean(dim=0).tolist()
    return {"log_likelihood": likelihood, "kl": kl, "elbo": likelihood - kl, "mse_mm2": square}


def _likelihood(bench: Bench, found: dict[str, HGVAE], data: _Data) -> Result:
    windows = Windows(data.val)
    records = [
        {"model": NAMES[name], "parameters": sum(p.numel() for p in model.parameters()),
         **_elbo(model, windows, 64 if bench.quick else 1024)}
        for name, model in found.items()
    ]  # fmt: skip
    table = Table(
        "hgvae-likelihood", "HG-VAE: likelihood of clean windows of unseen people",
        ["model", "parameters", "log p(x|z), nats", "KL, nats", "ELBO, nats", "reconstruction, mm RMS"],
        [[r["model"], f"{r['parameters'] / 1e6:.2f} M", f"{r['log_likelihood']:.0f}", f"{r['kl']:.0f}",
          f"{r['elbo']:.0f}", f"{r['mse_mm2'] ** 0.5:.1f}"] for r in records],
        "50 frames, 22 joints, 3,300 entries a window in metres; latents drawn once.",
    )  # fmt: skip
    return Result([table], {"likelihood": records})


def _anomalies(bench: Bench, model: HGVAE, data: _Data) -> Result:
    """AUROC of every fault, by our score and the paper's, and false alarms among people not calibrated on."""
    count = 64 if bench.quick else 600
    rng = np.random.default_rng(11)
    windows, network = Windows(data.val), load_fault_net("default")
    frames = model.config.frames
    records: list[dict[str, Any]] = []
    figure = Figure(figsize=(9.5, 5.6), layout="constrained")
    for axis, (sensor, sigma) in zip(figure.subplots(1, 2, sharey=True), SENSORS.items(), strict=True):
        clean, sizes = windows.draw(count, frames, rng)
        quiet = score_windows(network, model, sensed(clean, sigma, rng), sizes, sigma).max(axis=1)
        plain = -_paper_score(model, sensed(clean, sigma, rng), sizes)
        other, other_sizes = windows.draw(count, frames, rng)
        for name, fault in FAULTS.items():
            if name == HELD:
                seen, holds = held(sensed(other, sigma, rng), other, rng)
            else:
                spoilt, holds = fault(other, rng)
                seen = sensed(spoilt, sigma, rng)
            seen = seen[holds]
            loud = score_windows(network, model, seen, other_sizes[holds], sigma).max(axis=1)
            paper = -_paper_score(model, seen, other_sizes[holds])
            truth = np.r_[np.zeros(count), np.ones(len(loud))]
            record = {"fault": name, "sensor": sensor, "windows": len(loud),
                      "auroc": float(roc_auc_score(truth, np.r_[quiet, loud])),
                      "auroc_paper": float(roc_auc_score(truth, np.r_[plain, paper]))}  # fmt: skip
            records.append(record)
            false, true, _ = roc_curve(truth, np.r_[quiet, loud])
            colour = color_sequences["tab20"][list(FAULTS).index(name)]
            axis.plot(np.maximum(false, 1 / count), true, lw=1.4, color=colour, label=f"{name}: {record['auroc']:.3f}")
        axis.set(xscale="log", xlabel="false alarms", title=sensor)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncol=2, frameon=False)
    figure.axes[0].set_ylabel("found")
    alarms = _false_alarms(bench, network, model, data)
    first, second = SENSORS
    by = {(r["fault"], r["sensor"]): r for r in records}
    tables = [
        Table(
            "hgvae-anomaly", "HG-VAE: area under the ROC curve, by fault",
            ["fault", f"ours, {first}", f"ours, {second}", f"log p(z given x), {first}", f"log p(z given x), {second}"],
            [[name, *(f"{by[name, s]['auroc']:.3f}" for s in SENSORS),
              *(f"{by[name, s]['auroc_paper']:.3f}" for s in SENSORS)] for name in FAULTS],
            f"{count} clean windows of validation people against as many spoilt ones, both as a sensor of that error "
            "sees them; a joint counts as frozen, and a limb as exchanged, only where it is 10 cm off then. A frozen "
            "joint repeats what was last seen; one at rest stays where it was, under the sensor's noise. Last two "
            "columns: the paper's score.",
        ),
        Table(
            "hgvae-false-alarms", "HG-VAE: windows of clean motion flagged",
            ["people and motion", "windows", *(f"asked for {100 * r:g} %" for r in RATES)],
            [[r["people"], str(r["windows"]), *(f"{100 * r[f'at_{rate:g}']:.1f} %" for rate in RATES)] for r in alarms],
            "Seen by a camera of 20 mm. First row: the mean of those below, weighted by how much there is of each; the "
            "networks have seen none of them. Bandai-Namco's people act in styles; by the scale that ships.",
        ),
    ]  # fmt: skip
    return Result(tables, {"anomalies": records, "false_alarms": alarms}, {"hgvae_roc": figure})


@torch.no_grad()
def _paper_score(model: HGVAE, seen: Floats, sizes: Floats) -> Floats:
    """(B,) log p(m) of the posterior's means, all levels."""
    scores = []
    for start in range(0, len(seen), 256):
        rows = zip(seen[start : start + 256], sizes[start : start + 256], strict=True)
        x = standardise(model, np.stack([to_tracks(window, size).x for window, size in rows]))
        scores.append(model(x, torch.ones_like(x)).log_prior.sum(dim=1).double().numpy())
    return np.concatenate(scores)


def _false_alarms(bench: Bench, network: FaultNet, model: HGVAE, data: _Data) -> list[dict[str, Any]]:
    """Of clean windows: of each validation person by a scale of the others, and of kinds of motion never seen."""
    sigma, count = SENSORS["camera, 20 mm"], 128 if bench.quick else 4000

    def scores(motion: MotionSet, windows: int) -> Floats:
        rng = np.random.default_rng(13)
        positions, sizes = Windows(motion).draw(windows, model.config.frames, rng)
        return score_windows(network, model, sensed(positions, sigma, rng), sizes, sigma).max(axis=1)

    people = {str(person): data.val.only(data.val.subject == person) for person in np.unique(data.val.subject)}
    found = {p: scores(m, max(round(count * m.hours / data.val.hours), 8)) for p, m in people.items()}
    records: list[dict[str, Any]] = []
    for person, own in found.items():
        others = [of for other, of in found.items() if other != person] or [own]
        limits = np.quantile(np.concatenate(others), 1 - np.array(RATES))
        records.append({"people": person, "windows": len(own)} | _above(own, limits))
    total = sum(r["windows"] for r in records)
    mean = {f"at_{rate:g}": sum(r["windows"] * r[f"at_{rate:g}"] for r in records) / total for rate in RATES}
    records.insert(0, {"people": "all validation people, each by a scale of the others", "windows": total} | mean)
    if data.prepared:
        everything = MotionSet.load(data.prepared, "research", "val")
        known = np.isin(everything.subject, data.val.subject)
        if not known.all():
            scale = Calibration.load("default").at(sigma).quantiles[0]
            limits = np.interp(-np.log10(RATES), -np.log10(QUANTILES), scale)
            odds = scores(everything.only(~known), count)
            records.append(
                {"people": "kinds of motion never seen (Bandai-Namco)", "windows": count} | _above(odds, limits)
            )
    return records


def _above(scores: Floats, limits: Floats) -> dict[str, float]:
    return {f"at_{rate:g}": float((scores > limit).mean()) for rate, limit in zip(RATES, limits, strict=True)}


def _sweep(bench: Bench, found: dict[str, HGVAE], data: _Data) -> Result:
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


def _whole_joints(bench: Bench, found: dict[str, HGVAE], data: _Data) -> Result:
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
                        told = method, str(who)
                        sums[told] = sums.get(told, 0.0) + float(errors[person == who].sum())
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


def _prediction(bench: Bench, model: HGVAE, data: _Data) -> Result:
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


def _depth(bench: Bench, data: _Data) -> Result:
    """Table 1: stochastic depth at equal capacity."""
    steps = 2 if bench.quick else 1000
    records = []
    for depth in models.DEPTHS:
        bench.progress.stop()  # training draws a bar of its own
        directory = data.runs(bench) / f"depth-{depth}"
        model = models.train(models.of_depth(depth), Windows(data.train), directory, steps, rate=models.DEPTH_RATE)
        bench.progress.start()
        records.append({"depth": depth, "parameters": sum(p.numel() for p in model.parameters()),
                        **_elbo(model, Windows(data.val), 64 if bench.quick else 512)})  # fmt: skip
    table = Table(
        "hgvae-depth", "HG-VAE: stochastic depth at equal capacity (table 1)",
        ["parameters", "depth", "log p(x|z), nats", "MSE, mm²", "KL, nats", "ELBO, nats"],
        [[f"{r['parameters'] / 1e6:.2f} M", str(r["depth"]), f"{r['log_likelihood']:.0f}", f"{r['mse_mm2']:.1f}",
          f"{r['kl']:.0f}", f"{r['elbo']:.0f}"] for r in records],
        "The same 16 levels, four to each of the paper's graphs; those above the lowest so many stay at their prior's "
        f"mean. {steps} steps of 32 windows "
        "each, where the paper trains a week.",
    )  # fmt: skip
    return Result([table], {"depth": {"steps": steps, "records": records}})


def _actions(bench: Bench, data: _Data) -> Result:
    """Generation conditioned on actions (figure 3), level by level (figure 6), and the top latent by action (9)."""
    if data.prepared is None:
        return Result([], {"actions": "left out: the project's own people have no named actions"})
    motion = MotionSet.load(data.prepared, "research", "train")
    counts = Counter(models.action_name(action) for action in motion.action)
    frames = {
        name: int(np.diff(motion.clip_start)[np.array([models.action_name(a) == name for a in motion.action])].sum())
        for name in counts
    }
    names = sorted(sorted((n for n in counts if n and not n.startswith("m")), key=lambda n: -frames[n])[:10])
    steps = 2 if bench.quick else 1_500
    windows = models.ActionWindows(motion, names)
    bench.progress.stop()
    config = models.with_actions(len(names))
    model = models.train(config, windows, data.runs(bench) / "generation", steps, least_sigma=models.LEAST_SIGMA)
    in_levels = models.train(
        models.of_levels(), Windows(data.train), data.runs(bench) / "levels", 2 if bench.quick else 1_200,
        least_sigma=models.LEAST_SIGMA,
    )  # fmt: skip
    bench.progress.start()
    rng = np.random.default_rng(29)
    real, actions = _encodable(model, windows, 100 if bench.quick else 2000, rng)
    with torch.no_grad():
        top = torch.cat([
            model(x, torch.ones_like(x), action=models.one_hot(kind, len(names))).top
            for x, kind in zip(real.split(250), np.array_split(actions, range(250, len(actions), 250)), strict=True)
        ]).double().numpy()  # fmt: skip
        wanted = np.repeat(np.arange(len(names)), 4 if bench.quick else 40)
        asked = models.one_hot(wanted, len(names))
        made = model.generate(len(wanted), top=models.draw_tops(top, actions, wanted, seed=0), action=asked).mean
        torch.manual_seed(0)
        by_prior = model.generate(len(wanted), action=asked).mean
    judge = KNeighborsClassifier(5).fit(_features(model, real), actions)
    fresh, of_fresh = _encodable(model, windows, 100 if bench.quick else 600, rng)
    ceiling = judge.score(_features(model, fresh), of_fresh)
    half = len(top) // 2
    told = KNeighborsClassifier(5).fit(top[:half], actions[:half]).score(top[half:], actions[half:])
    hit = judge.predict(_features(model, made)) == wanted
    plain = judge.score(_features(model, by_prior), wanted)
    record = {
        "actions": names, "steps": steps, "judge_on_real": float(ceiling), "generated_as_asked": float(hit.mean()),
        "by_action": {name: float(hit[wanted == k].mean()) for k, name in enumerate(names)},
        "top_from_the_prior": float(plain), "top_latent_tells_action": float(told), "chance": 1 / len(names),
    }  # fmt: skip
    table = Table(
        "hgvae-actions", "HG-VAE: motion generated by action",
        ["action", "generated motion taken for it"],
        [*([name, f"{100 * share:.0f} %"] for name, share in record["by_action"].items()),
         ["all", f"{100 * record['generated_as_asked']:.0f} %"]],
        "The top latent is drawn from the Gaussian of the action's windows, the one-hot beside it. Judged by the five "
        f"nearest real windows; on other real windows that is right in {100 * ceiling:.0f} %, by chance in "
        f"{100 / len(names):.0f} %. With the top latent from N(0, I) it is {100 * plain:.0f} %. The top latent alone "
        f"tells the action in {100 * told:.0f} %. {steps} steps on CMU and Bandai-Namco (CC BY-NC): a model of one "
        "level, for this table, which does not ship.",
    )  # fmt: skip
    first = np.searchsorted(wanted, np.arange(len(names)))
    return Result([table], {"actions": record}, {
        "hgvae_actions": _strips(model, made[first], names), "hgvae_levels": _draw_levels(in_levels),
        "hgvae_top": _draw_top(top[:600], actions[:600], names),
    })  # fmt: skip


def _encodable(
    model: HGVAE, windows: models.ActionWindows, count: int, rng: np.random.Generator
) -> tuple[torch.Tensor, NDArray[np.intp]]:
    """(B, 66, T) windows as the model takes them, and the numbers of their actions."""
    positions, sizes, actions = windows.draw_actions(count, model.config.frames, rng)
    return standardise(model, to_tracks(positions, sizes).x), actions


def _features(model: HGVAE, x: torch.Tensor) -> Floats:
    """Lowest cosines of every track but the pelvis's, for telling actions apart."""
    return (x[:, 3:] @ model.dct[:8].T).flatten(1).numpy()


@torch.no_grad()
def _draw_levels(model: HGVAE) -> Figure:
    """One sample with more and more levels drawn (figure 6)."""
    strips = []
    for levels in range(len(model.config.levels) + 1):
        torch.manual_seed(5)
        strips.append(model.generate(1, random_levels=levels).mean)
    return _strips(model, torch.cat(strips), [f"levels drawn: {levels}" for levels in range(len(strips))])


def _strips(model: HGVAE, x: torch.Tensor, labels: list[str]) -> Figure:
    """A row for each window (B, 66, T): the body every seventh frame, seen from in front and a little from the side."""
    joints = (x * SCALE + model.mean[:, None]).unflatten(1, (22, 3)).permute(0, 3, 1, 2).numpy().copy()
    joints[:, :, 0] = 0.0  # the pelvis's track has another origin: it stands near the path
    figure = Figure(figsize=(9.5, 1.15 * len(labels)), layout="constrained")
    for axis, label, window in zip(figure.subplots(len(labels), 1, squeeze=False)[:, 0], labels, joints, strict=True):
        for place, frame in enumerate(range(0, len(window), 7)):
            across = window[frame, :, 1] * 0.8 + window[frame, :, 0] * 0.6 + 1.1 * place
            for joint, parent in enumerate(PARENTS[1:], start=1):
                colour = "#2a7fba" if _side(joint) == "left" else "#b5482a" if _side(joint) == "right" else "#444444"
                axis.plot(across[[joint, parent]], window[frame, [joint, parent], 2], color=colour, lw=1.3)
        axis.set(aspect="equal", xticks=[], yticks=[])
        axis.set_ylabel(label, rotation=0, ha="right", va="center", fontsize=7)
        for spine in axis.spines.values():
            spine.set_visible(False)
    return figure


def _side(joint: int) -> str:
    return JOINTS[joint].split("_")[0]


def _draw_top(top: Floats, actions: NDArray[np.intp], names: list[str]) -> Figure:
    """The top latent of real windows on its two widest axes (figure 9)."""
    flat = PCA(2).fit_transform(top)
    figure = Figure(figsize=(6.4, 4.6), layout="constrained")
    axis = figure.subplots()
    for k, name in enumerate(names):
        axis.scatter(*flat[actions == k].T, s=9, label=name, color=f"C{k}")
    axis.set(xlabel="first principal axis of the top latent", ylabel="second")
    axis.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure
