"""What every protocol has in common: its surroundings, its result, and peers and ours run over clips."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rich.progress import Progress

from steadypose.benchmarks import ours
from steadypose.benchmarks.baselines import recurrent, smoothnet, window_vaes
from steadypose.benchmarks.baselines.filters import PEERS, Peer
from steadypose.benchmarks.machine import ROOT
from steadypose.benchmarks.motion import MotionClips, as_set, digest, prepared_clips, prepared_set, simulated_clips
from steadypose.benchmarks.results import Table
from steadypose.benchmarks.tuning import Tuned, search
from steadypose.prior.arrays import Floats
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.fit.hmvae_network import MotionVAE

if TYPE_CHECKING:
    from matplotlib.figure import Figure


DELAYS = (0, 2, 4, 8)
"""Frames at 30 Hz at which methods are compared."""
SEEDS = (0, 1, 2)
"""Seeds of networks trained here, and of random sampling."""
RECURRENT = "GRU of the whole body"


@dataclass(frozen=True)
class Bench:
    """Where a protocol runs.

    Attributes:
        quick: fewer clips, points and steps, to see that all works.
        split: of prepared motion that is scored: ``val`` to choose by, ``test`` to report.
        mocap: folder with ui_prmd.npz, or None.
        data: prepared.npz; where it does not exist, people of the project's own generator take its place.
        progress: bars.
    """

    quick: bool
    mocap: Path | None
    data: Path
    progress: Progress
    split: str = "val"

    @property
    def delays(self) -> tuple[int, ...]:
        return (0, 4) if self.quick else DELAYS

    @property
    def seeds(self) -> tuple[int, ...]:
        return SEEDS[:1] if self.quick else SEEDS

    @property
    def budget(self) -> int:
        """Evaluations that each peer's search may spend, for each delay."""
        return 6 if self.quick else 18

    def clips(self, frames: int = 90, most: int = 32) -> MotionClips:
        """Motion to score."""
        return self._motion(self.split, frames, min(most, 12) if self.quick else most)

    def training_clips(self) -> MotionClips:
        """Training motion, of other people, for the peers that learn."""
        return self._motion("train", 90, 60 if self.quick else 1000)

    def window_vae(self, name: str, frames: int) -> MotionVAE:
        """A model of `window_vaes.MODELS`, trained on training motion, or found in ``runs`` from an earlier call."""
        self.progress.stop()  # training draws a bar of its own
        try:
            if self.quick or not self.data.is_file():
                train, val = as_set(self.training_clips()), as_set(self._motion("val", 90, 12))
                with tempfile.TemporaryDirectory() as runs:
                    return window_vaes.trained(name, frames, train, val, Path(runs), steps=1)
            train, val = (prepared_set(self.data, split) for split in ("train", "val"))
            runs = ROOT / "runs" / f"reconstruction-{digest(self.data)}"
            return window_vaes.trained(name, frames, train, val, runs, window_vaes.STEPS[frames])
        finally:
            self.progress.start()

    def _motion(self, split: str, frames: int, most: int) -> MotionClips:
        if self.data.is_file():
            return prepared_clips(self.data, split, frames, most)
        return simulated_clips(frames, min(most, 60), seed=("val", "train", "test").index(split))

    @cached_property
    def smoothnets(self) -> list[smoothnet.SmoothNet]:
        """One of each seed, trained here and now."""
        motion = self.training_clips()
        steps = 100 if self.quick else 3000
        return [
            smoothnet.train(motion, steps, seed, partial(self.progress.track, description=f"SmoothNet, seed {seed}"))
            for seed in self.seeds
        ]

    @cached_property
    def recurrent(self) -> recurrent.RecurrentDenoiser:
        """The whole-body denoiser, trained here and now."""
        track = partial(self.progress.track, description="recurrent denoiser")
        return recurrent.train(self.training_clips(), self.delays, 50 if self.quick else 3000, 0, track)


@dataclass(frozen=True)
class Result:
    """What a protocol found.

    Attributes:
        tables: for people; the first is printed first.
        data: for programs.
        figures: by name of the file.
    """

    tables: list[Table]
    data: dict[str, Any]
    figures: Mapping[str, Figure] = field(default_factory=dict)


class Answer(NamedTuple):
    """Of one method at one delay."""

    method: str
    delay: int
    stamps_s: Floats  # (T',): those of the frames, or where a method has a grid of its own, of that
    positions: Floats  # (T', C, 22, 3)
    parameters: Mapping[str, float]
    sigma: Floats | None = None  # (T', C, 22)


