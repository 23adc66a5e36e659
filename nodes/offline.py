"""Completes or fits a whole source; shared, like `driving`, by the offline commands and the library."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from steadypose.msgs.topics import POSE_CLEAN, POSE_RAW, POSE_WORLD
from steadypose.msgs.types import Message, PoseRaw
from steadypose.nodes.checks.geometry import check_geometry
from steadypose.nodes.driving import stream
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sinks.arrays import NpzCollector
from steadypose.nodes.sources.npz import ArraySource, NpzError
from steadypose.nodes.sources.recording import with_end
from steadypose.nodes.sources.source import RecordedSource
from steadypose.prior.arrays import Floats
from steadypose.prior.camera.key_points import in_sight
from steadypose.prior.complete.body import Fill, Uncertainty
from steadypose.prior.complete.parts import PartsCompleter
from steadypose.prior.complete.stream import Completion, along_paths, alternative, complete_raws
from steadypose.prior.models.completer import LiveCompleter
from steadypose.prior.models.posture import LivePosture
from steadypose.prior.world.pipeline import TrajectoryPipeline
from steadypose.prior.world.settings import TrajectorySettings

if TYPE_CHECKING:
    from steadypose.prior.fit.bodies import Fit, Seen
    from steadypose.prior.fit.humor_network import HumorNet
    from steadypose.prior.fit.windows import FittedTrack


CHECKED = 100  # about how many frames of a recording are checked for faults before it is completed


class CompletedSource(NamedTuple):
    """The output of `complete_source`."""

    raws: list[PoseRaw]  # the unchanged ``pose/raw``, with the end of the stream
    outputs: list[tuple[str, Message]]  # ``pose/clean`` and ``pose/world`` with their topics, in order
    completion: Completion
    refused: dict[str, int]  # number of refused or dropped messages, by cause
    problems: list[str]  # probable faults of the joints, as text
    bodies: tuple[int, ...]  # ids along the source's axis of bodies, if it has one

    def messages(self) -> list[tuple[str, Message]]:
        """All messages, ordered by stamp."""
        every = [*((POSE_RAW, message) for message in self.raws), *self.outputs]
        return sorted(every, key=lambda pair: pair[1].stamp_ns)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays of ``clean``, one row for each frame of the grid that has a body."""
        stamps_ns = np.array([message.stamp_ns for message in self.completion.clean[:-1]], np.int64)
        return NpzCollector(self.outputs, self.bodies).arrays(stamps_ns)


def load_completer(weights: str) -> tuple[PartsCompleter, Uncertainty]:
    """Load the completer of a weight set, and its output's uncertainty."""
    completer = LiveCompleter.load(weights)
    config, posture = completer.config, LivePosture.load(weights)
    return PartsCompleter(completer), Uncertainty(config.far_sigma, config.half_frames, posture)


def complete_source(
    frames: RecordedSource,
    fill: Fill,
    uncertainty: Uncertainty,
    advanced: Callable[[int, int], None] = lambda frames, total: None,
) -> CompletedSource:
    """Complete a source; the other arguments are those of `complete_raws`.

    Raises LaunchError if no frame could be read, CompletionError as `complete_raws`.
    """
    raws = [message for _, message in with_end(frames) if isinstance(message, PoseRaw)]
    if not raws:
        raise LaunchError(f"{frames.path}: expected frames, but none of {len(frames)} could be read")
    completion = complete_raws(str(frames.path), raws[:-1], fill, uncertainty, advanced)
    outputs, counters = _outputs(completion)
    refused = {cause: n for cause, n in (frames.refused + counters).items() if n}
    bodies = frames.bodies if isinstance(frames, ArraySource) else ()
    problems = [text for text in _problems(raws) if not text.startswith("root_relative")]  # `complete` is for those too
    return CompletedSource(raws, outputs, completion, refused, problems, bodies)


def alternative_of(completed: CompletedSource, uncertainty: Uncertainty, seed: int) -> CompletedSource:
    """Draw another completion of the same source with a random seed."""
    completion = alternative(completed.completion, completed.raws[:-1], uncertainty, seed)
    return completed._replace(completion=completion, outputs=_outputs(completion)[0])


def _outputs(completion: Completion) -> tuple[list[tuple[str, Message]], Counter[str]]:
    """A completion's ``pose/clean`` and ``pose/world`` with their topics, and what the latter refused."""
    settings = TrajectorySettings()
    pipeline, outputs = TrajectoryPipeline(settings), list[tuple[str, Message]]()
    for message, moved in zip(completion.clean, along_paths(completion, settings.weights), strict=True):
        outputs.append((POSE_CLEAN, message))
        outputs += [(POSE_WORLD, world) for world in pipeline.process(moved)]
    return outputs, pipeline.counters


