"""BVH: centimetres, y up, the rest pose a T that faces +z."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from steadypose.nodes.sinks.files.motion import Y_UP, BodyMotion
from steadypose.prior.body.skeleton import CHILDREN, JOINTS, J

CENTIMETRES = 100.0
ORDER = "ZXY"

ENDS = {
    "head": (0.0, 18.0, 3.0),
    "foot": (0.0, 0.0, 7.0),
    "left_wrist": (17.0, 0.0, 0.0),
    "right_wrist": (-17.0, 0.0, 0.0),
}
"""Centimetres, x left, y up, z forward: how far head, feet and hands reach beyond their joints, of a generic adult."""


def to_bvh(motion: BodyMotion, names: Sequence[str] = JOINTS) -> bytes:
    """The file's contents; ``names`` of the 22 joints."""
    lines = ["HIERARCHY"]
    order: list[int] = []

    def write(joint: int, depth: int) -> None:
        order.append(joint)
        offset = CENTIMETRES * Y_UP @ motion.offsets[joint]
        channels = " ".join(f"{axis}rotation" for axis in ORDER)
        rows = [
            f"{'JOINT' if joint else 'ROOT'} {names[joint]}",
            "{",
            f"\tOFFSET {_row(offset)}",
            f"\tCHANNELS 3 {channels}" if joint else f"\tCHANNELS 6 Xposition Yposition Zposition {channels}",
        ]
        lines.extend("\t" * depth + row for row in rows)
        for child in CHILDREN[joint]:
            write(child, depth + 1)
        if not CHILDREN[joint]:
            name = JOINTS[joint]
            end = ENDS.get(name, ENDS.get(name.partition("_")[2]))
            assert end is not None, "head, wrists and feet are all there is without children"
            lines.extend("\t" * (depth + 1) + row for row in ("End Site", "{", f"\tOFFSET {_row(np.array(end))}", "}"))
        lines.append("\t" * depth + "}")

    write(J["pelvis"], 0)
    # The turn of axes, about a rotation on both sides: only its vector turns.
    turns = Rotation.from_rotvec(Rotation.from_quat(motion.rotations[:, order].reshape(-1, 4)).as_rotvec() @ Y_UP.T)
    angles = turns.as_euler(ORDER, degrees=True).reshape(len(motion.root), -1)
    rows = np.concatenate([CENTIMETRES * motion.root @ Y_UP.T, angles], axis=1)
    lines += ["MOTION", f"Frames: {len(rows)}", f"Frame Time: {1 / motion.fps:.9f}", *map(_row, rows)]
    return ("\n".join(lines) + "\n").encode()


def _row(values: np.ndarray) -> str:
    return " ".join(f"{value:.6f}" for value in values)
