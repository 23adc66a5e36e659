"""What a program gives the library: arrays, lists, files, layouts of its own; as the sources take them."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import sys
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from steadypose.nodes.graph.loops import compile_missing
from steadypose.nodes.sources.cleaned import as_input
from steadypose.nodes.sources.npz import ArraySource, NpzError
from steadypose.nodes.sources.recording import open_recording
from steadypose.nodes.sources.source import RecordedSource
from steadypose.prior.body.layouts import CANONICAL
from steadypose.prior.body.own_layouts import add_layouts

Positions = ArrayLike | Mapping[str, NDArray[Any]] | str | os.PathLike[str]
"""an array, the arrays of an ``.npz`` or of an earlier call, or the path of a recording, ``.npz`` or ``.csv``"""
SkeletonLike = str | Sequence[str] | Mapping[str, Any]
"""a known name, or a layout of one's own: the names of its joints, or ``joints`` with ``canonical`` as in TOML"""
ARRAYS = Path("arrays")
"""what errors call that which is no file"""


class InputWarning(UserWarning):
    """Something is probably wrong with the input. The text says what was expected, what came, and what to do."""


logger = logging.getLogger("steadypose")


def compile_loops() -> None:
    """Compile what is not in the cache, once for all programs; a minute of silence would look like a hang."""
    compile_missing(logger.warning)


def warn(texts: Iterable[str]) -> None:
    """Tell the caller of the library."""
    for text in texts:
        warnings.warn(text, InputWarning, stacklevel=_callers_level())


def _callers_level() -> int:
    """How far up the stack the program lies, which no warning should blame this package for."""
    level, frame = 1, sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith("steadypose."):
        level, frame = level + 1, frame.f_back
    return level


def skeleton_name(skeleton: SkeletonLike) -> str:
    """The name of a layout; one of the caller's own is made known under a name of its contents.

    Raises:
        ValueError: it describes no skeleton.
    """
    if isinstance(skeleton, str):
        return skeleton
    described = dict(skeleton) if isinstance(skeleton, Mapping) else {"joints": skeleton}
    described["joints"] = [str(joint) for joint in described.get("joints", ())]
    name = "own_" + hashlib.sha256(json.dumps(described, sort_keys=True, default=list).encode()).hexdigest()[:12]
    try:
        add_layouts({name: described})
    except ValueError as error:
        raise NpzError(f"skeleton: {str(error).replace(f'[skeletons.{name}] ', '').strip()}") from error
    return name


def source_of(
    positions: Positions,
    *,
    fps: float | None = None,
    stamp_ns: ArrayLike | None = None,
    skeleton: SkeletonLike | None = None,
    confidence: ArrayLike | None = None,
    up: str | None = None,
) -> RecordedSource:
    """The source of what the library was given.

    Raises:
        ValueError: it cannot be used; says what was expected.
    """
    given = {"fps": fps, "stamp_ns": stamp_ns, "confidence": confidence, "up": up}
    told = {name: as_array(name, value) for name, value in given.items() if value is not None}
    if skeleton is not None:
        told["skeleton"] = np.array(skeleton_name(skeleton))
    if isinstance(positions, (str, os.PathLike)):
        if told:
            raise NpzError(f"{positions}: expected no {', '.join(told)} beside a file, which says so itself")
        return open_recording(Path(positions))
    if isinstance(positions, Mapping):
        return ArraySource(ARRAYS, {**as_input(positions), **told})
    told = {"skeleton": np.array(CANONICAL.name), "up": np.array("z")} | told
    return ArraySource(ARRAYS, {"positions": as_array("positions", positions)} | told)


def as_array(name: str, value: ArrayLike) -> NDArray[Any]:
    """Raises:
    NpzError: it is no array: lists of different lengths, or of something else than numbers.
    """
    try:
        array = np.asarray(value)
    except (ValueError, TypeError, RuntimeError) as error:
        raise NpzError(
            f"{name}: expected numbers of one shape, got {type(value).__name__}, of which numpy says: {error}; frames "
            "without a joint, or without a body, have NaN there, not fewer entries"
        ) from error
    if array.dtype.kind == "O":
        raise NpzError(
            f"{name}: expected numbers, got {type(value).__name__} of objects; what is missing is float('nan'), not "
            "None, in arrays of one shape"
        )
    return array
