"""Writes BVH files as programs of motion capture do, for tests: none of theirs is in the repository."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Joint:
    """A joint of a rest pose.

    Attributes:
        name: in the file.
        parent: its name; None for the root.
        at: (3,) where it is, in the file's unit and axes.
        end: (3,) where an end site below it is, if it has one.
    """

    name: str
    parent: str | None
    at: NDArray[np.float64]
    end: NDArray[np.float64] | None = None


def write_bvh(joints: Sequence[Joint], root: NDArray[np.float64], fps: float, frames: int = 3) -> bytes:
    """The rest pose standing still, its root where it is said to be."""
    places = {joint.name: joint.at for joint in joints}
    lines = ["HIERARCHY"]

    def write(joint: Joint, depth: int) -> int:
        offset = joint.at - places[joint.parent] if joint.parent else np.zeros(3)
        position = "Xposition Yposition Zposition " if joint.parent is None else ""
        rows = [
            f"{'JOINT' if joint.parent else 'ROOT'} {joint.name}",
            "{",
            "\tOFFSET " + " ".join(f"{v:.6f}" for v in offset),
            f"\tCHANNELS {6 if position else 3} {position}Zrotation Xrotation Yrotation",
        ]
        lines.extend("\t" * depth + row for row in rows)
        written = 1 + sum(write(child, depth + 1) for child in joints if child.parent == joint.name)
        if written == 1:
            end = joint.end - joint.at if joint.end is not None else np.zeros(3)
            lines.extend(["\t" * depth + "\tEnd Site", "\t{", "\tOFFSET " + " ".join(f"{v:.6f}" for v in end), "\t}"])
        lines.append("\t" * depth + "}")
        return written

    count = sum(write(joint, 0) for joint in joints if joint.parent is None)
    row = " ".join([*(f"{v:.6f}" for v in root), *["0"] * 3 * count])
    return "\n".join([*lines, "MOTION", f"Frames: {frames}", f"Frame Time: {1 / fps:.7f}", *[row] * frames]).encode()