class Methods(NamedTuple):
    """What is compared.

    Attributes:
        peers: those without training.
        ours: steadypose's variants.
        delays: frames.
        networks: whether the peers that are trained here take part.
    """

    peers: Sequence[Peer]
    ours: Mapping[str, PriorSettings]
    delays: Sequence[int]
    networks: bool = True

    @classmethod
    def all(cls, bench: Bench, peers: Sequence[Peer] = PEERS) -> Methods:
        """These peers, and every variant of ours."""
        return cls(peers, ours.OURS, bench.delays)


def peers_of(peers: Sequence[Peer], delays: Sequence[int]) -> Iterator[tuple[Peer, int]]:
    """Every peer with every delay that it has."""
    for peer in peers:
        for delay in delays if peer.delays is None else peer.delays:
            yield peer, delay


def answers(
    bench: Bench,
    seen: Floats,
    stamps_s: Floats,
    tuned: Mapping[tuple[str, int], Tuned],
    title: str,
    methods: Methods | None = None,
) -> Iterator[Answer]:
    """All methods over clips (T, C, 22, 3), each with the parameters found for it; a network once for each seed."""
    methods = methods or Methods.all(bench)
    delays = methods.delays

    def by_peer(peer: Peer, delay: int) -> list[Answer]:
        parameters = tuned[peer.name, delay].parameters
        return [Answer(peer.name, delay, stamps_s, peer.run(seen, stamps_s, delay, **parameters), parameters)]

    def by_network(number: int) -> list[Answer]:
        found = smoothnet.smooth(bench.smoothnets[number], seen, delays)
        return [
            Answer("SmoothNet-style", delay, stamps_s, positions, {})
            for delay, positions in zip(delays, found, strict=True)
        ]

    def by_recurrent() -> list[Answer]:
        found = zip(delays, recurrent.smooth(bench.recurrent, seen), strict=True)
        return [Answer(RECURRENT, delay, stamps_s, positions, {}) for delay, positions in found]

    def by_us(name: str, delay: int) -> list[Answer]:
        cleaned = ours.run(methods.ours[name], seen, stamps_s, delay)
        return [Answer(name, delay, cleaned.stamps_s, cleaned.positions, {}, cleaned.sigma)]

    jobs: list[Callable[[], list[Answer]]] = [partial(by_peer, *one) for one in peers_of(methods.peers, delays)]
    if methods.networks:
        jobs += [*(partial(by_network, number) for number in range(len(bench.seeds))), by_recurrent]
    jobs += [
        partial(by_us, name, delay)
        for name, settings in methods.ours.items()
        for delay in delays
        if ours.available(settings, delay)
    ]
    for job in bench.progress.track(jobs, description=title):
        yield from job()


def tune(
    bench: Bench,
    evaluate: Callable[[Peer, int, Mapping[str, float]], dict[str, float]],
    title: str,
    peers: Sequence[Peer] = PEERS,
    delays: Sequence[int] | None = None,
) -> dict[tuple[str, int], Tuned]:
    """The same search for every peer at every delay; ``evaluate`` gives the figures of a peer's parameters."""
    every = list(peers_of(peers, bench.delays if delays is None else delays))
    return {
        (peer.name, delay): search(peer.space, partial(evaluate, peer, delay), bench.budget)
        for peer, delay in bench.progress.track(every, description=f"tuning: {title}")
        if peer.space
    } | {(peer.name, delay): Tuned({}, []) for peer, delay in every if not peer.space}


def tuning_log(tuned: Mapping[tuple[str, int], Tuned]) -> list[dict[str, Any]]:
    """What was tried, for the results file."""
    return [
        {"method": name, "delay": delay, "best": found.parameters, "tried": found.tried}
        for (name, delay), found in tuned.items()
        if found.tried
    ]


def over_seeds(records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Records of one method, delay and condition but several seeds made one: numbers averaged, and their spread."""
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for record in records:
        key = (record["method"], record["delay"], record.get("condition"))
        groups.setdefault(key, []).append(record)
    return [group[0] if len(group) == 1 else _averaged(group) for group in groups.values()]


def _averaged(group: Sequence[dict[str, Any]]) -> dict[str, Any]:
    merged = {
        name: round(float(np.mean([record[name] for record in group])), 4)
        if isinstance(value, float) and all(name in record for record in group)
        else value
        for name, value in group[0].items()
    }
    positions = [record["position_mm"] for record in group]
    return {**merged, "seeds": len(group), "position_sd_over_seeds_mm": round(float(np.std(positions, ddof=1)), 3)}
