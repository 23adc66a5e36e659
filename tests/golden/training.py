"""Whether a change of the code leaves every recipe's training as it was, step by step:
``python -m tests.golden.training write|check FILE PREPARED MOCAP``.

Each recipe takes 20 steps by seed on a few clips of every source; its losses, what it evaluates and its weights are
hashed. PREPARED is what ``prepare`` wrote; MOCAP is the folder of the recordings, of which the mixture's arrays are
made once, beside FILE.
"""

import hashlib
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from tests.golden.__main__ import compare

from steadypose.nodes.commands.train import RECIPES
from steadypose.training.data.recordings import write_arrays
from steadypose.training.loop import TrainingOptions, TrainingRun
from steadypose.training.recipes import contacts, hgvae_faults, humor, occlusion, sensor_bias

STEPS, CLIPS = 20, 6
"""Optimiser steps of each recipe, and clips of each source and split that they are trained on."""

FEW: tuple[tuple[Any, str, Any], ...] = (
    (contacts, "CLIPS", {"train": 64, "val": 64}),
    (hgvae_faults, "WINDOWS", 10),
    (humor, "_STATES_OF_MIXTURE", 2_000),
    (occlusion, "RECORDED", {"train": 1, "val": 1}),
    (sensor_bias, "EVALUATIONS", 1),
)
"""What takes minutes before or after the steps, made small."""


def few_clips(prepared: Path, out: Path) -> None:
    """The first clips of every source and split of ``prepared.npz``."""
    with np.load(prepared) as data:
        arrays = {name: data[name] for name in data.files}
    starts, kept = arrays["clip_start"], []
    for source, split in sorted(set(zip(arrays["source"], arrays["split"], strict=True))):
        kept += np.flatnonzero((arrays["source"] == source) & (arrays["split"] == split))[:CLIPS].tolist()
    frames = np.concatenate([np.arange(starts[c], starts[c + 1]) for c in kept])
    few = {name: values[frames if len(values) == starts[-1] else kept] for name, values in arrays.items()
           if name != "clip_start"}  # fmt: skip
    np.savez(out, **few, clip_start=np.concatenate([[0], np.cumsum(np.diff(starts)[kept])]))


def digest_of(recipe: str, data: Path, arrays: Path, folder: Path) -> str:
    """Of all the losses that a recipe goes down, of what it evaluates at the end and of the files that it writes."""
    for model in ("mixture", "occlusion"):
        (folder / f"{model}-default").mkdir(parents=True)
        (folder / f"{model}-default" / "arrays").symlink_to(arrays)
    found, descend, start = hashlib.sha256(), torch.Tensor.backward, TrainingRun.__init__

    def backward(loss: torch.Tensor, *args: Any, **named: Any) -> None:
        found.update(np.float64(loss.item()).tobytes())
        descend(loss, *args, **named)

    def evaluated_once(run: TrainingRun, *args: Any, **named: Any) -> None:
        start(run, *args, **named)
        run.every = STEPS

    with ExitStack() as stack:
        for module, name, value in FEW:
            stack.enter_context(patch.object(module, name, value))
        stack.enter_context(patch.object(torch.Tensor, "backward", backward))
        stack.enter_context(patch.object(TrainingRun, "__init__", evaluated_once))
        name = "kinect_v2" if recipe == "correction" else "default"
        module, function = RECIPES[recipe]
        train = getattr(import_module(f"steadypose.training.recipes.{module}"), function)
        train(TrainingOptions(data, folder, name, STEPS), **({"subjects": ("s01",)} if recipe == "correction" else {}))
    for path in sorted([*folder.rglob("*.safetensors"), *folder.rglob("curves.json"), *folder.rglob("*.anomaly.json")]):
        found.update(path.name.encode() + path.read_bytes())
    return found.hexdigest()[:24]


def outcomes(prepared: Path, mocap: Path, arrays: Path) -> Iterator[tuple[str, str]]:
    """Name and digest of every recipe's training."""
    torch.set_num_threads(1)
    write_arrays(mocap, arrays)
    with tempfile.TemporaryDirectory() as folder:
        few_clips(prepared, Path(folder) / "few.npz")
        for recipe in RECIPES:
            data = mocap / "ui_prmd.npz" if recipe == "correction" else Path(folder) / "few.npz"
            yield recipe, digest_of(recipe, data, arrays, Path(folder) / recipe)


if __name__ == "__main__":
    verb, file, prepared, mocap = sys.argv[1:]
    sys.exit(compare(verb, Path(file), dict(outcomes(Path(prepared), Path(mocap), Path(file).with_suffix(".arrays")))))
