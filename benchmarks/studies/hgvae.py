"""HG-VAE's tables, as in its paper, on our data: likelihood and depth, anomalies, imputation, actions.

Windows of 50 frames of validation people. Nothing here is comparable with the paper's figures, which are on AMASS.
"""

from __future__ import annotations

import numpy as np
import torch

from steadypose.benchmarks.bench import Bench, Result
from steadypose.benchmarks.results import Table
from steadypose.benchmarks.studies import hgvae_models as models
from steadypose.benchmarks.studies.hgvae_anomalies import anomalies
from steadypose.benchmarks.studies.hgvae_common import NAMES, Data
from steadypose.benchmarks.studies.hgvae_generation import generation
from steadypose.benchmarks.studies.hgvae_imputation_tables import prediction, sweep, whole_joints
from steadypose.prior.fit.tensors import load_network
from steadypose.prior.models.hgvae.config import SCALE, HGVAEConfig
from steadypose.prior.models.weights import WEIGHTS
from steadypose.training.data.hgvae_windows import Batch, Windows
from steadypose.training.networks.hgvae import HGVAE
from steadypose.training.recipes.hgvae import evidence

DEPENDS_ON = ("hgvae weights", "prior.impute settings")
"""No table runs pose/clean; one imputes as it does."""


def run(bench: Bench) -> Result:
    """All tables and pictures; models for the tables are trained on the way, or found in ``runs``."""
    found = {name: model for name in NAMES if (model := _model(name)) is not None}
    data = Data(bench)
    results = [
        _likelihood(bench, found, data),
        anomalies(bench, found["default"], data),
        sweep(bench, found, data),
        whole_joints(bench, found, data),
        prediction(bench, found["default"], data),
        _depth(bench, data),
        generation(bench, data),
    ]
    return Result(
        [table for result in results for table in result.tables],
        {"data": data.source} | {key: value for result in results for key, value in result.data.items()},
        {name: figure for result in results for name, figure in result.figures.items()},
    )


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
        likelihood, kl = evidence(model(whole.x, whole.certainty, spread=torch.ones(len(whole.x), 1)), whole.target)
        off = (model(whole.x, whole.certainty).tracks.mean - whole.target) * SCALE * 1000
        parts.append(torch.stack([likelihood, kl, off.square().mean(dim=(1, 2))], dim=1))
    likelihood, kl, square = torch.cat(parts).mean(dim=0).tolist()
    return {"log_likelihood": likelihood, "kl": kl, "elbo": likelihood - kl, "mse_mm2": square}


def _likelihood(bench: Bench, found: dict[str, HGVAE], data: Data) -> Result:
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


def _depth(bench: Bench, data: Data) -> Result:
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
