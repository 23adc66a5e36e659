"""Joint layouts of sensors: tables that map each sensor's joints to the canonical 22.

A table gives the sensor joints whose weighted mean is a canonical joint. A joint that the sensor lacks has no entry and
stays unobserved. The bundled layouts are in ``layouts.toml``, in the same form as a user's own layouts:

    [skeletons.gym16]
    joints = ["head", "left_shoulder", "l_elbow", ...] # in the order of the messages

    [skeletons.gym16.canonical]                        # only joints that have other names than in smpl22
    left_elbow = "l_elbow"
    spine3 = ["left_shoulder", "right_shoulder"]       # the mean of several joints

A canonical joint without an entry is the sensor joint of the same name, if there is one. Pelvis and neck may also be
interpolated between the midpoints of hips and shoulders, and the head may be the midpoint of the ears.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.skeleton import JOINTS, J, finite_joints

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_MIDDLES: Mapping[str, Mapping[str, float]] = {
    "pelvis": {"hip": 0.85, "shoulder": 0.15},
    "neck": {"hip": -0.1, "shoulder": 1.1},
    "head": {"ear": 1.0},
}
"""Canonical joints that may be means of the midpoints of left and right parts, with the weights of these. A pelvis lies
above the hips, and a neck above the shoulders (training people: by 0.147 and 0.082 of their distance)."""

INTERPOLATED = {"pelvis", "neck"}
"""Canonical joints that `middles` interpolates; a head is in the middle of the ears."""

INTERPOLATED_SIGMA = 0.025
"""Standard deviation along an axis of a pelvis or neck that is interpolated, metres. Their mean errors on validation
people are 17 and 34 mm."""

NEEDED = ("left_hip", "right_hip", "left_shoulder", "right_shoulder")  # canonical joints that every layout must have


@dataclass(frozen=True)
class Skeleton:
    """A sensor's joints and their mapping to the canonical joints."""

    name: str  # the name that messages and files use
    joints: tuple[str, ...]  # the sensor's joint names, in the sensor's order
    table: Mapping[str, str | Mapping[str, float]]
    """canonical joint -> sensor joint, or sensor joints with weights (normalised to sum to 1)"""
    interpolated: frozenset[str] = frozenset()  # canonical joints that are only about where the table has them

    @cached_property
    def to_canonical(self) -> Floats:
        """(22, J) weights; each row sums to 1, or to 0 if the sensor lacks the joint."""
        matrix = np.zeros((len(JOINTS), len(self.joints)))
        for joint, source in self.table.items():
            weights = {source: 1.0} if isinstance(source, str) else source
            total = sum(weights.values())
            for name, weight in weights.items():
                matrix[J[joint], self.joints.index(name)] = weight / total
        return matrix

    @cached_property
    def sigma(self) -> Floats:
        """(22,) metres along an axis, error of the mapping: of joints that are interpolated, 0 of others."""
        return np.where([joint in self.interpolated for joint in JOINTS], INTERPOLATED_SIGMA, 0.0)

    @cached_property
    def observable(self) -> Bools:
        """(22,) which canonical joints this sensor has."""
        return (self.to_canonical != 0).any(axis=1)


CANONICAL = Skeleton("smpl22", JOINTS, {joint: joint for joint in JOINTS})
_SKELETONS: dict[str, Skeleton] = {CANONICAL.name: CANONICAL}
SKELETONS: Mapping[str, Skeleton] = MappingProxyType(_SKELETONS)
"""All skeletons that ``pose/raw`` may name: the bundled ones and the user's own (`add_layouts`)."""

DESCRIBED = "own_"  # beginning of the name of a layout that a program described instead of naming


def middles(ends: Mapping[str, str]) -> dict[str, dict[str, float]]:
    """Return the entries of a table for pelvis, neck and head, as far as these are means of ``ends``.

    Args:
        ends: sensor joints of ``left_hip``, ``right_hip``, ``left_shoulder``, ..., ``right_ear``, as far as there are.
    """
    table = {}
    for middle, parts in _MIDDLES.items():
        weights = {f"{side}_{part}": weight / 2 for part, weight in parts.items() for side in ("left", "right")}
        if weights.keys() <= ends.keys():
            table[middle] = {ends[end]: weight for end, weight in weights.items()}
    return table


