"""Reads a humanoid from its URDF: joints, ranges, speeds, and which link corresponds to which part of the body.

Only the kinematics are read; meshes may be missing. A floating base is added, because a URDF has none.
"""

# pyright: reportMissingImports=false, reportAttributeAccessIssue=false
# an optional extra that may not be installed; MuJoCo's module has no stubs

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from steadypose.nodes.settings import LaunchError

if TYPE_CHECKING:
    import mujoco

_LIMITED = ("revolute", "prismatic")
_SHAPES = ("visual", "collision", "transmission", "gazebo", "material")
_SIDES = {
    "left": r"^l(eft)?[_-]|[_-]l(eft)?([_-]|$)|^left|^L(?=[A-Z])",
    "right": r"^r(ight)?[_-]|[_-]r(ight)?([_-]|$)|^right|^R(?=[A-Z])",
}
_PARTS = {
    "hip": r"hip|thigh|upper_?leg",
    "knee": r"knee|shin|calf|shank|lower_?leg",
    "foot": r"ankle|foot|sole",
    "shoulder": r"shoulder|upper_?arm",
    "elbow": r"elbow|fore_?arm|lower_?arm",
    "wrist": r"wrist|hand|palm",
}
_LAST = ("foot", "wrist")
"""Parts for which the last of several matching links is used; for all others it is the first."""
PARTS = ("pelvis", "torso", *(f"{side}_{part}" for side in _SIDES for part in _PARTS))
"""Parts of the body that correspond to links."""


@dataclass(frozen=True)
class Robot:
    """A humanoid robot."""

    model: mujoco.MjModel  # MuJoCo's model, with a free joint under the root link
    joints: tuple[str, ...]  # (N,) names of the moving joints, in the model's order
    lower: NDArray[np.float64]  # (N,) lower limits from the URDF, radians or metres
    upper: NDArray[np.float64]  # (N,) upper limits from the URDF, radians or metres
    speed: NDArray[np.float64]  # (N,) largest speeds, rad/s or m/s
    links: Mapping[str, str]  # link of each part in `PARTS`


def load_robot(path: Path, links: Mapping[str, str]) -> Robot:
    """Read a URDF; ``links`` are those of the parts whose link's name does not show it.

    Raises LaunchError if the file cannot be read, a joint has no limits, or no link is found for a part.
    """
    import mujoco

    try:
        root = ET.parse(path).getroot()
    except OSError as error:
        raise LaunchError(f"{path} cannot be read: {error.strerror}") from error
    except ET.ParseError as error:
        raise LaunchError(f"{path} is no URDF: {error}") from error
    limits = _limits(root, path)
    names = [link.get("name", "") for link in root.findall("link")]
    children = {child.get("link") for child in root.iterfind("joint/child")}
    roots = [name for name in names if name not in children]
    if len(roots) != 1:
        raise LaunchError(f"{path}: expected one link without a parent, got {', '.join(roots) or 'none'}")
    _prepare(root)
    try:
        spec = mujoco.MjSpec.from_string(ET.tostring(root, encoding="unicode"))
        spec.body(roots[0]).add_freejoint()
        model = spec.compile()
    except ValueError as error:
        raise LaunchError(f"{path}: {error}") from error
    joints = tuple(model.joint(k).name for k in range(model.njnt) if model.joint(k).name in limits)
    lower, upper, speed = np.array([limits[name] for name in joints]).T
    bodies = [model.body(k).name for k in range(model.nbody)]
    return Robot(model, joints, lower, upper, speed, _links(path, bodies, roots[0], links))


def _limits(root: ET.Element, path: Path) -> dict[str, tuple[float, float, float]]:
    found = {}
    for joint in root.findall("joint"):
        name, kind, limit = joint.get("name", ""), joint.get("type", ""), joint.find("limit")
        if kind in ("fixed", "floating"):
            continue
        if kind not in _LIMITED or limit is None or joint.find("mimic") is not None:
            raise LaunchError(f"{path}: joint {name}: expected revolute or prismatic with a <limit>, got {kind}")
        try:
            low, high, speed = (float(limit.get(key, "nan")) for key in ("lower", "upper", "velocity"))
        except ValueError as error:
            raise LaunchError(f"{path}: joint {name}: {error}") from error
        if not (low < high and speed > 0):
            got = f"{low:g}, {high:g}, {speed:g}"
            raise LaunchError(f"{path}: joint {name}: expected lower < upper and velocity > 0, got {got}")
        found[name] = low, high, speed
    return found


def _prepare(root: ET.Element) -> None:
    """Remove everything but the kinematics, in place."""
    for parent in [root, *root]:
        for element in [child for child in parent if child.tag in _SHAPES]:
            parent.remove(element)
    # kinematics need no masses, so a link without one must not make MuJoCo refuse the robot
    mass = {"balanceinertia": "true", "boundmass": "0.01", "boundinertia": "0.0001"}
    ET.SubElement(ET.SubElement(root, "mujoco"), "compiler", mass, fusestatic="false")


def _links(path: Path, bodies: list[str], base: str, given: Mapping[str, str]) -> dict[str, str]:
    """The link of each part. ``bodies`` are ordered with parents first."""
    if unknown := given.keys() - set(PARTS):
        raise LaunchError(f"links: no part {', '.join(sorted(unknown))}; there are {', '.join(PARTS)}")
    torso = next((b for b in reversed(bodies) if re.search("torso|chest|trunk", b, re.I)), "")
    found = {"pelvis": base, "torso": torso}
    for side, sided in _SIDES.items():
        own = [body for body in bodies if re.search(sided, body)]
        for part, pattern in _PARTS.items():
            named = [body for body in own if re.search(pattern, body, re.I)]
            found[f"{side}_{part}"] = (named[-1] if part in _LAST else named[0]) if named else ""
    found |= given
    for part, link in found.items():
        if link not in bodies:
            missing = f"no link {link!r}" if link else "no link is named"
            remedy = f'with links = {{ {part} = "LINK" }}, name one of {", ".join(bodies[2:])}'
            raise LaunchError(f"{path}: {missing} for {part}: {remedy}")
    return found
