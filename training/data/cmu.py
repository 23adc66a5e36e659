"""CMU's motion capture: Acclaim skeletons (.asf) and motion (.amc) from the Graphics Lab, with their rig; and clips of
its most common conversion as exponential maps.

Training needs complete bodies, so the tables place missing joints within existing bones, at their heights in the rest
skeleton. Figures in comments are centimetres above the hips; the rest skeleton has pelvis 7.5, spine1 18.5, spine2
31.5, spine3 37.5, collar 48.5, shoulder 51.5, neck 57.5, head 68.5.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import IO

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steadypose.prior.body.rigs import UNITS, Rig, collar, skeleton
from steadypose.prior.mocap.bvh import CMU_BVH
from steadypose.prior.mocap.clip import MotionError, documented, forward
from steadypose.prior.npz import open_npz

# Joints are the far ends of bones. root 10, lowerback 22, upperback 33, thorax 45 (where the clavicles start, 5
# below the shoulders), lowerneck 54, upperneck 63, head 72. The forearm is lradius and, in line with it and free
# to turn about it alone, lwrist: the hand bends at the latter's far end.
CMU_AMC = Rig(
    skeleton(
        "cmu_amc",
        {
            "pelvis": "root",
            "spine1": "lowerback",
            "spine2": {"lowerback": 0.32, "upperback": 0.68},
            "spine3": "upperback",
            "neck": "lowerneck",
            "head": {"upperneck": 0.8, "head": 0.2},
        },
        {
            "hip": "lhipjoint",
            "knee": "lfemur",
            "ankle": "ltibia",
            "foot": "lfoot",
            "collar": collar("upperback", "lowerneck", "lclavicle"),
            "shoulder": "lclavicle",
            "elbow": "lhumerus",
            "wrist": "lwrist",
        },
        lambda joint: re.sub("^l(?!ower)", "r", joint),
    ),
    metres=1.0,
    up="y",
)

INCH = 0.0254  # length of an inch, metres: an ASF gives lengths in inches times its ``length`` unit


def read_expmap(file: IO[bytes]) -> Iterator[tuple[float, str, float, NDArray[np.float64]]]:
    """CMU clips as root translations and exponential maps (``cmu_expmap.npz``).

    The archive's own positions are ignored: its offsets are those of the BVH conversion, which lost the thorax and a
    third of the forearm. These are restored here. Yields for each clip the share of clips read, its name, frames per
    second, and positions (T, J, 3) metres, y up, of the joints of the rig ``cmu_bvh``.
    """
    with open_npz(file, "names", "parents", "offsets_m", "fps") as archive:
        joints = [str(n).replace("HeadEnd", "Head_end") for n in archive["names"]]
        parents = [int(p) for p in archive["parents"]]
        offsets, fps = archive["offsets_m"].copy(), float(archive["fps"])
        for joint, multiple in CMU_BVH.lost_bones.items():
            offsets[joints.index(joint)] = multiple * offsets[parents[joints.index(joint)]]
        wanted = [joints.index(j) for j in CMU_BVH.skeleton.joints]
        names = [n.removesuffix("/expmap") for n in archive.files if n.endswith("/expmap")]
        for done, name in enumerate(names, start=1):
            values = archive[f"{name}/expmap"].astype(np.float64)
            maps = values[:, 3:].reshape(-1, 3)
            # The file's convention is row vectors; the transpose serves columns.
            local = Rotation.from_rotvec(maps).inv().as_matrix().reshape(len(values), len(joints), 3, 3)
            steps = np.tile(offsets, (len(values), 1, 1))
            steps[:, 0] = values[:, :3] * UNITS["CMU"]
            yield done / len(names), name, fps, forward(parents, steps, local)[0][:, wanted]


@dataclass(frozen=True)
class Asf:
    """An Acclaim skeleton. A joint here is the *far end* of the bone whose name it carries; ``root`` is first."""

    joints: tuple[str, ...]  # ``root`` and the bones, parents first
    parents: tuple[int, ...]  # index of each joint's parent; -1 for the root
    offsets: NDArray[np.float64]
    """(J, 3) metres in the skeleton's own axes (y up), from the parent in the pose with all angles 0"""
    axes: NDArray[np.float64]  # (J, 3, 3) the frame in which each bone's angles turn
    freedoms: tuple[tuple[str, ...], ...]
    """the angles each bone has, such as ``('rx', 'rz')``; for the root all six in the file's order"""
    metres: float  # the size of the file's unit


_Bone = tuple[NDArray[np.float64], NDArray[np.float64], tuple[str, ...]]  # offset, axis and freedoms, as in `Asf`


