"""The offline commands as functions of arrays: `clean`, `complete`, `fit` and `plot`, with the same numbers."""

from __future__ import annotations

import hashlib
import inspect
import json
import logging
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from steadypose.nodes.driving import OfflineRun, Settings
from steadypose.nodes.extras import require_extra
from steadypose.nodes.graph.launch import PIPELINES, check_settings
from steadypose.nodes.graph.loops import compile_missing
from steadypose.nodes.library.poses import Poses
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sinks.plot.figure import draw, save
from steadypose.nodes.sinks.plot.history import history_of_arrays, history_of_path
from steadypose.nodes.sources.npz import ArraySource, NpzError, as_input
from steadypose.nodes.sources.recording import open_recording
from steadypose.nodes.sources.source import RecordedSource
from steadypose.prior.body.layouts import CANONICAL, DESCRIBED, add_layouts
from steadypose.prior.settings import nearest

if TYPE_CHECKING:
    from matplotlib.figure import Figure


Positions = ArrayLike | Mapping[str, ArrayLike] | str | os.PathLike[str]
"""An array; the arrays of an ``.npz`` or of an earlier call; or the path of a recording, ``.npz`` or ``.csv``."""
SkeletonLike = str | Sequence[str] | Mapping[str, Any]
"""The name of a known layout; or a custom layout: its joints' names, or ``joints`` and ``canonical`` as in TOML."""
ARRAYS = Path("arrays")
"""Name in errors of an input that is not a file."""


class InputWarning(UserWarning):
    """The input is probably wrong. The text says what was expected, what came, and what to do."""


logger = logging.getLogger("steadypose")


P = ParamSpec("P")
R = TypeVar("R")


def suggesting(function: Callable[P, R]) -> Callable[P, R]:
    """A public function that answers an unknown keyword with the most similar one that it has."""
    known = inspect.signature(function).parameters
    name = function.__qualname__.removesuffix(".__init__").removesuffix(".__call__")

    @wraps(function)
    def checked(*given: P.args, **named: P.kwargs) -> R:
        for keyword in named:
            if keyword not in known:
                raise TypeError(f"{name}() has no argument {keyword!r}{nearest(keyword, known)}")
        return function(*given, **named)

    return checked


def warn(texts: Iterable[str]) -> None:
    """Issue each text as an `InputWarning` at the caller's line."""
    for text in texts:
        warnings.warn(text, InputWarning, stacklevel=_callers_level())


def _callers_level() -> int:
    """The stack level of the first caller outside this package, to which a warning should point."""
    level, frame = 1, sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith("steadypose."):
        level, frame = level + 1, frame.f_back
    return level


def sections(settings: Settings | None, delay: int) -> Settings:
    """The sections of `PIPELINES`; a delay in ``settings`` takes precedence over ``delay``.

    Raises:
        LaunchError: ``settings`` has another section, or a setting cannot be used.
    """
    given: Settings = {} if settings is None else settings
    named = given if isinstance(given, Mapping) else {given: None}
    for name, part in named.items():
        if name not in PIPELINES or not isinstance(part, Mapping):
            hint = nearest(str(name).partition(".")[0], PIPELINES)
            got = f"{name} = {part!r}" if name in PIPELINES else f"{name!r}{hint}"
            expected = f"sections {', '.join(map(repr, PIPELINES))}, such as {{'prior': {{'delay': 2}}}}"
            raise LaunchError(f"settings: expected {expected}; got {got}")
    found = {name: dict(given.get(name, {})) for name in PIPELINES}
    found["prior"] = {"delay": delay} | found["prior"]
    check_settings(found)
    return found


