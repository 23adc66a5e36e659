"""True motion for the studies: clips of prepared motion, or simulated people."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats
from steadypose.prior.sim.motion import Motion
from steadypose.prior.sim.scripts import SCRIPTS
from steadypose.prior.timing.rate import FPS
from steadypose.training.data.dataset import MotionSet


@dataclass(frozen=True)
class MotionClips:
    """Clips of equal length at 30 Hz, side by side."""

    positions: Floats  # (T, C, 22, 3) metres, world, z up, floor at 0
    rotations: Floats  # (T, C, 22, 3, 3) local
    offsets: Floats  # (C, 22, 3) metres, each person's bones
    contacts: NDArray[np.bool_]  # (T, C, 8) labels of `CONTACT_JOINTS`
    source: dict[str, Any]  # description for the results file
    person: NDArray[np.str_]  # (C,) who moves (`benchmarks.scores` averages over people)
    data_set: NDArray[np.str_]  # (C,) data set of each; tables have a column for each, before their mean

    @property
    def stamps_s(self) -> Floats:
        """Stamps (T,), seconds."""
        return np.arange(len(self.positions)) / FPS

    def every(self, step: int) -> MotionClips:
        return self._take(np.arange(0, len(self.offsets), step))

    def farthest(self, count: int) -> MotionClips:
        """Return the ``count`` clips with the longest paths of the pelvis over the floor, equally many of each
        person."""
        paths = np.linalg.norm(np.diff(self.positions[:, :, 0, :2], axis=0), axis=-1).sum(axis=0)
        order = np.argsort(-paths, kind="stable")
        taken = [order[self.person[order] == who][:share] for who, share in even_shares(self.person, count).items()]
        return self._take(np.sort(np.concatenate(taken)))

    def _take(self, clips: NDArray[np.intp]) -> MotionClips:
        return replace(
            self,
            positions=self.positions[:, clips],
            rotations=self.rotations[:, clips],
            offsets=self.offsets[clips],
            contacts=self.contacts[:, clips],
            person=self.person[clips],
            data_set=self.data_set[clips],
        )


def side_by_side(clips: Sequence[Floats]) -> Floats:
    """Stack clips (T, J, 3) of different lengths into (T, C, J, 3), NaN after their ends."""
    batch = np.full((max(map(len, clips)), len(clips), *clips[0].shape[1:]), np.nan)
    for number, clip in enumerate(clips):
        batch[: len(clip), number] = clip
    return batch


def prepared_clips(path: Path, split: str, frames: int, most: int) -> MotionClips:
    """Return at most ``most`` clips from ``prepared.npz``, without overlap.

    Each person has an equal share where they have as many, spread evenly over their clips.
    """
    motion = prepared_set(path, split)
    rows = motion.all_windows(frames, frames)
    clip = np.searchsorted(motion.clip_start, rows[:, 0], side="right") - 1
    taken = spread(motion.person[clip], most)
    rows, clip = rows[taken].T, clip[taken]
    person = motion.person[clip]
    return MotionClips(
        positions=motion.positions[rows].numpy().astype(np.float64),
        rotations=motion.rotations[rows].numpy().astype(np.float64),
        offsets=motion.offsets[rows[0]].numpy().astype(np.float64),
        contacts=motion.contacts[rows].numpy().astype(bool),
        source={
            "file": path.name, "sha256": digest(path), "split": split, "clips": rows.shape[1], "frames": frames,
            "people": {str(who): int((person == who).sum()) for who in np.unique(person)},
        },
        person=person,
        data_set=motion.source[clip],
    )  # fmt: skip


def spread(people: NDArray[np.str_], most: int) -> NDArray[np.intp]:
    """Return the indices of at most ``most`` of (N,) clips, in order.

    Each person has an equal share where they have as many, spread evenly over their clips.
    """
    taken = []
    for person, share in even_shares(people, most).items():
        own = np.flatnonzero(people == person)
        taken.append(own[np.unique(np.linspace(0, len(own) - 1, share).round().astype(int))])
    return np.sort(np.concatenate(taken))


def even_shares(people: NDArray[np.str_], most: int) -> dict[str, int]:
    """Return each person's share of ``most``. If a person has fewer clips than an even share, the others get the
    rest."""
    names, counts = np.unique(people, return_counts=True)
    shares: dict[str, int] = {}
    for place in np.argsort(counts, kind="stable"):
        even = (most - sum(shares.values())) // (len(names) - len(shares))
        shares[str(names[place])] = min(even, int(counts[place]))
    return shares


@lru_cache(maxsize=3)
def prepared_set(path: Path, split: str) -> MotionSet:
    """Return all clips of ``prepared.npz`` that may be used in products."""
    return MotionSet.load(path, "default", split)


def as_set(clips: MotionClips) -> MotionSet:
    """Return the clips in the form of training data, one after the other."""
    frames, count = clips.positions.shape[:2]

    def in_a_row(values: NDArray[Any]) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(values.swapaxes(0, 1).reshape(frames * count, *values.shape[2:])))

    return MotionSet(
        rotations=in_a_row(clips.rotations).float(),
        positions=in_a_row(clips.positions).float(),
        offsets=torch.from_numpy(np.repeat(clips.offsets, frames, axis=0)).float(),
        contacts=in_a_row(clips.contacts),
        clip_start=np.arange(count + 1) * frames,
    )


@lru_cache(maxsize=2)
def digest(path: Path) -> str:
    """Return the first 16 hexadecimal digits of a file's SHA-256."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:16]


def simulated_clips(frames: int, most: int, seed: int) -> MotionClips:
    """Return simulated clips by the project's own generator, for machines without prepared motion."""
    parts = []
    for number, motion in enumerate(_people(seed)):
        step = round(1 / (motion.times[1] - motion.times[0]) / FPS)
        count = len(motion.times) // (step * frames)
        kept = slice(0, count * step * frames, step)
        for k in range(count):
            rows = slice(k * frames, (k + 1) * frames)
            parts.append((motion.positions[kept][rows], motion.rotations[kept][rows], motion.offsets,
                          motion.contacts[kept][rows], f"simulated {number}"))  # fmt: skip
        if len(parts) >= most:
            break
    positions, rotations, offsets, contacts, people = zip(*parts[:most], strict=True)
    return MotionClips(
        positions=np.stack(positions, axis=1),
        rotations=np.stack(rotations, axis=1),
        offsets=np.stack(offsets),
        contacts=np.stack(contacts, axis=1),
        source={"simulated people": True, "seed": seed, "clips": len(positions), "frames": frames},
        person=np.array(people),
        data_set=np.full(len(people), "simulated"),
    )


def _people(seed: int) -> Iterator[Motion]:
    """Yield the people of all scenes, repeated with other bodies and trajectories."""
    rng = np.random.default_rng(seed)
    while True:
        for script in SCRIPTS.values():
            yield from script(rng)
