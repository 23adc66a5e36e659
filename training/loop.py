"""The training loop of all models. A recipe gives a network and its loss, and the loop minimises the loss.

Training is resumable, shows a progress bar, draws curves as it runs, and writes a card beside the weights.
"""

import copy
import io
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from torch import Tensor, nn
from torch.optim import Adam, AdamW, Optimizer
from torch.optim.lr_scheduler import CosineAnnealingLR, LRScheduler

from steadypose.prior.models.weights import LICENCES
from steadypose.training.data.dataset import MotionSet
from steadypose.training.data.prepare import whole
from steadypose.training.distributed import average_gradients, from_first, processes, rank, share, writes
from steadypose.training.weights import save_weights, started

Network = TypeVar("Network", bound=nn.Module)
Rng = np.random.Generator

Loss = Callable[[int, float, np.random.Generator], tuple[Tensor, dict[str, float]]]
"""Type of `Recipe.loss` without its network."""


@dataclass(frozen=True)
class TrainingOptions:
    """Options of ``steadypose train``, common to all models."""

    data: Path  # ``prepared.npz``, or other training data of the model
    runs: Path  # folder of training runs; an interrupted run of the same name resumes there
    weights: str = "default"  # weight set, ``default`` or ``research``; for a sensor's correction, its name
    iterations: int | None = None  # number of optimiser steps, at least 1; None for the model's default
    seed: int = 0  # random seed of initial weights and of sampling, at least 0
    start: str | None = None  # weights to start from: a weight set or a path

    def __post_init__(self) -> None:
        if self.iterations is not None and self.iterations < 1:
            raise ValueError(f"iterations: expected 1 or more, got {self.iterations}")
        if self.seed < 0:
            raise ValueError(f"seed: expected 0 or more, got {self.seed}")

    def path(self, model: str) -> Path:
        """Return the path of a model's weights in the folder of its run: ``RUNS/MODEL-SET/MODEL-SET.safetensors``."""
        name = f"{model}-{self.weights}"
        return self.runs / name / f"{name}.safetensors"

    def motion(self, *, flat: bool = False) -> tuple[MotionSet, MotionSet]:
        """Load prepared motion for training and for validation; ``flat`` as in `MotionSet.load`."""
        train, val = (MotionSet.load(self.data, self.weights, split, flat=flat) for split in ("train", "val"))
        return train, val


