"""Windows of prepared motion for training: sampled, mirrored, resampled, heading-normalised."""

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import get_args

import numpy as np
import roma
import torch
from numpy.lib.npyio import NpzFile
from numpy.typing import NDArray
from torch import Tensor

from steadypose.prior.body.skeleton import MIRROR
from steadypose.prior.mocap.clip import MotionError, person_of
from steadypose.prior.timing.rate import FPS
from steadypose.training.data.datasets import WeightSet

MIN_SPEED = 0.25  # speed added to the joints' speed in the sampling weight of a window, m/s

_ARRAYS = {"clip_start", "split", "set", "rotations", "positions", "offsets", "contacts", "subject", "source"}


@dataclass(frozen=True)
class MotionSet:
    """Prepared clips of one split, concatenated."""

    rotations: Tensor  # (N, 22, 3, 3) local, float32
    positions: Tensor  # (N, 22, 3) metres, world, z up, floor at 0
    offsets: Tensor  # (N, 22, 3) metres, the person's bones in each frame
    contacts: Tensor  # (N, 8) labels
    clip_start: NDArray[np.int64]  # (C + 1,) first frame of each clip, and the end
    subject: NDArray[np.str_] = field(default_factory=lambda: np.empty(0, dtype=np.str_))
    """(C,) person, as named by the source; empty if the clips' origin does not matter"""
    source: NDArray[np.str_] = field(default_factory=lambda: np.empty(0, dtype=np.str_))
    """(C,) data set; empty likewise"""

    @classmethod
    def load(cls, path: Path, weights: str, split: str, *, flat: bool = False) -> "MotionSet":
        """Read ``steadypose prepare``'s output.

        Args:
            path: ``prepared.npz``.
            weights: ``default`` uses clips that are licensed for products; ``research`` uses the others too. Clips of
                ``measure`` validate and test both sets, and train neither.
            split: ``train``, ``val`` or ``test``.
            flat: whether to exclude clips in which people climb onto objects, where contacts are not labelled.

        Raises:
            FileNotFoundError: there is no such file.
            MotionError: the file was not written by `prepare`, has no clip of this split, or the set is unknown.
        """
        if weights not in get_args(WeightSet):
            raise MotionError(f"weights: expected one of {', '.join(get_args(WeightSet))}, got {weights!r}")
        if not path.is_file():
            raise FileNotFoundError(f"no prepared motion at {path}: make it with 'steadypose prepare MOCAP --out DIR'")
        data = _prepared(path, _ARRAYS | {"flat"} if flat else _ARRAYS)
        starts = data["clip_start"]
        uses = {"default", weights} | ({"measure"} if split != "train" else set())
        wanted = (data["split"] == split) & np.isin(data["set"], list(uses))
        if flat:
            wanted &= data["flat"]
        if not wanted.any():
            raise MotionError(
                f"{path} has no clip of split '{split}' for the '{weights}' weights: of your own recordings, put some "
                f"person's into a folder '{split}', and prepare again"
            )
        frames = np.concatenate([np.arange(starts[c], starts[c + 1]) for c in np.flatnonzero(wanted)])
        lengths = np.diff(starts)[wanted]
        return cls(
            rotations=roma.unitquat_to_rotmat(torch.from_numpy(data["rotations"][frames])),
            positions=torch.from_numpy(data["positions"][frames]),
            offsets=torch.from_numpy(np.repeat(data["offsets"][wanted], lengths, axis=0)),
            contacts=torch.from_numpy(data["contacts"][frames]),
            clip_start=np.concatenate([[0], np.cumsum(lengths)]),
            subject=data["subject"][wanted],
            source=data["source"][wanted],
        )

    @cached_property
    def person(self) -> NDArray[np.str_]:
        """(C,) the person, with the same name in all files of a source."""
        return np.array([person_of(*who) for who in zip(self.source, self.subject, strict=True)], dtype=np.str_)

    @property
    def hours(self) -> float:
        """Duration of the motion, hours."""
        return len(self.rotations) / FPS / 3600

    def only(self, clips: NDArray[np.bool_]) -> "MotionSet":
        """Select these clips (C,). Raises ValueError if none is selected."""
        if not clips.any():
            raise ValueError(f"expected at least one of {len(clips)} clips, none is wanted")
        frames = np.concatenate([np.arange(*self.clip_start[c : c + 2]) for c in np.flatnonzero(clips)])
        lengths = np.diff(self.clip_start)[clips]
        return MotionSet(
            self.rotations[frames], self.positions[frames], self.offsets[frames], self.contacts[frames],
            np.concatenate([[0], np.cumsum(lengths)]),
            *(names[clips] if len(names) else names for names in (self.subject, self.source)),
        )  # fmt: skip

    def sample(
        self, count: int, window: int, strides: Sequence[int], generator: np.random.Generator
    ) -> NDArray[np.int64]:
        """(count, window) frame indices of random windows inside clips, each at a random stride (frame rate)."""
        stride = generator.choice(np.asarray(strides), size=count)
        lengths = np.diff(self.clip_start)
        starts = np.empty(count, dtype=np.int64)
        for k in np.unique(stride):
            rows = np.flatnonzero(stride == k)
            room = np.maximum(lengths - (window - 1) * k, 0)
            clip = generator.choice(len(room), size=len(rows), p=room / room.sum())
            starts[rows] = self.clip_start[clip] + (generator.random(len(rows)) * room[clip]).astype(np.int64)
        return starts[:, None] + stride[:, None] * np.arange(window)

    def all_windows(self, window: int, step: int) -> NDArray[np.int64]:
        """(count, window) frame indices of every ``step``-th window of every clip."""
        starts = [
            np.arange(a, b - window + 1, step) for a, b in zip(self.clip_start, self.clip_start[1:], strict=False)
        ]
        return np.concatenate(starts)[:, None] + np.arange(window)


