"""The transition model as it ships, and its ablations, trained alike and briefly."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path

from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.machine import ROOT
from steadypose.benchmarks.motion import as_set, digest, prepared_set
from steadypose.prior.fit.humor_network import HumorConfig, HumorNet
from steadypose.prior.fit.tensors import load_network
from steadypose.training.data.dataset import MotionSet
from steadypose.training.recipes.humor import fit_transitions

STEPS, BATCH, LEARNING_RATE, EVALUATIONS = 250, 64, 1e-3, 5
"""Of a brief training: a forty-eighth of the sequences that what ships has seen."""

SHIPS, MVAE = "HuMoR, as it ships", "MVAE-like: none of the three"
BRIEF = "HuMoR, briefly trained"

VARIANTS: Mapping[str, HumorConfig] = {
    BRIEF: HumorConfig(),
    "standard prior": HumorConfig(learned_prior=False),
    "no delta": HumorConfig(residual=False),
    "no contacts": HumorConfig(contacts=False),
    MVAE: HumorConfig(learned_prior=False, residual=False, contacts=False),
}
"""As the paper names them; without SMPL, it has one more: joints that need not be those of a body."""


def shipped() -> HumorNet:
    """The default weights."""
    return load_network(HumorNet, HumorConfig.from_dict, "default", "humor")


def model_of(bench: Bench, name: str) -> HumorNet:
    """One of `VARIANTS`, trained now, or found in ``runs`` from an earlier call; or what ships."""
    if name == SHIPS:
        return shipped()
    bench.progress.stop()  # training draws a bar of its own
    try:
        config = VARIANTS[name]
        if bench.quick or not bench.data.is_file():
            motion = as_set(bench.training_clips())
            with tempfile.TemporaryDirectory() as runs:
                return _trained(config, motion, motion, Path(runs), name, steps=2)
        runs = ROOT / "runs" / f"humor-{digest(bench.data)}-{STEPS}"
        train, val = (prepared_set(bench.data, split) for split in ("train", "val"))
        return _trained(config, train, val, runs, name, STEPS)
    finally:
        bench.progress.start()


def _trained(config: HumorConfig, train: MotionSet, val: MotionSet, runs: Path, name: str, steps: int) -> HumorNet:
    stem = name.replace(" ", "-").replace(",", "").replace(":", "")
    path = runs / stem / f"{stem}.safetensors"
    if not path.is_file():
        card = {"Training": f"{steps} steps of {BATCH} sequences, for the bench"}
        fit_transitions(
            config, train, val, path, card, steps, BATCH, LEARNING_RATE, seed=0, known=shipped(),
            evaluations=EVALUATIONS,
        )  # fmt: skip
    return load_network(HumorNet, HumorConfig.from_dict, str(path), "humor")