def skeleton_name(skeleton: SkeletonLike) -> str:
    """The name of a layout. A custom layout is registered under a name derived from its content.

    Raises:
        ValueError: the description is not a valid skeleton.
    """
    if isinstance(skeleton, str):
        return skeleton
    if not isinstance(skeleton, Iterable):
        raise NpzError(f"skeleton: expected the name of a layout, or its joints, got {skeleton!r}")
    described = dict(skeleton) if isinstance(skeleton, Mapping) else {"joints": skeleton}
    if isinstance(joints := described.get("joints"), Iterable) and not isinstance(joints, str):
        described["joints"] = [str(joint) for joint in joints]
    name = DESCRIBED + hashlib.sha256(json.dumps(described, sort_keys=True, default=list).encode()).hexdigest()[:12]
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
    """The source for the arguments of a library function.

    Raises:
        ValueError: the arguments cannot be used. The text says what was expected.
    """
    given = {"fps": fps, "stamp_ns": stamp_ns, "confidence": confidence, "up": up}
    stated = {name: as_array(name, value) for name, value in given.items() if value is not None}
    if skeleton is not None:
        stated["skeleton"] = np.array(skeleton_name(skeleton))
    if isinstance(positions, (str, os.PathLike)):
        source = open_recording(Path(positions))  # says first if there is no such file
        if stated:
            raise NpzError(f"{positions}: expected no {', '.join(stated)} beside a file, which contains it")
        return source
    stamped = stamp_ns is not None or (isinstance(positions, Mapping) and "stamp_ns" in positions)
    if fps is not None and stamped:
        raise NpzError("expected fps, of a regular stream, or stamp_ns, got both; leave fps out")
    if isinstance(positions, Mapping):
        if "positions" not in positions:
            raise NpzError(f"expected an array 'positions' among those given, got {', '.join(positions) or 'none'}")
        named = {name: as_array(name, value) for name, value in positions.items()}
        return ArraySource(ARRAYS, {**as_input(named), **stated})
    stated = {"skeleton": np.array(CANONICAL.name), "up": np.array("z")} | stated
    return ArraySource(ARRAYS, {"positions": as_array("positions", positions)} | stated)


def as_array(name: str, value: ArrayLike) -> NDArray[Any]:
    """Convert a value to an array; what is masked is NaN.

    Raises:
        NpzError: the value is not an array: lists of different lengths, or of something other than numbers.
    """
    try:
        if isinstance(value, np.ma.MaskedArray) and value.mask.any():
            value = np.ma.filled(value.astype(np.float64), np.nan)  # as a bool, NaN would be True
        array = np.asarray(value)
    except (ValueError, TypeError, RuntimeError) as error:
        remedy = "frames without a joint or a body have NaN there, not fewer entries"
        got = f"{type(value).__name__} ({error})"
        raise NpzError(f"{name}: expected numbers of one shape, got {got}; {remedy}") from error
    if array.dtype.kind == "O":
        remedy = "what is missing is float('nan'), not None, in arrays of one shape"
        raise NpzError(f"{name}: expected numbers, got {type(value).__name__} of objects; {remedy}")
    return array


