"""The transition model as it ships, and its ablations, trained alike and briefly."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path

import torch

from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.machine import ROOT
from steadypose.benchmarks.motion import as_set, digest, prepared_set
from steadypose.prior.fit.humor_network import HumorConfig, HumorNet
from steadypose.prior.fit.tensors import load_network
from steadypose.training.data.dataset import MotionSet
from steadypose.training.recipes.humor import Sequences, recipe_of

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
        recipe = recipe_of(config, Sequences.of(train), Sequences.of(val))
        recipe = replace(recipe, batch=BATCH, rate=LEARNING_RATE, evaluations=EVALUATIONS)
        torch.manual_seed(0)
        model = HumorNet(config)
        model.load_state_dict(dict(shipped().named_buffers()), strict=False)  # fitting them anew takes a minute
        run = recipe.minimise(model, path.parent, steps, seed=0)
        run.save(path, model, asdict(config), {"Training": f"{steps} steps of {BATCH} sequences, for the bench"})
    return load_network(HumorNet, HumorConfig.from_dict, str(path), "humor")
