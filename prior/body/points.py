"""Named points, as TRC and C3D files hold them, to the canonical joints: by their names alone, for points have no tree.

Names are taken apart into a side and a part: ``RAnkle``, ``right_ankle``, ``ANKLE_R`` and ``R.Ankle`` are one joint. As
of a sensor, a joint that no point is of stays unobserved.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from steadypose.prior.body.layouts import Skeleton
from steadypose.prior.body.rigs import RigError
from steadypose.prior.body.skeleton import JOINTS

_PARTS = {
    "hjc": "hip", "kjc": "knee", "ajc": "ankle", "toebase": "foot", "bigtoe": "foot", "footindex": "foot",
    "toe": "foot", "toes": "foot", "clavicle": "collar", "sjc": "shoulder", "ejc": "elbow", "wjc": "wrist",
}  # fmt: skip
"""What else a part is called."""
_MIDDLE = {
    "pelvis": "pelvis", "hip": "pelvis", "hips": "pelvis", "midhip": "pelvis", "spine1": "spine1", "spine2": "spine2",
    "spine3": "spine3", "neck": "neck", "midshoulder": "neck", "head": "head",
}  # fmt: skip
_WORDS = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")
_SIDES = {"l": "left", "left": "left", "r": "right", "right": "right"}
_BETWEEN = {"pelvis": "hip", "neck": "shoulder", "head": "ear"}

NEEDED = ("left_hip", "right_hip", "left_shoulder", "right_shoulder")
"""Joints without which no body is placed."""


def recognise_points(names: Sequence[str]) -> Skeleton:
    """The skeleton that named points make up; pelvis, neck and head may be the middle of hips, shoulders and ears.

    Raises:
        RigError: hips or shoulders are not among them.
    """
    table: dict[str, str | dict[str, float]] = {}
    sided: dict[str, str] = {}
    for name in names:
        words = [word.lower() for word in _WORDS.findall(name)]
        sides = {_SIDES[word] for word in words if word in _SIDES}
        part = "".join(word for word in words if word not in _SIDES)
        if len(sides) == 1:
            sided.setdefault(f"{sides.pop()}_{_PARTS.get(part, part)}", name)
        elif part in _MIDDLE:
            table.setdefault(_MIDDLE[part], name)
    for middle, part in _BETWEEN.items():
        ends = [sided[f"{side}_{part}"] for side in ("left", "right") if f"{side}_{part}" in sided]
        if middle not in table and len(ends) == 2:
            table[middle] = dict.fromkeys(ends, 1.0)
    table |= {joint: name for joint, name in sided.items() if joint in JOINTS}
    if missing := [joint for joint in NEEDED if joint not in table]:
        raise RigError(f"expected points of {', '.join(missing)}; got {', '.join(names[:8])}...; say with --rig which")
    return Skeleton("points", tuple(dict.fromkeys(names)), {joint: table[joint] for joint in JOINTS if joint in table})
