"""The output of every reader: one recording, with joints in metres, z up, and its origin."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import wraps
from typing import ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.body.layouts import CANONICAL, Skeleton, to_canonical
from steadypose.prior.npz import MotionError

Y_UP_TO_Z_UP: NDArray[np.float64] = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Rotation from a y-up frame to a z-up frame: a quarter turn about x (both right-handed)."""

TO_Z_UP: Mapping[str, NDArray[np.float64]] = {"z": np.eye(3), "y": Y_UP_TO_Z_UP, "-y": Y_UP_TO_Z_UP.T}
"""Rotations to a z-up frame, by the axis that points up."""


P = ParamSpec("P")
R = TypeVar("R")


def documented(read: Callable[P, R]) -> Callable[P, R]:
    """Convert all errors of a reader to `MotionError`; on damaged files, numpy, zipfile and scipy raise dozens."""

    @wraps(read)
    def reader(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return read(*args, **kwargs)
        except MotionError:
            raise
        except Exception as error:
            raise MotionError(f"cannot be read: {type(error).__name__}: {error}") from error

    return reader


@dataclass(frozen=True)
class Clip:
    """One recording of one person."""

    name: str  # name that is unique within its source
    source: str  # the data set
    licence: str  # its licence, as an SPDX identifier if there is one
    subject: str  # the person, as named by the source
    action: str  # what the person does, as named by the source; otherwise empty
    fps: float  # frames per second
    skeleton: Skeleton  # the skeleton of ``positions``
    positions: NDArray[np.float64]  # (T, J, 3) metres, z up; NaN where missing

    @property
    def seconds(self) -> float:
        """Duration, seconds."""
        return len(self.positions) / self.fps

    def canonical(self) -> Clip:
        """Return the recording with canonical joints.

        Raises:
            MotionError: the skeleton's table lacks a canonical joint; training needs complete bodies.
        """
        if not self.skeleton.observable.all():
            raise MotionError(f"{self.name}: the table of '{self.skeleton.name}' does not give all 22 joints")
        return replace(self, skeleton=CANONICAL, positions=to_canonical(self.skeleton, self.positions)[0])


def person_of(source: str, subject: str) -> str:
    """Return a person's name that is unique among all sources. CMU's subject 02 is one person in every file format."""
    return f"{source.partition(' (')[0]} {subject}"


def forward(
    parents: Sequence[int], offsets: NDArray[np.float64], local: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compute positions (T, J, 3) in the unit of ``offsets`` and global rotations (T, J, 3, 3) of any skeleton from its
    local rotations (T, J, 3, 3).

    ``parents`` come before their children, -1 for a root. ``offsets`` are (J, 3) or, if bones vary, (T, J, 3), each
    joint in its parent's frame; a root's is its position.
    """
    offsets = np.broadcast_to(offsets, local.shape[:-1])
    positions, rotations = np.empty(local.shape[:-1]), np.empty(local.shape)
    for joint, parent in enumerate(parents):
        if parent < 0:
            positions[:, joint], rotations[:, joint] = offsets[:, joint], local[:, joint]
        else:
            step = rotations[:, parent] @ offsets[:, joint, :, None]
            positions[:, joint] = positions[:, parent] + step[..., 0]
            rotations[:, joint] = rotations[:, parent] @ local[:, joint]
    return positions, rotations