@documented
def read_asf(text: str) -> Asf:
    """Read an Acclaim skeleton. Raises MotionError if a section is missing or cannot be read."""
    sections = _sections(text)
    for name in ("units", "root", "bonedata", "hierarchy"):
        if name not in sections:
            raise MotionError(f"expected a section ':{name}' in the skeleton, found {sorted(sections)}")
    units = _entries(sections["units"])
    root = _entries(sections["root"])
    if units.get("angle") != ["deg"]:
        raise MotionError(f"expected angles in degrees, found {units.get('angle')}")
    metres = INCH / _floats(units.get("length", ["1"]))[0]
    order = tuple(o.lower() for o in root.get("order", []))
    if sorted(order) != ["rx", "ry", "rz", "tx", "ty", "tz"]:
        raise MotionError(f"expected a root with six freedoms, found {order}")
    turned = _floats(root.get("orientation", ["0"] * 3))
    bones: dict[str, _Bone] = {"root": (np.zeros(3), _axis(turned, root.get("axis", ["XYZ"])[0]), order)}
    bones |= _bones(sections["bonedata"], metres)

    joints, parents = ["root"], [-1]
    for line in sections["hierarchy"]:
        parent, *children = line.split()
        if parent in ("begin", "end"):
            continue
        if parent not in joints or not bones.keys() >= set(children):
            raise MotionError(f"the hierarchy names a bone not known before it: '{line.strip()}'")
        joints += children
        parents += [joints.index(parent)] * len(children)
    offsets, axes, freedoms = zip(*(bones[joint] for joint in joints), strict=True)
    return Asf(tuple(joints), tuple(parents), np.array(offsets), np.array(axes), freedoms, metres)


@documented
def read_amc(text: str, skeleton: Asf) -> NDArray[np.float64]:
    """Read an Acclaim motion, (T, J, 3) metres in the axes of the subject's skeleton (y up in CMU's).

    The file does not contain its frame rate; CMU's are 120 Hz. Raises MotionError if it is no AMC, or its bones are not
    the skeleton's.
    """
    angles = _frames(text)
    frames = len(angles["root"]) if "root" in angles else 0
    if not frames:
        raise MotionError("expected frames that move 'root', found none")
    count = len(skeleton.joints)
    steps = np.empty((frames, count, 3))
    local = np.empty((frames, count, 3, 3))
    for j, (name, freedoms) in enumerate(zip(skeleton.joints, skeleton.freedoms, strict=True)):
        values = angles.get(name, np.zeros((frames, 0)))
        if values.shape != (frames, len(freedoms)):
            raise MotionError(f"bone '{name}': expected {len(freedoms)} angles a frame, got {values.shape[1]}")
        at = {freedom: values[:, i] for i, freedom in enumerate(freedoms)}
        zero = np.zeros(frames)
        degrees = np.stack([at.get(f"r{a}", zero) for a in "xyz"], axis=-1)
        turn = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
        axis = skeleton.axes[j]
        local[:, j] = axis @ turn @ axis.T
        if name == "root":
            steps[:, j] = np.stack([at[f"t{a}"] for a in "xyz"], axis=-1) * skeleton.metres
        else:
            # A bone turns about its near end, so its own rotation already moves its far end.
            steps[:, j] = local[:, j] @ skeleton.offsets[j]
    return forward(skeleton.parents, steps, local)[0]


def _sections(text: str) -> dict[str, list[str]]:
    sections: dict[str, list[str]] = {}
    lines: list[str] = []
    for line in text.splitlines():
        if line.startswith(":"):
            name, *rest = line[1:].split(maxsplit=1)
            lines = sections.setdefault(name.lower(), list(rest))
        elif line.strip() and not line.startswith("#"):
            lines.append(line)
    return sections


def _entries(lines: list[str]) -> dict[str, list[str]]:
    return {words[0].lower(): words[1:] for line in lines if (words := line.split())}


def _floats(words: list[str]) -> list[float]:
    try:
        return [float(w) for w in words]
    except ValueError as error:
        raise MotionError(f"expected numbers in the skeleton, found '{' '.join(words)}'") from error


def _axis(degrees: list[float], order: str) -> NDArray[np.float64]:
    # 'XYZ' turns about the fixed x axis first: lower case in scipy.
    return Rotation.from_euler(order.lower(), degrees, degrees=True).as_matrix()


def _bones(lines: list[str], metres: float) -> dict[str, _Bone]:
    bones: dict[str, _Bone] = {}
    for block in "\n".join(lines).split("begin")[1:]:
        entry = _entries(block.splitlines())
        try:
            offset = np.array(_floats(entry["direction"])) * _floats(entry["length"])[0] * metres
            *degrees, order = entry["axis"]
            freedoms = tuple(f.lower() for f in entry.get("dof", []))
            bones[entry["name"][0]] = offset, _axis(_floats(degrees), order), freedoms
        except (KeyError, ValueError, IndexError) as error:
            raise MotionError(f"a bone cannot be read ({error}): '{' '.join(block.split())[:80]}'") from error
    return bones


def _frames(text: str) -> Mapping[str, NDArray[np.float64]]:
    """For each bone, its numbers (T, D). All frames must move the same bones in the same order."""
    lines = [s for line in text.splitlines() if (s := line.strip()) and s[0] not in "#:"]
    starts = [i for i, line in enumerate(lines) if line.isdigit()]
    if not starts or starts[0] != 0:
        raise MotionError("expected frames, each opened by its number")
    height = (starts[1] if len(starts) > 1 else len(lines)) - starts[0]
    if len(lines) != height * len(starts):
        raise MotionError(f"expected {height - 1} bones in each of {len(starts)} frames; the file is cut or mixed")
    columns: dict[str, NDArray[np.float64]] = {}
    for row in range(1, height):
        words = [line.split() for line in lines[row::height]]
        name, width = words[0][0], len(words[0])
        if any(w[0] != name or len(w) != width for w in words):
            raise MotionError(f"expected bone '{name}' in the same place in every frame")
        try:
            columns[name] = np.array([w[1:] for w in words], dtype=np.float64).reshape(len(words), width - 1)
        except ValueError as error:
            raise MotionError(f"bone '{name}': {error}") from error
    return columns