def layout_names() -> str:
    """Return the names of all layouts, for messages; without those that a program described instead of naming."""
    return ", ".join(name for name in SKELETONS if not name.startswith(DESCRIBED))


def add_layouts(descriptions: Mapping[str, Any]) -> None:
    """Register layouts by name in this process, of the table ``skeletons`` of a TOML file. Raises ValueError if a
    description is invalid, or its name is already taken."""
    for name, description in descriptions.items():
        skeleton = _described(name, description)
        if _SKELETONS.setdefault(name, skeleton) != skeleton:
            raise ValueError(f"[skeletons.{name}]: expected a name of its own, there is another layout called {name}")


def _described(name: str, description: object) -> Skeleton:
    """Build the layout that a TOML section describes."""
    where = f"[skeletons.{name}]"
    if not isinstance(description, Mapping):
        raise ValueError(f"{where}: expected a section with joints, got {description!r}")
    if strange := sorted(description.keys() - {"joints", "canonical"}):
        raise ValueError(f"{where}: expected joints and canonical, got {', '.join(strange)}")
    joints = _texts(description.get("joints"))
    if not joints or len(set(joints)) != len(joints):
        raise ValueError(f"{where} joints: expected a list of names, each once, got {description.get('joints')!r}")
    given = description.get("canonical", {})
    if not isinstance(given, Mapping):
        raise ValueError(f"{where} canonical: expected a section, got {given!r}")
    table: dict[str, str | dict[str, float]] = {joint: joint for joint in JOINTS if joint in joints}
    ends = (f"{side}_{part}" for side in ("left", "right") for part in ("hip", "shoulder", "ear"))
    between = middles({end: source for end in ends if (source := str(given.get(end, end))) in joints})
    interpolated = between.keys() & INTERPOLATED - table.keys() - given.keys()
    table = between | table
    for joint, source in given.items():
        if joint not in JOINTS:
            raise ValueError(f"{where} canonical: expected joints of smpl22 ({', '.join(JOINTS)}), got {joint!r}")
        names = [source] if isinstance(source, str) else _texts(source)
        unknown = [name for name in names if name not in joints]
        if not names or unknown:
            raise ValueError(
                f"{where} canonical {joint}: expected names of joints, got {unknown if names else source!r}"
            )
        table[joint] = dict.fromkeys(names, 1.0) if len(names) > 1 else names[0]
    if missing := [joint for joint in NEEDED if joint not in table]:
        raise ValueError(f"{where} canonical: expected to find {', '.join(missing)}; say which of the joints they are")
    return Skeleton(name, tuple(joints), table, frozenset(interpolated))


def _texts(value: object) -> list[str]:
    """Return the value if it is a list of strings, otherwise an empty list."""
    return list(value) if isinstance(value, list) and all(isinstance(text, str) for text in value) else []


def to_canonical(
    skeleton: Skeleton, positions: NDArray[np.floating], confidence: NDArray[np.floating] | None = None
) -> tuple[Floats, Floats]:
    """Map a sensor's J joints (..., J, 3) metres, in any frame and NaN where missing, to the canonical 22.

    Returns positions (..., 22, 3), NaN where unobserved, and confidence (..., 22), the least of the sensor joints used,
    0 where unobserved. ``confidence`` (..., J) is all ones if omitted.
    """
    weights = skeleton.to_canonical
    if confidence is None:
        confidence = np.ones(positions.shape[:-1])
    missing = ~finite_joints(positions)
    filled = np.where(missing[..., None], 0.0, positions)
    mapped = weights @ filled
    needs = weights != 0
    unobserved = (missing @ needs.T.astype(np.float64) > 0) | ~skeleton.observable
    mapped[unobserved] = np.nan
    contributors = np.where(needs, confidence[..., None, :], np.inf).min(axis=-1)
    return mapped, np.where(unobserved, 0.0, contributors)


add_layouts(tomllib.loads((Path(__file__).parent / "layouts.toml").read_text(encoding="utf-8")))
COCO17, BLAZEPOSE33, KINECT22 = SKELETONS["coco17"], SKELETONS["blazepose33"], SKELETONS["kinect22"]
AZURE_KINECT32, ZED38 = SKELETONS["azure_kinect32"], SKELETONS["zed38"]
