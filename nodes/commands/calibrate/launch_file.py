"""The calibration in a launch file: read, and written without touching what else is there."""

from __future__ import annotations

import shutil
from pathlib import Path

import tomlkit

from steadypose.msgs.types import Pose
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.settings import LaunchError
from steadypose.nodes.sources.registry import InputSettings
from steadypose.prior.camera.calibration import (
    CalibrationError,
    Intrinsics,
)


def read_launch(path: Path) -> Launch:
    if not path.is_file():
        raise LaunchError(
            f"no launch file at {path}: expected the camera's own; start from a copy of one in launch/ such as oak.toml"
        )
    return Launch.read(path)


def lens_of(path: Path) -> Intrinsics:
    """The lens in a launch file's ``[input.calibration]``."""
    calibration = read_launch(path).settings(InputSettings).calibration
    if not calibration.size:
        raise CalibrationError(f"{path} has no lens in [input.calibration]: first run steadypose calibrate lens")
    width, height = calibration.size
    fx, fy = calibration.focal
    cx, cy = calibration.centre
    return Intrinsics((width, height), (fx, fy), (cx, cy), tuple(calibration.distortion))


def save_calibration(path: Path, *, lens: Intrinsics | None = None, pose: Pose | None = None) -> None:
    """Write what was found to ``[input.calibration]`` of a launch file, which is left as it is otherwise."""
    document = tomlkit.parse(path.read_text(encoding="utf-8"))
    section = document.setdefault("input", tomlkit.table()).setdefault("calibration", tomlkit.table())
    if lens:
        section["size"] = list(lens.size)
        for name in ("focal", "centre", "distortion"):
            section[name] = [round(value, 6) for value in getattr(lens, name)]
    if pose:
        section["position"] = [round(float(value), 5) for value in pose.position]
        section["orientation"] = [round(float(value), 7) for value in pose.orientation]
    # the user's own file: whole, as it was or as it becomes, whatever happens in between
    part = path.with_name(f".{path.name}.part")
    try:
        part.write_text(tomlkit.dumps(document), encoding="utf-8")
        shutil.copymode(path, part)
        Launch.read(part)
        part.replace(path.resolve())
    finally:
        part.unlink(missing_ok=True)
