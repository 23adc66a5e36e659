"""Ground-truth motion of the protocols: validation clips of prepared motion, or simulated people."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from steadypose.prior.motion.dataset import MotionSet
from steadypose.prior.sim.motion import Motion
from steadypose.prior.sim.scripts import SCRIPTS
from steadypose.prior.timing.rate import FPS

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class MotionClips:
    """Clips of equal length at 30 Hz, side by side.

    Attributes:
        positions: (T, C, 22, 3) metres, world, z up, floor at 0.
        rotations: (T, C, 22, 3, 3) local.
        offsets: (C, 22, 3) metres, each person's bones.
        contacts: (T, C, 8) of `CONTACT_JOINTS`.
        source: what these are, for the results file.
    """

    positions: Floats
    rotations: Floats
    offsets: Floats
    contacts: NDArray[np.bool_]
    source: dict[str, Any]

    @property
    def stamps_s(self) -> Floats:
        """(T,) seconds."""
        return np.arange(len(self.positions)) / FPS

    def every(self, step: int) -> MotionClips:
        """Every n-th clip."""
        return self._take(np.arange(0, len(self.offsets), step))

    def farthest(self, count: int) -> MotionClips:
        """The clips in which the pelvis travels the longest paths over the floor."""
        paths = np.linalg.norm(np.diff(self.positions[:, :, 0, :2], axis=0), axis=-1).sum(axis=0)
        return self._take(np.sort(np.argsort(-paths, kind="stable")[:count]))

    def _take(self, clips: NDArray[np.intp]) -> MotionClips:
        return replace(
            self,
            positions=self.positions[:, clips],
            rotations=self.rotations[:, clips],
            offsets=self.offsets[clips],
            contacts=self.contacts[:, clips],
        )


def prepared_clips(path: Path, split: str, frames: int, most: int) -> MotionClips:
    """Clips that do not overlap, at most ``most`` of them, from ``prepared.npz``: as many of each source, where it has
    them, spread evenly over it."""
    motion = prepared_set(path, split)
    rows = motion.all_windows(frames, frames)
    rows = rows[spread(motion.source[np.searchsorted(motion.clip_start, rows[:, 0], side="right") - 1], most)].T
    return MotionClips(
        positions=motion.positions[rows].numpy().astype(np.float64),
        rotations=motion.rotations[rows].numpy().astype(np.float64),
        offsets=motion.offsets[rows[0]].numpy().astype(np.float64),
        contacts=motion.contacts[rows].numpy().astype(bool),
        source={"file": path.name, "sha256": digest(path), "split": split, "clips": rows.shape[1], "frames": frames},
    )


def spread(sources: NDArray[np.str_], most: int) -> NDArray[np.intp]:
    """Which of (N,) to take, in order: at most so many, as many of each source as it has of an even share."""
    groups = sorted((np.flatnonzero(sources == source) for source in np.unique(sources)), key=len)
    taken: list[NDArray[np.intp]] = []
    for number, group in enumerate(groups):
        share = (most - sum(map(len, taken))) // (len(groups) - number)
        taken.append(group[np.unique(np.linspace(0, len(group) - 1, min(share, len(group))).round().astype(int))])
    return np.sort(np.concatenate(taken))


@lru_cache(maxsize=3)
def prepared_set(path: Path, split: str) -> MotionSet:
    """All clips of ``prepared.npz`` that are free for products."""
    return MotionSet.load(path, "default", split)


def as_set(clips: MotionClips) -> MotionSet:
    """Clips as training reads them, one after the other."""
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
    """The first 16 hexadecimal digits of a file's SHA-256."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:16]


def simulated_clips(frames: int, most: int, seed: int) -> MotionClips:
    """The same of people of the project's own generator, for machines without prepared motion."""
    parts = []
    for motion in _people(seed):
        step = round(1 / (motion.times[1] - motion.times[0]) / FPS)
        count = len(motion.times) // (step * frames)
        kept = slice(0, count * step * frames, step)
        for k in range(count):
            rows = slice(k * frames, (k + 1) * frames)
            parts.append((motion.positions[kept][rows], motion.rotations[kept][rows], motion.offsets,
                          motion.contacts[kept][rows]))  # fmt: skip
        if len(parts) >= most:
            break
    positions, rotations, offsets, contacts = zip(*parts[:most], strict=True)
    return MotionClips(
        positions=np.stack(positions, axis=1),
        rotations=np.stack(rotations, axis=1),
        offsets=np.stack(offsets),
        contacts=np.stack(contacts, axis=1),
        source={"simulated people": True, "seed": seed, "clips": len(positions), "frames": frames},
    )


def _people(seed: int) -> Iterator[Motion]:
    """All people of all scenes, repeated with other bodies and paths."""
    rng = np.random.default_rng(seed)
    while True:
        for script in SCRIPTS.values():
            yield from script(rng)
