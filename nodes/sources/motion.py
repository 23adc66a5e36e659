"""Files of motion as streams: BVH of any rig, TRC, C3D, AMASS' .npz, and arrays, as `prior.mocap.files` reads them."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from steadypose.nodes.sources.npz import ArraySource
from steadypose.prior.body.layouts import CANONICAL

SUFFIXES = (".bvh", ".trc", ".c3d", ".npy")
"""Of files that hold nothing else; an .npz may."""


class MotionSource(ArraySource):
    """The one body of a file of motion, its joints canonical, z up.

    Args:
        path: of the file.
        rig: what it does not say (`prior.mocap.files.Description`), as TOML has it.

    Raises:
        MotionError: it cannot be read, or no body is recognised in it.
    """

    def __init__(self, path: Path, rig: Mapping[str, Any]) -> None:
        from steadypose.prior.mocap.files import describe, read_motion  # scipy, which nodes that play none do without

        fps, positions = read_motion(path.name, path.read_bytes(), describe(rig))
        super().__init__(path, {"positions": positions, "skeleton": np.array(CANONICAL.name), "fps": np.array(fps)})


def holds_motion(path: Path) -> bool:
    """Whether a file is one of motion; an .npz is if it holds poses, as AMASS' do, and no positions."""
    if path.suffix.lower() in SUFFIXES:
        return True
    if path.suffix != ".npz" or not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return {"poses.npy", "trans.npy"} <= set(archive.namelist())
