"""What every training shares: resumable checkpoints, a progress bar, and curves drawn as it goes."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from torch import nn
from torch.optim import Optimizer

from steadypose.prior.models.distributed import average_gradients, from_first, processes, rank, writes
from steadypose.prior.models.torch_weights import save_weights


class TrainingRun:
    """A training that survives being killed: its state lies in ``directory/checkpoint.pt``.

    Under torchrun, all processes start from the state of the first, which alone writes and evaluates, and the
    gradients of every optimiser in ``state`` are averaged before it steps.

    Args:
        directory: where checkpoints, ``curves.json`` and ``curves.png`` go; a checkpoint there is resumed.
        state: what to save and restore by ``state_dict`` / ``load_state_dict`` (model, optimiser, schedule).
        iterations: how many steps the whole training has.
        every: steps between evaluations and checkpoints.
    """

    def __init__(self, directory: Path, state: Mapping[str, Any], iterations: int, every: int) -> None:
        self.directory, self.state, self.iterations, self.every = directory, state, iterations, every
        self.step = 0
        self.curves: list[dict[str, float]] = []
        self._checkpoint = directory / "checkpoint.pt"
        directory.mkdir(parents=True, exist_ok=True)
        saved = torch.load(self._checkpoint, weights_only=True) if writes() and self._checkpoint.exists() else None
        if processes() > 1:
            saved = from_first(saved or self._states())
        if saved:
            for name, part in state.items():
                part.load_state_dict(saved[name])
            self.step, self.curves = saved["step"], saved["curves"]
            torch.set_rng_state(saved["rng"])
        if rank():
            # the same noise on every process would be noise that does not average out
            torch.manual_seed(torch.initial_seed() + rank() + processes() * self.step)
        for part in state.values():
            if isinstance(part, Optimizer):
                average_gradients(part)

    def random(self, seed: int) -> np.random.Generator:
        """Random numbers for the step at hand, another stream on each process of torchrun."""
        return np.random.default_rng((seed, self.step, rank()))

    def steps(self, evaluate: Callable[[], dict[str, float]]) -> Iterator[int]:
        """Yield the number of each step still to do; evaluate, checkpoint and draw every so often and at the end."""
        columns = (
            TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
            TimeRemainingColumn(), TextColumn("{task.fields[result]}"),
        )  # fmt: skip
        with Progress(*columns, disable=not writes()) as progress:
            task = progress.add_task(
                self.directory.name, total=self.iterations, completed=self.step, result=self._latest()
            )
            while self.step < self.iterations:
                yield self.step
                self.step += 1
                if self.step % self.every == 0 or self.step == self.iterations:
                    self.curves.append(from_first({"step": self.step, **(evaluate() if writes() else {})}))
                    if writes():
                        self._save()
                progress.update(task, completed=self.step, result=self._latest())

    def save(self, path: Path, model: nn.Module, config: Mapping[str, Any], card: Mapping[str, str]) -> Path:
        """Write what came of the training: the model, its card, its curves.

        Args:
            path: ``MODEL-SET.safetensors``; where nodes read weights it comes by `torch_weights.install`.
            model: trained.
            config: what rebuilds it.
            card: heading to content: what it is, its data, licence and training; how well it did is added here.

        Returns:
            ``path``.
        """
        curves = path.with_suffix(".png")
        told = {
            "Validation": ", ".join(f"{k} {v:.4g}" for k, v in self.curves[-1].items()),
            "Curves": f"`{curves.name}`",
        }
        save_weights(path, model, config, {**card, **told})
        draw_curves(self.curves, curves)
        return path

    def _latest(self) -> str:
        return "  ".join(f"{k} {v:.4g}" for k, v in (self.curves[-1] if self.curves else {}).items() if k != "step")

    def _save(self) -> None:
        part = self._checkpoint.with_suffix(".part")
        torch.save(self._states(), part)
        os.replace(part, self._checkpoint)
        (self.directory / "curves.json").write_text(json.dumps(self.curves, indent=1))
        draw_curves(self.curves, self.directory / "curves.png")

    def _states(self) -> dict[str, Any]:
        states = {name: part.state_dict() for name, part in self.state.items()}
        return {**states, "step": self.step, "curves": self.curves, "rng": torch.get_rng_state()}


def draw_curves(curves: list[dict[str, float]], path: Path) -> None:
    """Draw every quantity of ``curves`` against the step, one panel each, on the first process of torchrun."""
    if not writes():
        return
    from matplotlib.figure import Figure

    names = [name for name in curves[-1] if name != "step"]
    figure = Figure(figsize=(3.2 * len(names), 2.6), layout="constrained")
    for axis, name in zip(figure.subplots(1, len(names), squeeze=False)[0], names, strict=True):
        axis.plot([c["step"] for c in curves], [c[name] for c in curves], lw=1.2)
        axis.set(title=name, xlabel="step")
        axis.grid(alpha=0.3)
        if min(c[name] for c in curves) > 0:
            axis.set_yscale("log")
    figure.savefig(path, dpi=110)