class SpeedWeightedWindows:
    """Draws windows of motion with weights that grow with speed, and each source by the square root of its size: a
    large source of ten exercises would outweigh all others. Without given sources, all clips are one."""

    def __init__(self, motion: MotionSet) -> None:
        lengths = np.diff(motion.clip_start)
        sources = motion.source if len(motion.source) else np.zeros(len(lengths))
        speed = (motion.positions[1:] - motion.positions[:-1]).norm(dim=-1).mean(dim=1).double().numpy() * FPS
        speed = np.append(speed, 0.0)
        speed[motion.clip_start[1:] - 1] = 0.0
        self._passed = np.concatenate([[0.0], np.cumsum(MIN_SPEED + speed)])
        self._room = np.repeat(motion.clip_start[1:], lengths) - np.arange(lengths.sum())
        self._source = np.repeat(np.unique(sources, return_inverse=True)[1], lengths)
        self._chances = lru_cache(maxsize=4)(self._chances_of)

    def sample(
        self, count: int, window: int, strides: Sequence[int], generator: np.random.Generator
    ) -> NDArray[np.int64]:
        """As `MotionSet.sample`."""
        stride = generator.choice(np.asarray(strides), size=count)
        first = np.empty(count, dtype=np.int64)
        for k in np.unique(stride):
            starts, chances = self._chances((window - 1) * int(k) + 1)
            rows = np.flatnonzero(stride == k)
            chosen = np.searchsorted(chances, generator.random(len(rows)) * chances[-1])
            first[rows] = starts[np.minimum(chosen, len(starts) - 1)]
        return first[:, None] + stride[:, None] * np.arange(window)

    def _chances_of(self, span: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the frames at which a window of ``span`` frames can start, and their cumulative weights."""
        starts = np.flatnonzero(self._room >= span)
        worth = self._passed[starts + span] - self._passed[starts]
        source = self._source[starts]
        return starts, np.cumsum(worth / np.sqrt(np.bincount(source, worth))[source])


def _prepared(path: Path, needed: set[str]) -> NpzFile:
    """Open ``prepared.npz`` and check that it has the arrays ``needed``; reads none yet."""
    data = np.load(path) if zipfile.is_zipfile(path) else None
    if not isinstance(data, NpzFile):
        raise MotionError(f"{path}: expected the .npz that 'steadypose prepare' writes")
    if missing := needed - set(data.files):
        raise MotionError(f"{path}: expected what 'steadypose prepare' writes; it lacks {', '.join(sorted(missing))}")
    return data


def describe_data(weights: str, train: MotionSet, val: MotionSet) -> str:
    """Describe the training data of weights, for their card."""
    return (
        f"the '{weights}' set of `steadypose prepare`: {train.hours:.2f} h training, {val.hours:.2f} h validation, "
        "split by subject"
    )


def mirror_rotations(rotations: Tensor) -> Tensor:
    """Mirror local rotations (..., 22, 3, 3) across the body's xz plane, which exchanges left and right."""
    flip = rotations.new_tensor([1.0, -1.0, 1.0])
    return rotations[..., MIRROR.tolist(), :, :] * flip[:, None] * flip


def mirror_offsets(offsets: Tensor) -> Tensor:
    """Mirror bones or root-centred positions (..., 22, 3) across the xz plane, which exchanges left and right."""
    return offsets[..., MIRROR.tolist(), :] * offsets.new_tensor([1.0, -1.0, 1.0])