def _problems(raws: Sequence[PoseRaw]) -> list[str]:
    """The problems with the joints of a stream that has ended, as texts; its stamps are not checked."""
    return list(map(str, check_geometry(raws[: -1 : max(len(raws) // CHECKED, 1)])))


class Fitted(NamedTuple):
    """The output of `fit_source`."""

    messages: list[tuple[str, Message]]  # messages of all topics, with the fitted poses
    stamps_ns: NDArray[np.int64]  # (T,) stamps of the source's frames, nanoseconds
    fits: list[Fit]  # the fit of each body over the time that it was observed
    problems: list[str]  # what is wrong with the source's joints
    bodies: tuple[int, ...]  # ids along the source's axis of bodies, if it has one

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays of ``clean``, one row per frame. If exactly one body was fitted, also its bones and the ground."""
        arrays = NpzCollector(self.messages, self.bodies).arrays(self.stamps_ns)
        tracks = {fit.seen.id: fit.track for fit in self.fits if fit.track is not None}
        return with_bones(arrays, next(iter(tracks.values()))) if len(tracks) == 1 else arrays


def load_transitions(weights: str) -> HumorNet:
    """Load HuMoR's transition model of a weight set."""
    from steadypose.prior.fit.humor_network import HumorConfig, HumorNet
    from steadypose.prior.fit.tensors import load_network

    return load_network(HumorNet, HumorConfig.from_dict, weights, "humor")


def fit_source(
    frames: RecordedSource,
    points: ArrayLike | None,
    *,
    model: HumorNet,
    delay: int,
    folder: Path | None = None,
    began: Callable[[Sequence[Seen]], None] = lambda bodies: None,
    advanced: Callable[[], None] = lambda: None,
) -> Fitted:
    """Fit a motion to 3D joints, initialised by the nodes' own pipelines.

    Args:
        frames: the source.
        points: (T, N, 3) metres, points on the body's surface in the sensor's frame; padded with NaN.
        delay: delay of the initial estimate, frames at 30 Hz.
        model, folder, began, advanced: as in `prior.fit.bodies.fit_stream`.

    Raises:
        LaunchError: nobody is observed for long enough.
        NpzError: the points have the wrong form.
    """
    from steadypose.nodes.graph.prior_node import make_prior
    from steadypose.nodes.graph.trajectory_node import make_trajectory
    from steadypose.prior.fit.bodies import fit_stream, rewritten
    from steadypose.prior.fit.windows import MIN_FRAMES

    surface = None if points is None else _surface(frames, np.asarray(points))
    messages = list(stream(frames, make_prior({"delay": delay}), make_trajectory({})))
    fits = fit_stream(messages, surface, model, folder, began, advanced)
    if not fits:
        expected = f"expected somebody for {MIN_FRAMES} frames or more, got nobody"
        raise LaunchError(f"{frames.path}: {expected}; are skeleton and units right? See `steadypose info`")
    raws = [message for _, message in messages if isinstance(message, PoseRaw)]
    stamps = np.array([raw.stamp_ns for raw in raws if not raw.end_of_stream], np.int64)
    bodies = frames.bodies if isinstance(frames, ArraySource) else ()
    return Fitted(rewritten(messages, fits), stamps, fits, _problems(raws), bodies)


def with_bones(arrays: dict[str, NDArray[Any]], track: FittedTrack) -> dict[str, NDArray[Any]]:
    """The arrays with one person's bone lengths and ground plane. For several people, .misfit.npz has them."""
    from steadypose.prior.fit.bodies import ground_plane

    bones = np.linalg.norm(track.offsets.mean(axis=0), axis=-1)
    return arrays | {"bone_lengths": bones, "ground_plane": ground_plane(track.ground.mean(axis=0))}


def _surface(frames: RecordedSource, points: NDArray[Any]) -> Floats:
    """(T, N, 3) metres, without points at an impossible distance from the camera."""
    if points.dtype.kind not in "fiu" or points.ndim != 3 or len(points) != len(frames) or points.shape[-1] != 3:
        got = f"{points.dtype} {points.shape}"
        raise NpzError(f"{frames.path}: points: expected ({len(frames)}, N, 3) metres, NaN if missing, got {got}")
    return in_sight(points.astype(np.float64))
