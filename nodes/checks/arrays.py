"""What was probably meant by arrays of the wrong form: the end of an error's sentence, empty where nothing is found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.body.layouts import SKELETONS
from steadypose.prior.settings import nearest


def count_hint(shape: Sequence[int]) -> str:
    """For positions of a shape whose skeleton is not named."""
    if len(shape) not in (3, 4) or shape[-1] != 3:
        return ""
    names = _with_joints(shape[-2])
    return f": {shape[-2]} joints, {' or '.join(names)}?" if names else ""


def skeleton_hint(name: str, shape: Sequence[int]) -> str:
    """For a name that is no skeleton's."""
    plain = name.lower().replace("_", "").replace("-", "").replace(" ", "")
    return (
        nearest(plain, SKELETONS)
        or count_hint(shape)
        or "; of joints of your own, give their layout (docs/library.md, docs/sources.md)"
    )


def axes_hint(shape: Sequence[int], skeleton: str) -> str:
    """For positions whose shape is not that of the skeleton."""
    joints = len(SKELETONS[skeleton].joints)
    if len(shape) == 2 and shape == (joints, 3):
        return "; of a single frame: positions[None], or steadypose.Filter for frame by frame"
    if len(shape) == 2 and shape[-1] in (3 * joints, 2 * joints, 4 * joints):
        return (
            f"; a row of numbers a frame: positions.reshape(len(positions), {joints}, {shape[-1] // joints})[..., :3]"
        )
    if len(shape) == 3 and shape[1:] == (3, joints):
        return "; the last two axes are exchanged: positions.transpose(0, 2, 1)"
    if len(shape) == 3 and shape[0] == joints and shape[2] == 3:
        return "; the first two axes are exchanged: positions.transpose(1, 0, 2)"
    if len(shape) == 4 and shape[0] != joints and shape[1] == joints and shape[3] == 3:
        return "; bodies come after time: positions.transpose(0, 2, 1, 3)"
    if len(shape) in (3, 4) and shape[-2] == joints and shape[-1] == 4:
        return "; the fourth number seems to be a confidence: positions[..., :3], confidence=positions[..., 3]"
    if len(shape) in (3, 4) and shape[-1] == 2:
        return "; two coordinates are key points of an image: steadypose fit lifts them (docs/fit.md)"
    if len(shape) in (3, 4) and shape[-1] == 3 and (names := _with_joints(shape[-2])):
        return f"; {shape[-2]} joints: skeleton {' or '.join(map(repr, names))}?"
    return ""


def stamps_hint(stamps: NDArray[Any], frames: int) -> str:
    """For stamps that are not whole nanoseconds, one a frame."""
    if stamps.ndim != 1 or stamps.dtype.kind not in "fiu":
        return ""
    if len(stamps) != frames:
        return f"; one stamp a frame: {frames} frames, {len(stamps)} stamps"
    if stamps.dtype.kind == "f":
        step = float(np.median(np.diff(stamps))) if frames > 1 else 0.0
        for unit, factor in (("seconds", 10**9), ("milliseconds", 10**6), ("microseconds", 10**3)):
            if 3e6 <= step * factor <= 3e8:
                return f"; these seem to be {unit}: np.round(stamps * {factor:.0e}).astype(np.int64)"
        return "; whole numbers: np.round(stamps).astype(np.int64)"
    return ""


def frames_hint(arrays: Mapping[str, NDArray[Any]]) -> str:
    """For arrays without any time."""
    return ": of a regular stream give fps, 30 for instance" if "positions" in arrays else ""


def _with_joints(count: int) -> list[str]:
    return [skeleton.name for skeleton in SKELETONS.values() if len(skeleton.joints) == count]
