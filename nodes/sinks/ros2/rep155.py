"""A body as in REP-155: the frames of its links, the angles of its joints, and a URDF with both.

REP-155 (ROS for human-robot interaction) defines 15 links and 20 revolute joints, those of ROS's package
``human_description``. In its zero configuration the body stands upright with hanging arms, and every link's frame has x
forward, y left and z up. The canonical skeleton rests in a T pose instead, so the arms' frames differ by 90 degrees.

The frames are exact: each lies at its canonical joint. The joint angles are an approximation by REP-155's model, whose
torso is rigid and bends only forwards, at the pelvis; whose elbows and knees are hinges; and whose shoulders and hips
are fixed in torso and body.
"""

import re
from collections.abc import Mapping
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from steadypose.msgs.types import WorldBody
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import global_rotations
from steadypose.prior.body.skeleton import PARENTS, J

Links = Mapping[str, tuple[Floats, Floats]]
"""Position (3,) metres and rotation (3, 3) in the world of each link, by name."""


class Link(NamedTuple):
    """A link of REP-155 and its counterpart in the canonical skeleton."""

    origin: int  # joint at which it begins
    turned_by: int  # joint whose rotation it has
    rest: Floats  # (3, 3) rotation in the T pose of the canonical skeleton


def _links() -> dict[str, Link]:
    along = np.eye(3)
    links = {
        "body": Link(J["pelvis"], J["pelvis"], along),
        "waist": Link(J["pelvis"], J["spine3"], along),
        "torso": Link(J["neck"], J["spine3"], along),
        "head": Link(J["head"], J["head"], along),
    }
    for side, sign in (("left", 1.0), ("right", -1.0)):
        # about x, from hanging (-z) to the side (+y of the left arm)
        raised = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -sign], [0.0, sign, 0.0]])
        for part in ("shoulder", "elbow", "wrist"):
            joint = J[f"{side}_{part}"]
            links[f"{side[0]}_{part}"] = Link(joint, joint, raised)
        for part in ("hip", "knee", "ankle", "foot"):  # feet are an addition: REP-155 ends at the ankles
            joint = J[f"{side}_{part}"]
            links[f"{side[0]}_{part}"] = Link(joint, joint, along)
    return links


LINKS: Mapping[str, Link] = _links()  # links by name, without the body's id; ``body`` is the root
JOINTS: tuple[str, ...] = (
    "waist", "r_head", "y_head", "p_head",
    *(f"{side}_{joint}" for side in "lr" for joint in ("y_shoulder", "p_shoulder", "r_shoulder", "elbow")),
    *(f"{side}_{joint}" for side in "lr" for joint in ("y_hip", "p_hip", "r_hip", "knee")),
)  # fmt: skip
"""Names of the moving joints, without the body's id."""


def body_name(body_id: int, source: str = "") -> str:
    """A body's id for ROS's names of topics and frames, whose parts must not begin with a digit; with its source, if
    ids are unique only among those of one source."""
    # ROS allows ASCII letters, digits and single underscores
    plain = re.sub("[^0-9A-Za-z]+", "_", source.encode("ascii", "backslashreplace").decode()).strip("_")
    return f"b{body_id & 0xFFFFFFFF:x}" + (f"_{plain}" if plain else "")


def joint_rotations(body: WorldBody) -> Floats:
    """(22, 3, 3) rotations of the canonical joints in the world."""
    return global_rotations(Rotation.from_quat(body.rotations.astype(np.float64)).as_matrix())


def frames(body: WorldBody) -> Links:
    """Position and rotation of every link of a body, world."""
    positions, turned = body.positions.astype(np.float64), joint_rotations(body)
    return {name: (positions[link.origin], turned[link.turned_by] @ link.rest) for name, link in LINKS.items()}


