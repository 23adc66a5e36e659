"""What every reader gives: one recording, its joints in metres, z up, and where it comes from."""

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
"""Turns a y-up frame into a z-up one by a quarter turn about x (both right-handed)."""

TO_Z_UP: Mapping[str, NDArray[np.float64]] = {"z": np.eye(3), "y": Y_UP_TO_Z_UP, "-y": Y_UP_TO_Z_UP.T}
"""By the axis that points up."""


P = ParamSpec("P")
R = TypeVar("R")


def documented(read: Callable[P, R]) -> Callable[P, R]:
    """A reader whose every error is a `MotionError`: of damaged files numpy, zipfile and scipy raise dozens."""

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
    """One recording of one person.

    Attributes:
        name: unique within its source.
        source: the data set.
        licence: its licence, as an SPDX identifier where there is one.
        subject: who moves, as far as the source tells.
        action: what they do, as far as the source tells; else empty.
        fps: frames a second.
        skeleton: whose joints ``positions`` holds.
        positions: (T, J, 3) metres, z up; NaN where missing.
    """

    name: str
    source: str
    licence: str
    subject: str
    action: str
    fps: float
    skeleton: Skeleton
    positions: NDArray[np.float64]

    @property
    def person(self) -> str:
        """Who moves, by one name in all files of a source: see `person_of`."""
        return person_of(self.source, self.subject)

    @property
    def seconds(self) -> float:
        """Duration."""
        return len(self.positions) / self.fps

    def canonical(self) -> Clip:
        """The same recording with the canonical joints.

        Raises:
            MotionError: the skeleton's table leaves a canonical joint out; training needs complete bodies.
        """
        if not self.skeleton.observable.all():
            raise MotionError(f"{self.name}: the table of '{self.skeleton.name}' does not give all 22 joints")
        return replace(self, skeleton=CANONICAL, positions=to_canonical(self.skeleton, self.positions)[0])


def person_of(source: str, subject: str) -> str:
    """A person's name among all sources: CMU's subject 02 is one person in whatever form the file comes."""
    return f"{source.partition(' (')[0]} {subject}"


def forward(
    parents: Sequence[int], offsets: NDArray[np.float64], local: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions of any skeleton from its local rotations.

    Args:
        parents: of J joints, each before its children; -1 for a root.
        offsets: (J, 3) or, with bones that move, (T, J, 3), each joint in its parent's frame; a root's is its
            position.
        local: (T, J, 3, 3) rotations.

    Returns:
        positions (T, J, 3) in the unit of ``offsets``, and global rotations (T, J, 3, 3).
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
