"""The arrays that ``clean``, ``complete`` and ``fit`` write, read again: as an input, and as messages to draw."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.topics import POSE_CLEAN, POSE_WORLD
from steadypose.msgs.types import CleanBody, JointState, Message, Pose, PoseClean, PoseWorld, Tracking, WorldBody
from steadypose.prior.body.layouts import CANONICAL
from steadypose.prior.body.skeleton import PARENTS

CLEANED = ("world_positions", "state")
"""arrays of an output that an input lacks"""

Arrays = Mapping[str, NDArray[Any]]


def is_output(arrays: Arrays) -> bool:
    """Whether these are the arrays of an output: they name no skeleton, and have joints in the world."""
    return "skeleton" not in arrays and all(name in arrays for name in CLEANED)


def as_input(arrays: Arrays) -> Arrays:
    """An output as the arrays of an input: its observed joints in the world, z up, those imputed NaN; others as are."""
    if not is_output(arrays):
        return arrays
    observed = np.isin(arrays["state"], (JointState.SEEN, JointState.REFINED))
    positions = np.where(observed[..., None], arrays["world_positions"], np.nan)
    kept = {name: arrays[name] for name in ("stamp_ns", "body_id") if name in arrays}
    return kept | {"positions": positions, "skeleton": np.array(CANONICAL.name), "up": np.array("z")}


def as_messages(arrays: Arrays) -> Iterator[tuple[str, Message]]:
    """An output as ``pose/clean`` and ``pose/world``, both in the world, without what went in."""
    several = "body_id" in arrays
    ids = arrays["body_id"].tolist() if several else [0]
    names = [name for name in arrays if name not in ("stamp_ns", "joint_names", "body_id", "bone_lengths")]
    rows = {name: arrays[name] if several else arrays[name][:, None] for name in names if arrays[name].ndim}
    parents = np.maximum(PARENTS, 0)
    for frame, stamp_ns in enumerate(arrays["stamp_ns"].tolist()):
        clean, world = [], []
        for number, body in enumerate(ids):
            row = {name: rows[name][frame, number] for name in rows if len(rows[name]) > frame}
            joints = row["world_positions"]
            if np.isnan(joints).all():
                continue
            shared = {"id": body, "positions": joints, "state": row["state"], "sigma": row["sigma"]}
            clean.append(
                CleanBody(
                    **shared,
                    rotations=row["rotations"],
                    anomaly=float(row["anomaly"]),
                    anomaly_flag=bool(row["anomaly_flag"]),
                    joint_anomaly=row["joint_anomaly"],
                    bone_lengths=np.linalg.norm(joints - joints[parents], axis=-1),
                    raw_positions=np.full_like(joints, np.nan),
                    raw_confidence=np.zeros(len(joints)),
                )
            )
            world.append(
                WorldBody(
                    **shared,
                    root_position=joints[0],
                    root_orientation=row["rotations"][0],
                    root_velocity=row["root_velocity"],
                    covariance=np.zeros((6, 6)),
                    rotations=row["rotations"],
                    contacts=row["contacts"],
                    tracking=Tracking.OK,
                )
            )
        pose = Pose.identity()
        yield POSE_CLEAN, PoseClean(stamp_ns, "world", "arrays", pose, True, 0, clean)
        yield POSE_WORLD, PoseWorld(stamp_ns, "world", "arrays", np.array([0.0, 0.0, 1.0, 0.0]), world)