def joint_angles(links: Links) -> dict[str, float]:
    """Angle of every joint of `JOINTS`, radians, from the links' `frames`."""

    def between(parent: str, child: str) -> Floats:
        return links[parent][1].T @ links[child][1]

    roll, yaw, pitch = _euler("XZY", between("torso", "head"))
    angles = {"waist": _about_y(between("body", "torso")), "r_head": roll, "y_head": yaw, "p_head": -pitch}
    for side, sign in (("l", 1.0), ("r", -1.0)):
        first, raised, last = _zxz(between("torso", f"{side}_shoulder"), sign)
        angles[f"{side}_y_shoulder"] = -sign * first
        angles[f"{side}_p_shoulder"] = sign * raised
        angles[f"{side}_r_shoulder"] = sign * last
        angles[f"{side}_elbow"] = -_about_y(between(f"{side}_shoulder", f"{side}_elbow"))
        yaw, spread, swing = _euler("ZXY", between("body", f"{side}_hip"))
        angles[f"{side}_y_hip"] = -yaw
        angles[f"{side}_p_hip"] = sign * spread
        angles[f"{side}_r_hip"] = -swing
        angles[f"{side}_knee"] = -_about_y(between(f"{side}_hip", f"{side}_knee"))
    return {name: angles[name] for name in JOINTS}


def _about_y(turn: Floats) -> float:
    """Angle about y of the nearest rotation about y, radians."""
    return float(np.arctan2(turn[0, 2] - turn[2, 0], turn[0, 0] + turn[2, 2]))


def _euler(axes: str, turn: Floats) -> list[float]:
    """Angles about the axes, such as a, b, c of Rx(a) Rz(b) Ry(c) for ``XZY``, radians."""
    return Rotation.from_matrix(turn).as_euler(axes).tolist()


def _zxz(turn: Floats, sign: float) -> tuple[float, float, float]:
    """Angles a, b, c of Rz(a) Rx(b) Rz(c), radians, with b of the given sign. For a hanging arm (b = 0), a is 0."""
    sine = sign * np.hypot(turn[0, 2], turn[1, 2])
    b = np.arctan2(sine, turn[2, 2])
    if abs(sine) < 1e-6:
        return 0.0, float(b), float(np.arctan2(turn[1, 0], turn[0, 0]))
    a = np.arctan2(sign * turn[0, 2], -sign * turn[1, 2])
    return float(a), float(b), float(np.arctan2(sign * turn[2, 0], sign * turn[2, 1]))


def measures(body: WorldBody) -> dict[str, Floats]:
    """(3,) metres, origin of each URDF link in its parent's frame, in the zero configuration.

    They are the person's measures, independent of the pose: those of the body at rest.
    """
    positions, turned = body.positions.astype(np.float64), joint_rotations(body)
    rest = np.zeros_like(positions)
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            rest[joint] = rest[parent] + turned[parent].T @ (positions[joint] - positions[parent])

    def inside(parent: str, child: str) -> Floats:
        return rest[LINKS[child].origin] - rest[LINKS[parent].origin]

    def below(parent: str, child: str) -> Floats:
        return np.array([0.0, 0.0, -np.linalg.norm(inside(parent, child))])

    measured = {"torso": inside("waist", "torso"), "head": -below("torso", "head")}
    for side in "lr":
        measured |= {
            f"{side}_shoulder": inside("torso", f"{side}_shoulder"),
            f"{side}_elbow": below(f"{side}_shoulder", f"{side}_elbow"),
            f"{side}_wrist": below(f"{side}_elbow", f"{side}_wrist"),
            f"{side}_hip": inside("body", f"{side}_hip"),
            f"{side}_knee": below(f"{side}_hip", f"{side}_knee"),
            f"{side}_ankle": below(f"{side}_knee", f"{side}_ankle"),
        }
    return measured


