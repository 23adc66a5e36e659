"""Data to try the library on: the streams of the project's own simulator, as arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from steadypose import PACKAGE
from steadypose.msgs.types import PoseRaw, PoseWorld
from steadypose.nodes.graph.launch import bundled
from steadypose.nodes.sinks.drawing import to_world
from steadypose.nodes.sources.recording import open_recording
from steadypose.prior.body.layouts import SKELETONS, to_canonical
from steadypose.prior.settings import nearest

BUNDLED = "walk_turn"
"""the one in every installation"""


class SampleError(ValueError):
    """There is no sample of that name here. The text says which there are."""


@dataclass(frozen=True)
class Sample:
    """A stream as a simulated depth camera sees it, with hidden joints, jumps and noise.

    Attributes:
        positions: (T, 22, 3) metres, world, z up; NaN where a joint was not seen. Of several bodies (T, B, 22, 3).
        stamp_ns: (T,) nanoseconds of capture.
        truth: as ``positions``, without noise or gaps, interpolated at these stamps; of each person by number.
    """

    positions: NDArray[np.float64]
    stamp_ns: NDArray[np.int64]
    truth: NDArray[np.float64]


def sample(name: str = BUNDLED) -> Sample:
    """Sample data: ``s = steadypose.sample(); steadypose.clean(s.positions, stamp_ns=s.stamp_ns)``.

    Args:
        name: of a stream. ``walk_turn``, 20 s of a walk, comes with every installation; ``reach``, ``sit_rise``,
            ``wave_hidden_arm``, ``crossing`` (two people), ``leave_reenter`` and ``idle`` are in a checkout only.

    Raises:
        ValueError: it is not here; says which are.
    """
    streams = {file.parent.name: file.parent for file in bundled("sim_data").glob("*/metadata.yaml")}
    if name not in streams:
        hint = nearest(name, streams)
        checkout = "" if (PACKAGE.parents[1] / "pyproject.toml").exists() else "; a checkout of steadypose has more"
        raise SampleError(f"no sample {name!r}{hint}: there are {', '.join(sorted(streams))}{checkout}")
    raws: list[PoseRaw] = []
    truths: list[PoseWorld] = []
    for _, message in open_recording(streams[name]):
        if isinstance(message, PoseRaw):
            raws.append(message)
        elif isinstance(message, PoseWorld):
            truths.append(message)
    ids = sorted({body.id for raw in raws for body in raw.bodies})
    positions = np.full((len(raws), len(ids), 22, 3), np.nan)
    for row, raw in enumerate(raws):
        for body in raw.bodies:
            joints = to_world(body.positions, raw.sensor_pose)
            positions[row, ids.index(body.id)] = to_canonical(SKELETONS[raw.skeleton], joints, body.confidence)[0]
    stamps = np.array([raw.stamp_ns for raw in raws], np.int64)
    truth = _at(truths, stamps)
    alone = len(ids) == truth.shape[1] == 1
    return Sample(positions[:, 0], stamps, truth[:, 0]) if alone else Sample(positions, stamps, truth)


def _at(truths: list[PoseWorld], stamps: NDArray[np.int64]) -> NDArray[np.float64]:
    """(T, B, 22, 3) metres, world, at stamps (T,): between the truth's own, where it is on both sides."""
    times = np.array([message.stamp_ns for message in truths])
    people = sorted({body.id for message in truths for body in message.bodies})
    places = np.full((len(truths), len(people), 22, 3), np.nan)
    for row, message in enumerate(truths):
        for body in message.bodies:
            places[row, people.index(body.id)] = body.positions
    after = np.searchsorted(times, stamps).clip(1, len(times) - 1)
    share = ((stamps - times[after - 1]) / (times[after] - times[after - 1]))[:, None, None, None]
    share = np.where((share >= 0.0) & (share <= 1.0), share, np.nan)
    return (1.0 - share) * places[after - 1] + share * places[after]