@dataclass(frozen=True)
class Recipe(Generic[Network]):
    """The model-specific part of a training."""

    model: str  # the model's name
    network: Callable[[], Network]  # creates the untrained network
    loss: Callable[[Network, int, float, Rng], tuple[Tensor, dict[str, float]]]
    """returns the loss of a random batch, and terms to plot. It is called with the network in training mode, the number
    of samples, the progress of the training in [0, 1), and a random generator, which differs between torchrun's
    processes"""
    evaluate: Callable[[Network], dict[str, float]]
    """returns further quantities to plot, on validation data; called in evaluation mode, without gradients"""
    iterations: int  # default number of optimiser steps
    batch: int  # samples per step, of all processes together
    rate: float  # initial learning rate
    sample: str = "windows"  # name of a sample, in the plural
    decay: float = 0.0  # weight decay
    optimiser: type[Adam] = AdamW  # AdamW, or Adam where a paper uses it
    schedule: Callable[[Optimizer, int], LRScheduler] | None = None
    """creates the learning rate schedule from the optimiser and the number of steps; by default, a cosine down to a
    hundredth"""
    evaluations: int = 40  # number of evaluations and checkpoints
    clip: float = 1.0  # maximum norm of the gradient
    parameters: Callable[[Network], list[nn.Parameter]] | None = None
    """the network's trained parameters; all by default"""
    average: float | None = None
    """decay of the exponential moving average of the parameters; if given, the average is evaluated and saved"""

    def minimise(self, network: Network, directory: Path, iterations: int, seed: int) -> "TrainingRun":
        """Train ``network`` in place, in the folder of a run; resumes a checkpoint there."""
        mean = network if self.average is None else copy.deepcopy(network)
        kept = network if mean is network else nn.ModuleDict({"network": network, "mean": mean})
        parameters = network.parameters() if self.parameters is None else self.parameters(network)
        optimiser = self.optimiser(parameters, lr=self.rate, weight_decay=self.decay)
        make = self.schedule or (lambda optimiser, steps: CosineAnnealingLR(optimiser, steps, self.rate / 100))
        run = TrainingRun(directory, kept, make(optimiser, iterations), iterations, self.evaluations)
        if self.average is not None:
            optimiser.register_step_post_hook(lambda *_: _move_average(mean, network, self.average or 0.0, run.step))

        def loss(count: int, done: float, rng: Rng) -> tuple[Tensor, dict[str, float]]:
            return self.loss(network, count, done, rng)

        run.minimise(loss, lambda: self.evaluate(mean), self.batch, seed, self.clip)
        if mean is not network:
            network.load_state_dict(mean.state_dict())
        return run

    def train(
        self,
        options: TrainingOptions,
        described: str,
        data: str,
        *,
        licence: str | None = None,
        started_anew: Callable[[Network], None] = lambda network: None,
        calibrated: Callable[[Network], Any] | None = None,
    ) -> Path:
        """Train with the user's options, and write the weights with their card; returns the path of the weights.

        Args:
            options: options of ``steadypose train``.
            described, data: descriptions of the model and of the training data for the card.
            licence: licence of the weights; by default, their set's.
            started_anew: fits what gradients do not fit, such as the scale of features; called if the training starts
                without other weights and without a checkpoint.
            calibrated: returns the trained network's configuration; by default, the original one.
        """
        path, iterations = options.path(self.model), options.iterations or self.iterations
        torch.manual_seed(options.seed)
        network = self.network()
        origin = started(network, self.model, options.start)
        if options.start is None and not (path.parent / "checkpoint.pt").exists():
            started_anew(network)
        run = self.minimise(network, path.parent, iterations, options.seed)
        config: Any = network.config if calibrated is None else calibrated(network)
        return run.save(path, network, asdict(config), {
            "Model": described,
            "Data": data,
            "Licence": licence or LICENCES[options.weights],
            "Training": f"`steadypose train {self.model} --weights {options.weights} --iterations {iterations}`: "
            f"{self.batch} {self.sample} a step, {self.optimiser.__name__} {self.rate:g}, seed {options.seed}{origin}",
        })  # fmt: skip


@torch.no_grad()
def _move_average(mean: nn.Module, network: nn.Module, decay: float, step: int) -> None:
    """Update the moving average of parameters. Over the first steps, it is almost their arithmetic mean."""
    for average, new in zip(mean.parameters(), network.parameters(), strict=True):
        average.lerp_(new, 1.0 - min(decay, (step + 1) / (step + 10)))