@suggesting
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
        positions: (T, J, 3) metres, or (T, B, J, 3) for several bodies; NaN where a joint or a body is missing. Or the
            arrays of an ``.npz`` by name, or the path of a recording, ``.npz`` or ``.csv``.
        fps: frame rate of a regular stream, Hz; otherwise give ``stamp_ns``.
        stamp_ns: (T,) capture times, integer nanoseconds.
        skeleton: name of the joint layout, such as ``coco17`` (`steadypose.SKELETONS`); default ``smpl22``. Or a custom
            layout: a list of its joints' names, if they are those of smpl22, or a mapping with ``joints`` and
            ``canonical`` as in a launch file (docs/sources.md).
        confidence: (T, J) or (T, B, J) 0 to 1, or True where a joint was seen, if the source provides it.
        up: the axis of the positions that points up: ``z`` (default), ``y`` or ``-y``.
        delay: delay of the output, 0 to 16 frames at 30 Hz; more is smoother.
        settings: ``prior``, ``trajectory`` and ``events`` as in a launch file; they take precedence over ``delay``.

    Returns:
        The arrays of ``steadypose clean``'s ``.npz``, one row per input frame, as a dictionary and as attributes. They
        include ``positions`` (T, 22, 3) metres in the input's frame, ``rotations`` (T, 22, 4) local, xyzw, ``state``
        (T, 22) `JointState`, ``sigma`` (T, 22) metres, ``anomaly`` and ``anomaly_flag`` (T,), ``joint_anomaly``
        (T, 22), ``contacts`` (T, 8), ``root_velocity`` (T, 3) m/s, ``world_positions`` (T, 22, 3) metres, z up (the
        attribute ``world``), and ``joint_names`` (22,). For several bodies, an axis B follows time, and ``body_id``
        (B,) lists the recognised bodies. ``events`` lists what the people do, with begin and end.

    Raises:
        ValueError: an array has the wrong form, or neither fps nor stamp_ns is given. The text says what was expected.

    Warns:
        InputWarning: units, axes or joint order are probably wrong. The texts are also in ``problems``.
    """
    source = source_of(positions, fps=fps, stamp_ns=stamp_ns, skeleton=skeleton, confidence=confidence, up=up)
    checked = sections(settings, delay)
    compile_missing(logger.warning)  # a minute of silence would look like a hang
    run = OfflineRun(source, checked, events=True)
    arrays = run.arrays()
    warn(run.diagnosis.texts)
    return Poses(arrays, run.diagnosis.texts, run.refused, run.timeline.events())


@suggesting
def complete(
    positions: Positions,
    *,
    fps: float | None = None,
    stamp_ns: ArrayLike | None = None,
    skeleton: SkeletonLike | None = None,
    confidence: ArrayLike | None = None,
    up: str | None = None,
    weights: str = "default",
    seed: int | None = None,
) -> Poses:
    """Complete motion, offline: `steadypose complete` on arrays. Arguments that are not listed are as in `clean`.

    Args:
        positions: as in `clean`. Joints that are NaN are missing, and so are frames between stamps more than 1/20 s
            apart.
        confidence: as in `clean`. Joints with confidence 0 are missing.
        weights: weight set of the completer: 'default', or a .safetensors file.
        seed: draw an alternative instead of the expected motion, another with each seed (0 or more): what is missing
            differs from the expected motion by about ``sigma``.

    Returns:
        The arrays of `clean`, with a row every 1/30 s from the first observation to the last.

    Raises:
        ValueError: as in `clean`, or if there is no body.

    Warns:
        InputWarning: as in `clean`.
    """
    from steadypose.nodes.offline import alternative_of, complete_source, load_completer

    if seed is not None and not (isinstance(seed, int | np.integer) and seed >= 0):
        raise NpzError(f"seed: expected a whole number, 0 or more, got {seed!r}")
    source = source_of(positions, fps=fps, stamp_ns=stamp_ns, skeleton=skeleton, confidence=confidence, up=up)
    fill, uncertainty = load_completer(weights)
    completed = complete_source(source, fill, uncertainty)
    if seed is not None:
        completed = alternative_of(completed, uncertainty, seed)
    warn(completed.problems)
    return Poses(completed.arrays(), completed.problems, completed.refused)


@suggesting
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
    """Fit a motion to joints, offline: `steadypose fit` on arrays. Takes a second or more per second of one body.
    Arguments that are not listed are as in `clean`.

    Args:
        points: (T, N, 3) metres, points on the body's surface from a depth camera, in the same frame; padded with NaN.
        weights: weight set of the transition model: 'default', or a .safetensors file.
        delay: delay of `clean`, which initialises the fit, frames at 30 Hz.

    Returns:
        The arrays of `clean`. For a body whose fit failed, they are the output of `clean` with ``anomaly_flag`` set,
        and ``problems`` names the body.

    Warns:
        InputWarning: a fit failed, or as in `clean`.

    Raises:
        ValueError: as in `clean`, or nobody is observed for long enough, or torch is not installed (extra 'train').
    """
    require_extra("train")
    from steadypose.nodes.offline import fit_source, load_transitions

    source = source_of(positions, fps=fps, stamp_ns=stamp_ns, skeleton=skeleton, confidence=confidence, up=up)
    surface = None if points is None else as_array("points", points)
    fitted = fit_source(source, surface, model=load_transitions(weights), delay=delay)
    problems = [f"body {fit.seen.id}: not explained, left as `clean` has it" for fit in fitted.fits if not fit.track]
    problems += fitted.problems
    warn(problems)
    return Poses(fitted.arrays(), problems)


@suggesting
def plot(
    poses: Mapping[str, NDArray[Any]] | str | os.PathLike[str],
    output: str | Path | None = None,
    *,
    body: int | None = None,
) -> Figure:
    """Plot poses, as `steadypose plot` does.

    Args:
        poses: the result of `clean`, `complete` or `fit`; or the path of a recording, or of their output file.
        output: image file to write as well: .png, .svg or .pdf.
        body: id of the body to plot; default: the one observed the longest.

    Returns:
        The figure, which a notebook displays.

    Raises:
        ValueError: there is nothing to plot, or the output cannot be written.
        ModuleNotFoundError: matplotlib is not installed (extra 'view').
    """
    if not isinstance(poses, Mapping | str | os.PathLike):
        expected = "expected what steadypose.clean, complete or fit gave, or the path of a recording"
        raise NpzError(f"{expected}, got {type(poses).__name__}; steadypose.plot(steadypose.clean(joints, fps=30))")
    history = history_of_arrays(poses) if isinstance(poses, Mapping) else history_of_path(Path(str(poses)))
    figure = draw(history, body)
    if output is not None:
        save(figure, Path(output))
    return figure
