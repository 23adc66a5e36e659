"""What every training shares: resumable checkpoints, a progress bar, and curves drawn as it goes."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn


class TrainingRun:
    """A training that survives being killed: its state lies in ``directory/checkpoint.pt``.

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
        if self._checkpoint.exists():
            saved = torch.load(self._checkpoint, weights_only=True)
            for name, part in state.items():
                part.load_state_dict(saved[name])
            self.step, self.curves = saved["step"], saved["curves"]
            torch.set_rng_state(saved["rng"])

    def steps(self, evaluate: Callable[[], dict[str, float]]) -> Iterator[int]:
        """Yield the number of each step still to do; evaluate, checkpoint and draw every so often and at the end."""
        columns = (
            TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
            TimeRemainingColumn(), TextColumn("{task.fields[result]}"),
        )  # fmt: skip
        with Progress(*columns) as progress:
            task = progress.add_task(
                self.directory.name, total=self.iterations, completed=self.step, result=self._latest()
            )
            while self.step < self.iterations:
                yield self.step
                self.step += 1
                if self.step % self.every == 0 or self.step == self.iterations:
                    self.curves.append({"step": self.step, **evaluate()})
                    self._save()
                progress.update(task, completed=self.step, result=self._latest())

    def _latest(self) -> str:
        return "  ".join(f"{k} {v:.4g}" for k, v in (self.curves[-1] if self.curves else {}).items() if k != "step")

    def _save(self) -> None:
        part = self._checkpoint.with_suffix(".part")
        states = {name: part_.state_dict() for name, part_ in self.state.items()}
        torch.save({**states, "step": self.step, "curves": self.curves, "rng": torch.get_rng_state()}, part)
        os.replace(part, self._checkpoint)
        (self.directory / "curves.json").write_text(json.dumps(self.curves, indent=1))
        draw_curves(self.curves, self.directory / "curves.png")


def draw_curves(curves: list[dict[str, float]], path: Path) -> None:
    """Draw every quantity of ``curves`` against the step, one panel each."""
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