class TrainingRun:
    """A resumable training with its state in ``directory/checkpoint.pt``.

    Under torchrun, all processes start from the first one's state, and only the first writes and evaluates. Each draws
    its share of a batch, and gradients are averaged before each optimiser step.

    ``directory`` is the folder of checkpoints, ``curves.json`` and ``curves.png``. ``model`` is the content of the
    checkpoint: the network, or an `nn.ModuleDict` of it and, for example, averaged weights that a post-step hook of the
    optimiser updates. ``iterations`` and ``evaluations`` (also checkpoints) are those of the whole training.
    """

    def __init__(
        self, directory: Path, model: nn.Module, schedule: LRScheduler, iterations: int, evaluations: int
    ) -> None:
        self.directory, self.iterations, self.every = directory, iterations, max(iterations // evaluations, 1)
        self._model, self._schedule, self._optimiser = model, schedule, schedule.optimizer
        self._state = {"model": model, "optimiser": self._optimiser, "schedule": schedule}
        self.step = 0
        self.curves: list[dict[str, float]] = []
        self._checkpoint = directory / "checkpoint.pt"
        directory.mkdir(parents=True, exist_ok=True)
        saved = torch.load(self._checkpoint, weights_only=True) if writes() and self._checkpoint.exists() else None
        if processes() > 1:
            saved = from_first(saved or self._states())
        if saved:
            for name, part in self._state.items():
                part.load_state_dict(saved[name])
            self.step, self.curves = saved["step"], saved["curves"]
            torch.set_rng_state(saved["rng"])
        if rank():
            # equal noise on all processes would not average out
            torch.manual_seed(torch.initial_seed() + rank() + processes() * self.step)
        average_gradients(self._optimiser)

    def minimise(
        self, loss: Loss, evaluate: Callable[[], dict[str, float]], batch: int, seed: int, clip: float = math.inf
    ) -> None:
        """Run the remaining steps, with evaluations, checkpoints and curves at intervals and at the end.

        ``seed`` is that of the batches; for the others, see `Recipe`.
        """
        parameters = [parameter for group in self._optimiser.param_groups for parameter in group["params"]]
        columns = (
            TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
            TimeRemainingColumn(), TextColumn("{task.fields[result]}"),
        )  # fmt: skip
        with Progress(*columns, disable=not writes()) as progress:
            name = self.directory.name
            task = progress.add_task(name, total=self.iterations, completed=self.step, result=self._latest())
            while self.step < self.iterations:
                self._model.train()
                rng = np.random.default_rng((seed, self.step, rank()))
                value, terms = loss(share(batch), self.step / self.iterations, rng)
                self._optimiser.zero_grad()
                value.backward()
                nn.utils.clip_grad_norm_(parameters, clip)
                self._optimiser.step()
                self._schedule.step()
                self.step += 1
                if self.step % self.every == 0 or self.step == self.iterations:
                    self._evaluate(terms, evaluate)
                progress.update(task, completed=self.step, result=self._latest())
        self._model.eval()

    def save(self, path: Path, model: nn.Module, config: Mapping[str, Any], card: Mapping[str, str]) -> Path:
        """Write the trained model with the configuration that rebuilds it, its card and its curves; returns ``path``.

        ``path`` is ``MODEL-SET.safetensors`` in the run's folder; `training.weights.install` copies it to where nodes
        read. ``card`` is content by heading: model, data, licence and training; the last evaluation is added.
        """
        curves = path.with_suffix(".png")
        latest = ", ".join(f"{k} {v:.4g}" for k, v in self.curves[-1].items())
        save_weights(path, model, config, {**card, "Validation": latest, "Curves": f"`{curves.name}`"})
        draw_curves(self.curves, curves)
        return path

    @torch.no_grad()
    def _evaluate(self, terms: dict[str, float], evaluate: Callable[[], dict[str, float]]) -> None:
        self._model.eval()
        self.curves.append(from_first({"step": self.step, **({**terms, **evaluate()} if writes() else {})}))
        if writes():
            self._save()

    def _latest(self) -> str:
        return "  ".join(f"{k} {v:.4g}" for k, v in (self.curves[-1] if self.curves else {}).items() if k != "step")

    def _save(self) -> None:
        torch.save(self._states(), states := io.BytesIO())  # in a file, it reports a full disk as an internal failure
        with whole(self._checkpoint) as file:
            file.write(states.getbuffer())
        with whole(self.directory / "curves.json") as file:
            file.write(json.dumps(self.curves, indent=1).encode())
        draw_curves(self.curves, self.directory / "curves.png")

    def _states(self) -> dict[str, Any]:
        states = {name: part.state_dict() for name, part in self._state.items()}
        return {**states, "step": self.step, "curves": self.curves, "rng": torch.get_rng_state()}


def draw_curves(curves: list[dict[str, float]], path: Path) -> None:
    """Plot every quantity of ``curves`` against the step, one panel each, in the first process of torchrun."""
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
    with whole(path) as file:
        figure.savefig(file, dpi=110)
