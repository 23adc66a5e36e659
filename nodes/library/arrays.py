"""The offline commands on arrays, for a program that has no stream: what they do for an ``.npz``, the same numbers."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import sys
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from steadypose.nodes.driving import NOBODY, OfflineRun, Settings
from steadypose.nodes.extras import require_extra
from steadypose.nodes.graph.loops import compile_missing
from steadypose.nodes.library.poses import Poses
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sinks.plot.figure import draw, save
from steadypose.nodes.sinks.plot.history import history_of_arrays, history_of_path
from steadypose.nodes.sources.npz import ArraySource, NpzError, as_input
from steadypose.nodes.sources.recording import open_recording
from steadypose.nodes.sources.source import RecordedSource
from steadypose.prior.body.layouts import CANONICAL, add_layouts
from steadypose.prior.settings import nearest

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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


def sections(settings: Settings | None, delay: int) -> Settings:
    """``prior`` and ``trajectory`` as a program gives them, over ``delay``.

    Raises:
        LaunchError: there is another section.
    """
    given = dict(settings or {})
    for section in given.keys() - {"prior", "trajectory"}:
        hint = nearest(section.partition(".")[0], ("prior", "trajectory"))
        raise LaunchError(
            f"settings: expected sections 'prior' and 'trajectory', each with its settings, such as "
            f"{{'prior': {{'delay': 2}}}}; got {section!r}{hint}"
        )
    return {"prior": {"delay": delay} | dict(given.get("prior", {})), "trajectory": given.get("trajectory", {})}


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
    stated = {name: as_array(name, value) for name, value in given.items() if value is not None}
    if skeleton is not None:
        stated["skeleton"] = np.array(skeleton_name(skeleton))
    if isinstance(positions, (str, os.PathLike)):
        if stated:
            raise NpzError(f"{positions}: expected no {', '.join(stated)} beside a file, which says so itself")
        return open_recording(Path(positions))
    if fps is not None and stamp_ns is not None:
        raise NpzError("expected fps, of a regular stream, or stamp_ns, got both; leave fps out")
    if isinstance(positions, Mapping):
        if "positions" not in positions:
            raise NpzError(f"expected an array 'positions' among those given, got {', '.join(positions) or 'none'}")
        return ArraySource(ARRAYS, {**as_input(positions), **stated})
    stated = {"skeleton": np.array(CANONICAL.name), "up": np.array("z")} | stated
    return ArraySource(ARRAYS, {"positions": as_array("positions", positions)} | stated)


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


def clean(
    positions: Positions,
    *,
    fps: float | None = None,
    stamp_ns: ArrayLike | None = None,
    skeleton: SkeletonLike | None = None,
    confidence: ArrayLike | None = None,
    up: str | None = None,
    delay: int = 4,
    settings: Settings | None = None,
) -> Poses:
    """Clean joints, offline: `steadypose clean` on arrays.

    Args:
        positions: (T, J, 3) metres, or (T, B, J, 3) of several bodies; NaN where a joint, or a body, is missing. Or the
            arrays of an ``.npz``, by name, or the path of a recording, ``.npz`` or ``.csv``.
        fps: frames a second, of a stream that is regular; else ``stamp_ns``.
        stamp_ns: (T,) whole nanoseconds of capture.
        skeleton: the joints' names and order, such as ``coco17`` (`steadypose.SKELETONS`), ``smpl22`` unless given; or
            a layout of your own: a list of its joints' names, where they are those of smpl22, or a mapping with
            ``joints`` and ``canonical`` as in a launch file (docs/sources.md).
        confidence: (T, J) or (T, B, J) 0 to 1, where the source tells it.
        up: the axis of the positions that points up: ``z`` (unless given), ``y`` or ``-y``.
        delay: frames at 30 Hz that an answer may wait for, 0 to 16; more is smoother.
        settings: ``prior`` and ``trajectory`` of a launch file, over these.

    Returns:
        The arrays of ``steadypose clean``'s ``.npz``, a row for each of ``positions``, as a dictionary and as
        attributes: ``positions`` (T, 22, 3) metres in the input's frame, ``rotations`` (T, 22, 4) local, xyzw,
        ``state`` (T, 22) `JointState`, ``sigma`` (T, 22) metres, ``anomaly`` and ``anomaly_flag`` (T,),
        ``joint_anomaly`` (T, 22), ``contacts`` (T, 8), ``root_velocity`` (T, 3) m/s, ``world_positions`` (T, 22, 3)
        metres, z up (the attribute ``world``), and ``joint_names`` (22,), among them. Of several bodies, an axis B
        after time, and ``body_id`` (B,) with as many as were recognised.

    Raises:
        ValueError: an array has the wrong form, or neither fps nor stamp_ns is given; says what was expected.

    Warns:
        InputWarning: the numbers are probably not what they should be: unit, axes, order. Also in ``problems``.
    """
    compile_loops()
    source = source_of(positions, fps=fps, stamp_ns=stamp_ns, skeleton=skeleton, confidence=confidence, up=up)
    run = OfflineRun(source, sections(settings, delay))
    arrays = run.arrays()
    problems = run.diagnosis.texts or ([] if run.poses else [NOBODY])
    warn(problems)
    return Poses(arrays, problems, run.refused)


def complete(
    positions: Positions,
    *,
    fps: float | None = None,
    stamp_ns: ArrayLike | None = None,
    skeleton: SkeletonLike | None = None,
    confidence: ArrayLike | None = None,
    up: str | None = None,
    weights: str = "default",
) -> Poses:
    """Complete motion, offline: `steadypose complete` on arrays.

    Args:
        positions, fps, stamp_ns, skeleton, confidence, up: as of `clean`; what is NaN, or 0 in confidence, is missing,
            and so are frames between stamps more than 1/20 s apart.
        weights: weight set of the completer: 'default', or a .safetensors file of your own.

    Returns:
        The arrays of `clean`, with a row every 1/30 s from the first stamp to the last.

    Raises:
        ValueError: as `clean`; or there is no body.
    """
    from steadypose.nodes.offline import complete_source, load_completer

    source = source_of(positions, fps=fps, stamp_ns=stamp_ns, skeleton=skeleton, confidence=confidence, up=up)
    completed = complete_source(source, "positions", *load_completer(weights))
    return Poses(completed.arrays(), refused=completed.refused)


def fit(
    positions: Positions,
    *,
    fps: float | None = None,
    stamp_ns: ArrayLike | None = None,
    skeleton: SkeletonLike | None = None,
    confidence: ArrayLike | None = None,
    up: str | None = None,
    points: ArrayLike | None = None,
    weights: str = "default",
    delay: int = 8,
) -> Poses:
    """Fit a motion to joints, offline: `steadypose fit` on arrays. Takes seconds for a second of a body.

    Args:
        positions, fps, stamp_ns, skeleton, confidence, up: as of `clean`.
        points: (T, N, 3) metres of the body's surface, in the same frame, from a depth camera; NaN where fewer.
        weights: of the model of transitions: 'default', or a .safetensors file.
        delay: of `clean`, which initialises the fit, frames at 30 Hz.

    Returns:
        The arrays of `clean`. Where a fit failed, those that `clean` gives, with ``anomaly_flag``, and ``problems``
        says so.

    Raises:
        ValueError: as `clean`; nobody is seen for long enough; or torch is not installed (the extra 'train').
    """
    require_extra("train")
    from steadypose.nodes.offline import fit_source, load_transitions

    source = source_of(positions, fps=fps, stamp_ns=stamp_ns, skeleton=skeleton, confidence=confidence, up=up)
    fitted = fit_source(source, "positions", points, model=load_transitions(weights), delay=delay)
    problems = [f"body {fit.seen.id}: not explained, left as `clean` has it" for fit in fitted.fits if not fit.track]
    warn(problems)
    return Poses(fitted.arrays(), problems)


def plot(poses: Positions, output: str | Path | None = None, *, body: int | None = None) -> Figure:
    """Draw what happened, as `steadypose plot` does.

    Args:
        poses: what `clean`, `complete` or `fit` gave; or the path of a recording, or of what they wrote.
        output: picture to write as well: .png, .svg or .pdf.
        body: number of the body to draw; the one seen the longest if left out.

    Returns:
        The figure, which a notebook shows.

    Raises:
        ValueError: there is nothing to draw, or nowhere to write to.
        ModuleNotFoundError: matplotlib is not installed: it comes with the extra 'view'.
    """
    if not isinstance(poses, Mapping | str | os.PathLike):
        raise NpzError(
            f"expected what steadypose.clean, complete or fit gave, or the path of a recording, got "
            f"{type(poses).__name__}; steadypose.plot(steadypose.clean(joints, fps=30))"
        )
    history = history_of_arrays(poses) if isinstance(poses, Mapping) else history_of_path(Path(str(poses)))
    figure = draw(history, body)
    if output is not None:
        save(figure, Path(output))
    return figure
