"""Fit the bodies of a whole source: from joints in, by way of `clean`, to messages and arrays out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from steadypose.msgs.types import Message, PoseRaw
from steadypose.nodes.commands.fitting import Fit, Seen, bodies_seen, fit_body, ground_plane, rewritten
from steadypose.nodes.commands.key_points import in_sight
from steadypose.nodes.driving import stream
from steadypose.nodes.graph.settings import LaunchError
from steadypose.nodes.sinks.npz import NpzCollector
from steadypose.nodes.sources.npz import NpzError
from steadypose.nodes.sources.source import RecordedSource
from steadypose.prior.arrays import Floats
from steadypose.prior.clean.adapt import SensorFrame

if TYPE_CHECKING:
    from steadypose.prior.fit.humor_network import HumorNet
    from steadypose.prior.fit.windows import FittedTrack


@dataclass(frozen=True)
class Fitted:
    """What came of a source.

    Attributes:
        messages: of all topics, with poses replaced by the fitted ones.
        stamps_ns: (T,) of its frames.
        fits: of each body, for as long as it was seen.
    """

    messages: list[tuple[str, Message]]
    stamps_ns: NDArray[np.int64]
    fits: list[Fit]


def load_transitions(weights: str) -> HumorNet:
    """The model of transitions of a weight set."""
    from steadypose.prior.fit.humor_network import HumorConfig, HumorNet
    from steadypose.prior.fit.tensors import load_network

    return load_network(HumorNet, HumorConfig.from_dict, weights, "humor")


def fit_source(
    frames: RecordedSource,
    name: str,
    points: ArrayLike | None,
    *,
    model: HumorNet,
    delay: int,
    folder: Path | None = None,
    began: Callable[[Sequence[Seen]], None] = lambda bodies: None,
    advanced: Callable[[], None] = lambda: None,
) -> Fitted:
    """Fit 3D joints, initialised by the nodes' own pipelines.

    Args:
        frames: the source.
        name: what errors call it.
        points: (T, N, 3) metres of the body's surface, in the sensor's frame, NaN where there are fewer.
        model: of transitions.
        delay: of the initialisation, frames at 30 Hz.
        folder: for finished windows, so that the same call goes on where it was stopped.
        began: called with the bodies.
        advanced: called after each window.

    Raises:
        LaunchError: nobody is seen for long enough.
        NpzError: points of the wrong form.
    """
    from steadypose.nodes.graph.prior_node import make_prior
    from steadypose.nodes.graph.trajectory_node import make_trajectory
    from steadypose.prior.fit.solve import FitSettings
    from steadypose.prior.fit.windows import MIN_FRAMES

    surface = _surface(name, points, len(frames))
    messages = list(stream(frames, make_prior({"delay": delay}), make_trajectory({})))
    bodies = bodies_seen(messages, MIN_FRAMES)
    if not bodies:
        raise LaunchError(
            f"{name}: expected somebody who is seen for {MIN_FRAMES} frames or more, found nobody; is the skeleton "
            "right, are the units metres? `steadypose info` says what it holds"
        )
    stamps = np.array([m.stamp_ns for _, m in messages if isinstance(m, PoseRaw) and not m.end_of_stream], np.int64)
    began(bodies)
    fits = []
    for number, seen in enumerate(bodies):
        own = None
        if folder is not None:
            own = folder / f"{number:04d}"
            own.mkdir(exist_ok=True)
        near = None
        if surface is not None:
            nearest = np.abs(stamps[None] - seen.stamps_ns[:, None]).argmin(axis=1)
            near = np.stack([
                SensorFrame.of(message.sensor_pose).to_world(frame)
                for message, frame in zip(seen.clean, surface[nearest], strict=True)
            ])  # fmt: skip
        fits.append(fit_body(model, seen, near, FitSettings(), own, advanced))
    return Fitted(rewritten(messages, fits), stamps, fits)


def fitted_arrays(fitted: Fitted) -> dict[str, NDArray[Any]]:
    """The arrays of ``clean``, a row for each frame; of one body that was fitted, with its bones and the ground."""
    collector = NpzCollector()
    for _, message in fitted.messages:
        collector.add(message)
    arrays = collector.arrays(fitted.stamps_ns)
    tracks = {fit.seen.id: fit.track for fit in fitted.fits if fit.track is not None}
    return with_bones(arrays, next(iter(tracks.values()))) if len(tracks) == 1 else arrays


def with_bones(arrays: dict[str, NDArray[Any]], track: FittedTrack) -> dict[str, NDArray[Any]]:
    """With bones and ground, where there is one person; of several, .misfit.npz has them for each."""
    bones = np.linalg.norm(track.offsets.mean(axis=0), axis=-1)
    return arrays | {"bone_lengths": bones, "ground_plane": ground_plane(track.ground.mean(axis=0))}


def _surface(name: str, points: ArrayLike | None, frames: int) -> Floats | None:
    """(T, N, 3) metres, points that a camera can see."""
    if points is None:
        return None
    points = np.asarray(points)
    if points.dtype.kind not in "fiu" or points.ndim != 3 or len(points) != frames or points.shape[-1] != 3:
        raise NpzError(
            f"{name}: points: expected ({frames}, N, 3) metres, NaN for what is missing, got {points.dtype} "
            f"{points.shape}"
        )
    return in_sight(points.astype(np.float64))
