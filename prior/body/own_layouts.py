"""Joint layouts of a user's own, as TOML describes them.

    [skeletons.gym16]
    joints = ["head", "left_shoulder", "l_elbow", ...] # in the order of the messages

    [skeletons.gym16.canonical]                        # of those that are called otherwise than in smpl22
    left_elbow = "l_elbow"
    spine3 = ["left_shoulder", "right_shoulder"]       # the middle of several

A canonical joint that has no entry is the joint of the same name, where there is one; pelvis, neck and head may also be
the middle of hips, shoulders and ears.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from steadypose.prior.body.layouts import SKELETONS, Skeleton, add_skeleton
from steadypose.prior.body.skeleton import JOINTS

_MIDDLES = {"pelvis": "hip", "neck": "shoulder", "head": "ear"}
NEEDED = ("left_hip", "right_hip", "left_shoulder", "right_shoulder")
"""canonical joints without which no body is placed"""


def add_layouts(descriptions: Mapping[str, Any]) -> None:
    """Make layouts known, by their names, to all of this process.

    Args:
        descriptions: the table ``skeletons`` of a TOML file.

    Raises:
        ValueError: one does not describe a skeleton, or has the name of another.
    """
    for name, description in descriptions.items():
        skeleton = _read(name, description)
        known = SKELETONS.get(name)
        if known is not None and (known.joints, dict(known.table)) != (skeleton.joints, skeleton.table):
            raise ValueError(f"[skeletons.{name}]: expected a name of its own, there is another layout called {name}")
        add_skeleton(skeleton)


def _read(name: str, description: object) -> Skeleton:
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
    for middle, part in _MIDDLES.items():
        ends = (f"left_{part}", f"right_{part}")
        sources = [str(given.get(end, end)) for end in ends]
        if middle not in table and all(source in joints for source in sources):
            table[middle] = dict.fromkeys(sources, 1.0)
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
    return Skeleton(name, tuple(joints), table)


def _texts(value: object) -> list[str]:
    """The list, if it is one of texts, or none."""
    return list(value) if isinstance(value, list) and all(isinstance(text, str) for text in value) else []