def urdf(body: str, measured: Mapping[str, Floats]) -> str:
    """The URDF of a person with these `measures`; ``body`` is the suffix of all names of links and joints."""
    robot = ElementTree.Element("robot", name=f"human_{body}")

    def add(link: str, parent: str, joint: str, axis: tuple[float, float, float] | None, origin: Floats) -> None:
        """Add a link and the joint to its parent: a hinge about ``axis``, or a fixed joint if that is None."""
        shape = ElementTree.SubElement(robot, "link", name=f"{link}_{body}")
        kind = "fixed" if axis is None else "revolute"
        hinge = ElementTree.SubElement(robot, "joint", name=f"{joint}_{body}", type=kind)
        ElementTree.SubElement(hinge, "parent", link=f"{parent}_{body}")
        ElementTree.SubElement(hinge, "child", link=f"{link}_{body}")
        ElementTree.SubElement(hinge, "origin", xyz=_numbers(origin), rpy="0 0 0")
        if axis:
            ElementTree.SubElement(hinge, "axis", xyz=_numbers(axis))
            ElementTree.SubElement(hinge, "limit", lower="-3.15", upper="3.15", effort="1000", velocity="100")
        for bone in _BONES.get(link, ()):
            _draw(shape, measured[bone.replace("*", link[0])])

    here = np.zeros(3)
    ElementTree.SubElement(robot, "link", name=f"body_{body}")
    add("waist", "body", "waist", (0, 1, 0), here)
    add("torso", "waist", "torso", None, measured["torso"])
    add("r_head", "torso", "r_head", (1, 0, 0), here)
    add("y_head", "r_head", "y_head", (0, 0, 1), here)
    add("p_head", "y_head", "p_head", (0, -1, 0), here)
    add("head", "p_head", "head", None, measured["head"])
    for side, sign in (("l", 1), ("r", -1)):
        add(f"{side}_y_shoulder", "torso", f"{side}_y_shoulder", (0, 0, -sign), measured[f"{side}_shoulder"])
        add(f"{side}_p_shoulder", f"{side}_y_shoulder", f"{side}_p_shoulder", (sign, 0, 0), here)
        add(f"{side}_shoulder", f"{side}_p_shoulder", f"{side}_r_shoulder", (0, 0, sign), here)
        add(f"{side}_elbow", f"{side}_shoulder", f"{side}_elbow", (0, -1, 0), measured[f"{side}_elbow"])
        add(f"{side}_wrist", f"{side}_elbow", f"{side}_wrist", None, measured[f"{side}_wrist"])
        add(f"{side}_y_hip", "body", f"{side}_y_hip", (0, 0, -1), measured[f"{side}_hip"])
        add(f"{side}_p_hip", f"{side}_y_hip", f"{side}_p_hip", (sign, 0, 0), here)
        add(f"{side}_hip", f"{side}_p_hip", f"{side}_r_hip", (0, -1, 0), here)
        add(f"{side}_knee", f"{side}_hip", f"{side}_knee", (0, -1, 0), measured[f"{side}_knee"])
        add(f"{side}_ankle", f"{side}_knee", f"{side}_ankle", None, measured[f"{side}_ankle"])
    return ElementTree.tostring(robot, encoding="unicode")


_BONES: Mapping[str, tuple[str, ...]] = {
    "torso": ("head", "l_shoulder", "r_shoulder"),
    "waist": ("torso",),
    "l_shoulder": ("*_elbow",), "r_shoulder": ("*_elbow",), "l_elbow": ("*_wrist",), "r_elbow": ("*_wrist",),
    "l_hip": ("*_knee",), "r_hip": ("*_knee",), "l_knee": ("*_ankle",), "r_knee": ("*_ankle",),
}  # fmt: skip
"""Links to whose origins a cylinder is drawn from each link's origin; ``*`` is the side."""
BONE_RADIUS = 0.03  # radius of a drawn bone, metres


def _draw(link: ElementTree.Element, end: Floats) -> None:
    """Add a cylinder from the link's origin to ``end`` (3,) metres in its frame."""
    length = float(np.linalg.norm(end))
    visual = ElementTree.SubElement(link, "visual")
    x, y, z = end / max(length, 1e-9)
    # URDF's cylinder lies along z: rotate it about y, then about z
    ElementTree.SubElement(visual, "origin", xyz=_numbers(end / 2), rpy=_numbers((0.0, np.arccos(z), np.arctan2(y, x))))
    geometry = ElementTree.SubElement(visual, "geometry")
    ElementTree.SubElement(geometry, "cylinder", length=f"{length:.4f}", radius=f"{BONE_RADIUS}")


def _numbers(values: Floats | tuple[float, ...]) -> str:
    return " ".join(f"{value:.4f}" for value in values)
