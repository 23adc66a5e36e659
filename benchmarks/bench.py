"""What all studies share: their settings, the baselines and steadypose run over clips, and one parameter search.

The search is the same for every baseline: the same number of evaluations, the same clips and the same loss.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.progress import Progress
from scipy.stats import qmc

from steadypose.benchmarks import product
from steadypose.benchmarks.baselines import recurrent, smoothnet
from steadypose.benchmarks.baselines.filters import BASELINES, Baseline
from steadypose.benchmarks.motion import MotionClips, prepared_clips, simulated_clips
from steadypose.benchmarks.scores import errors_mm
from steadypose.prior.arrays import Floats
from steadypose.prior.clean.settings import PriorSettings

Parameters = dict[str, float]


@dataclass(frozen=True)
class Tuned:
    parameters: Parameters  # parameters with the least loss
    tried: list[dict[str, float]]  # every evaluated point, with its figures


def loss(figures: Mapping[str, float]) -> float:
    """Return the loss that tuning minimises: position error in mm plus acceleration error in mm/frame²."""
    return figures["position_mm"] + figures["acceleration_mm"]


def search(
    space: Mapping[str, tuple[float, float]], evaluate: Callable[[Parameters], dict[str, float]], budget: int
) -> Tuned:
    """Search parameters: two thirds of the budget evenly over the logarithms of ``space`` (Sobol), the rest within a
    quarter of its width around the best. ``evaluate`` gives figures, including ``position_mm`` and ``acceleration_mm``.
    """
    tried: list[dict[str, float]] = []
    best: Parameters = {}
    low, high = np.log(np.array(list(space.values()))).T
    wide = budget - budget // 3
    for centre, width, count in (((low + high) / 2, high - low, wide), (None, (high - low) / 4, budget - wide)):
        middle = np.log(list(best.values())) if centre is None else centre
        for point in _points(np.maximum(middle - width / 2, low), np.minimum(middle + width / 2, high), count):
            parameters = {name: float(f"{value:.4g}") for name, value in zip(space, np.exp(point), strict=True)}
            tried.append({**parameters, **evaluate(parameters)})
        winner = min(tried, key=loss)
        best = {name: winner[name] for name in space}
    return Tuned(best, tried)


def _points(low: np.ndarray, high: np.ndarray, count: int) -> Iterator[np.ndarray]:
    sampler = qmc.Sobol(len(low), scramble=True, rng=0)
    yield from low + sampler.random_base2(int(np.ceil(np.log2(max(count, 1)))))[:count] * (high - low)


TUNED_ON = 3
"""Step between the clips on which baselines are tuned. They are among the clips that are scored, with other noise,
which favours the baselines."""

DELAYS = (0, 2, 4, 8)  # delays at which methods are compared, frames at 30 Hz
SEEDS = (0, 1, 2)  # seeds of networks trained here, and of random sampling
RECURRENT = "GRU of the whole body"


@dataclass(frozen=True)
class Bench:
    quick: bool  # use fewer clips, points and steps, to check that everything works
    mocap: Path | None  # folder with ui_prmd.npz, or None
    data: Path  # prepared.npz; if it does not exist, simulated people are used instead
    progress: Progress  # progress bars
    split: str = "val"  # split of the prepared motion to score: ``val`` to choose, ``test`` to report

    @property
    def delays(self) -> tuple[int, ...]:
        return (0, 4) if self.quick else DELAYS

    @property
    def seeds(self) -> tuple[int, ...]:
        return SEEDS[:1] if self.quick else SEEDS

    @property
    def budget(self) -> int:
        """Number of evaluations in each baseline's search, for each delay."""
        return 6 if self.quick else 18

    def clips(self, frames: int = 90, most: int = 32) -> MotionClips:
        """Return the motion to score."""
        return self._motion(self.split, frames, min(most, 12) if self.quick else most)

    def training_clips(self) -> MotionClips:
        """Return training motion of other people, for the baselines that learn."""
        return self._motion("train", 90, 60 if self.quick else 1000)

    def _motion(self, split: str, frames: int, most: int) -> MotionClips:
        if self.data.is_file():
            return prepared_clips(self.data, split, frames, most)
        return simulated_clips(frames, min(most, 60), seed=("val", "train", "test").index(split))

    @cached_property
    def smoothnets(self) -> list[smoothnet.SmoothNet]:
        motion = self.training_clips()
        steps = 100 if self.quick else 3000
        return [
            smoothnet.train(motion, steps, seed, partial(self.progress.track, description=f"SmoothNet, seed {seed}"))
            for seed in self.seeds
        ]

    @cached_property
    def recurrent(self) -> recurrent.RecurrentDenoiser:
        track = partial(self.progress.track, description="recurrent denoiser")
        return recurrent.train(self.training_clips(), self.delays, 50 if self.quick else 3000, 0, track)


class Answer(NamedTuple):
    """Output of one method at one delay."""

    method: str
    delay: int
    stamps_s: Floats  # (T',), on the method's own grid if it has one, else those of the frames
    positions: Floats  # (T', C, 22, 3)
    parameters: Mapping[str, float]
    sigma: Floats | None = None  # (T', C, 22)


class Methods(NamedTuple):
    baselines: Sequence[Baseline]  # baselines without training
    product: Mapping[str, PriorSettings]  # steadypose's variants
    delays: Sequence[int]  # frames
    networks: bool = True  # whether to include the baselines trained here


