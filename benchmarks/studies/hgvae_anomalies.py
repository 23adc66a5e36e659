"""HG-VAE: faults found, and false alarms among people and motion that the scale is not of."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from matplotlib import color_sequences
from matplotlib.figure import Figure
from sklearn.metrics import roc_auc_score, roc_curve

from steadypose.benchmarks.bench import Bench, Result
from steadypose.benchmarks.results import Table
from steadypose.benchmarks.studies.hgvae_common import Data
from steadypose.benchmarks.studies.hgvae_faults import FAULTS, HELD, held
from steadypose.prior.arrays import Floats
from steadypose.prior.models.hgvae.faults import Calibration, decimals
from steadypose.prior.models.hgvae.features import to_tracks
from steadypose.training.data.corruption import with_sensor_error
from steadypose.training.data.dataset import MotionSet
from steadypose.training.data.hgvae_windows import Windows, standardise
from steadypose.training.networks.graph import FaultNet, load_fault_net
from steadypose.training.networks.hgvae import HGVAE
from steadypose.training.recipes.hgvae_faults import Scored, score_windows

SENSORS = {"motion capture, 3 mm": 0.003, "camera, 20 mm": 0.02}
RATES = (0.05, 0.01)


def anomalies(bench: Bench, model: HGVAE, data: Data) -> Result:
    """AUROC of every fault, by our score and the paper's, and false alarms among people not calibrated on."""
    count = 64 if bench.quick else 600
    rng = np.random.default_rng(11)
    windows, network = Windows(data.val), load_fault_net("default")
    frames = model.config.frames
    records: list[dict[str, Any]] = []
    figure = Figure(figsize=(9.5, 5.6), layout="constrained")
    for axis, (sensor, sigma) in zip(figure.subplots(1, 2, sharey=True), SENSORS.items(), strict=True):
        clean, sizes = windows.draw(count, frames, rng)
        quiet = score_windows(network, model, with_sensor_error(clean, sigma, rng), sizes, sigma).odds.max(axis=1)
        plain = -_paper_score(model, with_sensor_error(clean, sigma, rng), sizes)
        other, other_sizes = windows.draw(count, frames, rng)
        for name, fault in FAULTS.items():
            if name == HELD:
                seen, holds = held(with_sensor_error(other, sigma, rng), other, rng)
            else:
                spoilt, holds = fault(other, rng)
                seen = with_sensor_error(spoilt, sigma, rng)
            seen = seen[holds]
            loud = score_windows(network, model, seen, other_sizes[holds], sigma).odds.max(axis=1)
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


def _false_alarms(bench: Bench, network: FaultNet, model: HGVAE, data: Data) -> list[dict[str, Any]]:
    """Of clean windows: of each validation person by a scale of the others, and of kinds of motion never seen."""
    sigma, count = SENSORS["camera, 20 mm"], 128 if bench.quick else 4000

    def scored(motion: MotionSet, windows: int) -> Scored:
        rng = np.random.default_rng(13)
        positions, sizes = Windows(motion).draw(windows, model.config.frames, rng)
        return score_windows(network, model, with_sensor_error(positions, sigma, rng), sizes, sigma)

    people = {str(person): data.val.only(data.val.subject == person) for person in np.unique(data.val.subject)}
    found = {p: scored(m, max(round(count * m.hours / data.val.hours), 8)).odds.max(axis=1) for p, m in people.items()}
    records: list[dict[str, Any]] = []
    for person, own in found.items():
        others = [of for other, of in found.items() if other != person] or [own]
        limits = np.quantile(np.concatenate(others), 1 - np.array(RATES))
        records.append({"people": person, "windows": len(own)} | _above(own[:, None], limits))
    total = sum(r["windows"] for r in records)
    mean = {f"at_{rate:g}": sum(r["windows"] * r[f"at_{rate:g}"] for r in records) / total for rate in RATES}
    records.insert(0, {"people": "all validation people, each by a scale of the others", "windows": total} | mean)
    if data.prepared:
        everything = MotionSet.load(data.prepared, "research", "val")
        known = np.isin(everything.subject, data.val.subject)
        if not known.all():
            odds, paces = scored(everything.only(~known), count)
            ones = np.ones(len(paces))
            scale = Calibration.load("default").limits(np.zeros(len(paces), dtype=int), sigma * ones, paces)
            anomaly = decimals(odds.max(axis=1)[:, None], scale)
            records.append(
                {"people": "kinds of motion never seen (Bandai-Namco)", "windows": count}
                | _above(anomaly, -np.log10(RATES))
            )
    return records


def _above(scores: Floats, limits: Floats) -> dict[str, float]:
    """The share of ``scores`` (B, 1) above each of ``limits``, one for each of `RATES`."""
    return {f"at_{rate:g}": float((scores > limit).mean()) for rate, limit in zip(RATES, limits, strict=True)}
