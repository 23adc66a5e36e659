"""HG-VAE's tables, as in its paper, on our data: likelihood, anomalies, imputation.

Windows are 50 frames of validation people. The figures are not comparable with the paper's, which are on AMASS.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from matplotlib import color_sequences
from matplotlib.figure import Figure
from sklearn.metrics import roc_auc_score, roc_curve

from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.corruption import FAULTS, HELD, held
from steadypose.benchmarks.motion import as_set, digest, prepared_set
from steadypose.benchmarks.results import Result, Table
from steadypose.benchmarks.studies.hgvae_imputation import sweep, whole_joints
from steadypose.prior.arrays import Floats
from steadypose.prior.fit.tensors import load_network
from steadypose.prior.models.hgvae.config import SCALE, HGVAEConfig
from steadypose.prior.models.hgvae.faults import Calibration, decimals
from steadypose.prior.models.hgvae.features import to_tracks
from steadypose.training.data.corruption import with_sensor_error
from steadypose.training.data.dataset import MotionSet
from steadypose.training.data.hgvae_windows import Batch, Windows, standardise
from steadypose.training.networks.graph import FaultNet, load_fault_net
from steadypose.training.networks.hgvae import HGVAE
from steadypose.training.recipes.hgvae import evidence
from steadypose.training.recipes.hgvae_faults import Scored, score_windows

SENSORS = {"motion capture, 3 mm": 0.003, "camera, 20 mm": 0.02}
RATES = (0.05, 0.01)


def anomalies(bench: Bench, model: HGVAE, motion: MotionSet) -> Result:
    """Measure the AUROC of every fault, by steadypose's and the paper's score, and false alarms among people not used
    for calibration."""
    count = 64 if bench.quick else 600
    rng = np.random.default_rng(11)
    windows, network = Windows(motion), load_fault_net("default")
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
                corrupted, holds = fault(other, rng)
                seen = with_sensor_error(corrupted, sigma, rng)
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
    alarms = _false_alarms(bench, network, model, motion)
    first, second = SENSORS
    by = {(r["fault"], r["sensor"]): r for r in records}
    tables = [
        Table(
            "hgvae-anomaly", "HG-VAE: area under the ROC curve, by fault",
            ["fault", *(f"{method}, {s}" for method in ("steadypose", "log p(z given x)") for s in (first, second))],
            [[name, *(f"{by[name, s]['auroc']:.3f}" for s in SENSORS),
              *(f"{by[name, s]['auroc_paper']:.3f}" for s in SENSORS)] for name in FAULTS],
            f"{count} clean windows of validation people against as many corrupted ones, as a sensor of that error "
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
    """Return log p(m) of the posterior's means, all levels, (B,)."""
    scores = []
    for start in range(0, len(seen), 256):
        rows = zip(seen[start : start + 256], sizes[start : start + 256], strict=True)
        x = standardise(model, np.stack([to_tracks(window, size).x for window, size in rows]))
        scores.append(model(x, torch.ones_like(x)).log_prior.sum(dim=1).double().numpy())
    return np.concatenate(scores)


def _false_alarms(bench: Bench, network: FaultNet, model: HGVAE, motion: MotionSet) -> list[dict[str, Any]]:
    """Measure false alarms on clean windows: of each validation person with the others' scale, and of unseen kinds of
    motion."""
    sigma, count = SENSORS["camera, 20 mm"], 128 if bench.quick else 4000

    def scored(some: MotionSet, windows: int) -> Scored:
        rng = np.random.default_rng(13)
        positions, sizes = Windows(some).draw(windows, model.config.frames, rng)
        return score_windows(network, model, with_sensor_error(positions, sigma, rng), sizes, sigma)

    if not len(motion.subject):  # simulated people have no names
        return []
    people = {str(person): motion.only(motion.subject == person) for person in np.unique(motion.subject)}
    found = {p: scored(m, max(round(count * m.hours / motion.hours), 8)).odds.max(axis=1) for p, m in people.items()}
    records: list[dict[str, Any]] = []
    for person, own in found.items():
        others = [of for other, of in found.items() if other != person] or [own]
        limits = np.quantile(np.concatenate(others), 1 - np.array(RATES))
        records.append({"people": person, "windows": len(own)} | _above(own[:, None], limits))
    total = sum(r["windows"] for r in records)
    mean = {f"at_{rate:g}": sum(r["windows"] * r[f"at_{rate:g}"] for r in records) / total for rate in RATES}
    records.insert(0, {"people": "all validation people, each by a scale of the others", "windows": total} | mean)
    if bench.data.is_file():
        everything = MotionSet.load(bench.data, "research", "val")
        known = np.isin(everything.subject, motion.subject)
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
    """Return the share of ``scores`` (B, 1) above each of ``limits``, one for each of `RATES`."""
    return {f"at_{rate:g}": float((scores > limit).mean()) for rate, limit in zip(RATES, limits, strict=True)}


DEPENDS_ON = ("hgvae weights", "training.data.hgvae_windows", "training.networks.hgvae", "prior.models.hgvae")
"""What the results depend on. No table runs `pose/clean`."""


def run(bench: Bench) -> Result:
    model = load_network(HGVAE, HGVAEConfig.from_dict, "default", "hgvae")
    prepared = bench.data.is_file()
    motion = prepared_set(bench.data, "val") if prepared else as_set(bench.clips(90, 60))
    source = {"file": bench.data.name, "sha256": digest(bench.data)} if prepared else {"simulated people": True}
    results = [study(bench, model, motion) for study in (_likelihood, anomalies, sweep, whole_joints)]
    return Result(
        [table for result in results for table in result.tables],
        {"data": source} | {key: value for result in results for key, value in result.data.items()},
        {name: figure for result in results for name, figure in result.figures.items()},
    )


@torch.no_grad()
def _likelihood(bench: Bench, model: HGVAE, motion: MotionSet) -> Result:
    count = 64 if bench.quick else 1024
    positions, sizes = Windows(motion).draw(count, model.config.frames, np.random.default_rng(7))
    torch.manual_seed(7)
    parts = []
    for start in range(0, count, 128):
        part = slice(start, start + 128)
        whole = Batch.of(model, positions[part], positions[part], sizes[part])
        likelihood, kl = evidence(model(whole.x, whole.certainty, spread=torch.ones(len(whole.x), 1)), whole.target)
        off = (model(whole.x, whole.certainty).tracks.mean - whole.target) * SCALE * 1000
        parts.append(torch.stack([likelihood, kl, off.square().mean(dim=(1, 2))], dim=1))
    likelihood, kl, square = torch.cat(parts).mean(dim=0).tolist()
    found = {"log_likelihood": likelihood, "kl": kl, "elbo": likelihood - kl, "mse_mm2": square}
    record = {"parameters": sum(p.numel() for p in model.parameters()), **found}
    cells = [f"{record['parameters'] / 1e6:.2f} M", *(f"{found[key]:.0f}" for key in ("log_likelihood", "kl", "elbo"))]
    table = Table(
        "hgvae-likelihood", "HG-VAE: likelihood of clean windows of unseen people",
        ["model", "parameters", "log p(x|z), nats", "KL, nats", "ELBO, nats", "reconstruction, mm RMS"],
        [["live", *cells, f"{found['mse_mm2'] ** 0.5:.1f}"]],
        "50 frames, 22 joints, 3,300 entries a window in metres; latents drawn once.",
    )  # fmt: skip
    return Result([table], {"likelihood": record})