def baselines_of(baselines: Sequence[Baseline], delays: Sequence[int]) -> Iterator[tuple[Baseline, int]]:
    """Yield every baseline with each delay that it supports."""
    for baseline in baselines:
        for delay in delays if baseline.delays is None else baseline.delays:
            yield baseline, delay


def answers(
    bench: Bench,
    seen: Floats,
    stamps_s: Floats,
    tuned: Mapping[tuple[str, int], Tuned],
    title: str,
    methods: Methods,
) -> Iterator[Answer]:
    """Run all methods over clips (T, C, 22, 3) with their tuned parameters; a network once for each seed."""

    def run() -> Iterator[Answer]:
        for baseline, delay in baselines_of(methods.baselines, methods.delays):
            parameters = tuned[baseline.name, delay].parameters
            positions = baseline.run(seen, stamps_s, delay, **parameters)
            yield Answer(baseline.name, delay, stamps_s, positions, parameters)
        if methods.networks:
            found = [("SmoothNet-style", smoothnet.smooth(net, seen, methods.delays)) for net in bench.smoothnets]
            for name, by_delay in (*found, (RECURRENT, recurrent.smooth(bench.recurrent, seen))):
                for delay, positions in zip(methods.delays, by_delay, strict=True):
                    yield Answer(name, delay, stamps_s, positions, {})
        for name, settings in methods.product.items():
            for delay in methods.delays:
                cleaned = product.run(settings, seen, stamps_s, delay)
                yield Answer(name, delay, cleaned.stamps_s, cleaned.positions, {}, cleaned.sigma)

    yield from bench.progress.track(run(), description=title)


def tune(
    bench: Bench,
    evaluate: Callable[[Baseline, int, Mapping[str, float]], dict[str, float]],
    title: str,
    baselines: Sequence[Baseline] = BASELINES,
    delays: Sequence[int] | None = None,
) -> dict[tuple[str, int], Tuned]:
    """Run the same search for every baseline at every delay; ``evaluate`` maps a baseline's parameters to figures."""
    every = list(baselines_of(baselines, bench.delays if delays is None else delays))
    return {
        (baseline.name, delay): search(baseline.space, partial(evaluate, baseline, delay), bench.budget)
        for baseline, delay in bench.progress.track(every, description=f"tuning: {title}")
        if baseline.space
    } | {(baseline.name, delay): Tuned({}, []) for baseline, delay in every if not baseline.space}


def tune_on(
    bench: Bench,
    seen: Floats,
    truth: Floats,
    stamps_s: Floats,
    title: str,
    baselines: Sequence[Baseline] = BASELINES,
    delays: Sequence[int] | None = None,
) -> dict[tuple[str, int], Tuned]:
    """Run `tune` for the least mean errors of clips ``seen`` (T, C, 22, 3), metres, against their ``truth``."""

    def evaluate(baseline: Baseline, delay: int, parameters: Mapping[str, float]) -> dict[str, float]:
        return errors_mm(baseline.run(seen, stamps_s, delay, **parameters), truth)

    return tune(bench, evaluate, title, baselines, delays)


def tuning_log(tuned: Mapping[tuple[str, int], Tuned]) -> list[dict[str, Any]]:
    """Return all evaluated points, for the results file."""
    return [
        {"method": name, "delay": delay, "best": found.parameters, "tried": found.tried}
        for (name, delay), found in tuned.items()
        if found.tried
    ]


def over_seeds(records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Merge the records of several seeds into one for each method, delay and condition: their means."""
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for record in records:
        key = (record["method"], record["delay"], record.get("condition"))
        groups.setdefault(key, []).append(record)
    return [group[0] if len(group) == 1 else _averaged(group) for group in groups.values()]


def _averaged(group: Sequence[dict[str, Any]]) -> dict[str, Any]:
    return {
        name: round(float(np.mean([record[name] for record in group])), 4)
        if isinstance(value, float) and all(name in record for record in group)
        else value
        for name, value in group[0].items()
    } | {"seeds": len(group)}


ROUNDS = 50
SIZE = 44  # number of states of a whole body along one axis: positions and velocities of 22 joints
STEPS = 30


def numpy_ms() -> float:
    """Run 30 steps of a Kalman filter of 44 states `ROUNDS` times, and return the least time.

    The workload contains no code of this product. Times are the thread's processor time, milliseconds.
    """
    rng = np.random.default_rng(0)
    transition = np.eye(SIZE) + np.eye(SIZE, k=SIZE // 2) / 30
    process = np.cov(rng.standard_normal((SIZE, 4 * SIZE)))
    seen = rng.standard_normal((STEPS, SIZE // 2))
    took = []
    for _ in range(ROUNDS):
        state, covariance = np.zeros(SIZE), np.eye(SIZE)
        began = time.thread_time()
        for measured in seen:
            state, covariance = transition @ state, transition @ covariance @ transition.T + process
            gain = np.linalg.solve(covariance[: SIZE // 2, : SIZE // 2] + np.eye(SIZE // 2), covariance[: SIZE // 2]).T
            state = state + gain @ (measured - state[: SIZE // 2])
            covariance = covariance - gain @ covariance[: SIZE // 2]
        took.append(time.thread_time() - began)
    return 1e3 * min(took)
