"""The pipelines on arrays, for a program that has no stream: what ``steadypose clean`` does for an ``.npz``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from steadypose.nodes.commands.cleaning import stream
from steadypose.nodes.graph.prior_node import make_prior
from steadypose.nodes.graph.trajectory_node import make_trajectory
from steadypose.nodes.sinks.npz import NpzCollector
from steadypose.nodes.sources.npz import ArraySource


def clean(
    positions: ArrayLike,
    *,
    fps: float | None = None,
    stamp_ns: ArrayLike | None = None,
    skeleton: str = "smpl22",
    confidence: ArrayLike | None = None,
    up: str = "z",
    delay: int = 4,
) -> dict[str, NDArray[Any]]:
    """Clean joints, offline: `steadypose clean` on arrays.

    Args:
        positions: (T, J, 3) metres, or (T, B, J, 3) of several bodies; NaN where a joint, or a body, is missing.
        fps: frames a second, of a stream that is regular; else ``stamp_ns``.
        stamp_ns: (T,) whole nanoseconds of capture.
        skeleton: the joints' names and order, such as ``coco17`` (`steadypose.prior.body.layouts`).
        confidence: (T, J) or (T, B, J) 0 to 1, where the source tells it.
        up: the axis of the positions that points up: ``z``, ``y`` or ``-y``.
        delay: frames at 30 Hz that an answer may wait for, 0 to 16; more is smoother.

    Returns:
        The arrays of ``steadypose clean``'s ``.npz``, a row for each of ``positions``: ``positions`` (T, 22, 3)
        metres in the input's frame, ``rotations`` (T, 22, 4) local, xyzw, ``state`` (T, 22)
        `steadypose.msgs.types.JointState`, ``sigma`` (T, 22) metres, ``anomaly`` and ``anomaly_flag`` (T,),
        ``joint_anomaly`` (T, 22), ``contacts`` (T, 8), ``root_velocity`` (T, 3) m/s, ``world_positions`` (T, 22, 3)
        metres, z up, and ``joint_names`` (22,), among them. Of several bodies, an axis B after time, and ``body_id``
        (B,) with as many as were recognised.

    Raises:
        ValueError: an array has the wrong form, or neither fps nor stamp_ns is given; says what was expected.
    """
    given = {"fps": fps, "stamp_ns": stamp_ns, "confidence": confidence}
    arrays = {name: np.asarray(value) for name, value in given.items() if value is not None}
    arrays |= {"positions": np.asarray(positions), "skeleton": np.array(skeleton), "up": np.array(up)}
    source = ArraySource(Path("arrays"), arrays)
    prior, trajectory = make_prior({"delay": delay}), make_trajectory({})
    collector = NpzCollector()
    for _, message in stream(source, prior, trajectory):
        collector.add(message)
    return collector.arrays(source.stamps_ns)
