"""Reads one motion file of any supported format as canonical joints, metres, z up.

The formats are BVH (`prior.mocap.bvh`), AMASS' .npz, and named points: TRC, the text format of OpenSim and Pose2Sim,
and C3D, the format of motion capture systems, through ezc3d. A `Description` adds what a file does not contain.
"""

from __future__ import annotations

import io
import re
import struct
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from steadypose.prior.arrays import Floats
from steadypose.prior.body.layouts import CANONICAL, SKELETONS, Skeleton, layout_names, to_canonical
from steadypose.prior.body.rigs import BY_RIG, Rig, Tree, recognise, recognise_points, up_axis
from steadypose.prior.body.skeleton import JOINTS, PARENTS, REST_OFFSETS
from steadypose.prior.mocap.bvh import CMU_BVH, read_bvh
from steadypose.prior.mocap.clip import TO_Z_UP, MotionError, documented, forward
from steadypose.prior.mocap.plug_in_gait import MARKERS, calibrate, joint_centres
from steadypose.prior.npz import open_npz

POINT_UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001}
SMALLEST_M = 0.1
"""Distance from the origin that some point of a person exceeds, metres."""


@dataclass(frozen=True)
class Description:
    """Properties that a motion file lacks or states wrongly. Empty fields are read from the file or recognised."""

    canonical: Mapping[str, str | Sequence[str]] = field(default_factory=dict)
    """canonical joint -> the file's joint, or several joints of which it is the mean"""
    metres: float = 0.0  # size of the file's unit, metres; 0 to recognise it
    up: str = ""  # the axis that points up: ``z``, ``y`` or ``-y``
    fps: float = 0.0  # frames per second; 0 for the file's value
    skeleton: str = ""  # skeleton of the joints in arrays without names


UNDESCRIBED = Description()


class Motion(NamedTuple):
    """The content of a file: frames per second, and positions (T, 22, 3) metres, z up; NaN where missing."""

    fps: float
    positions: Floats


def describe(table: Mapping[str, Any]) -> Description:
    """Build the description from a TOML file (``--rig``).

    Raises:
        MotionError: it contains an unknown key, joint or value.
    """
    kinds = {"canonical": Mapping, "metres": (int, float), "up": str, "fps": (int, float), "skeleton": str}
    for key, value in table.items():
        if key not in kinds or not isinstance(value, kinds[key]):
            raise MotionError(f"rig: expected {', '.join(kinds)} alone, each of its kind; got {key} = {value!r}")
    described = Description(**table)
    if strange := [joint for joint in described.canonical if joint not in JOINTS]:
        raise MotionError(f"rig [canonical]: expected joints of smpl22 ({', '.join(JOINTS)}), got {', '.join(strange)}")
    if not (described.metres >= 0 and described.fps >= 0):
        raise MotionError(f"rig: expected metres and fps above 0, got {described.metres:g} and {described.fps:g}")
    if described.up not in ("", *TO_Z_UP):
        raise MotionError(f"rig: up: expected one of {', '.join(TO_Z_UP)}, got {described.up!r}")
    if described.skeleton not in ("", *SKELETONS):
        raise MotionError(f"rig: skeleton: expected one of {layout_names()}, got {described.skeleton!r}")
    return described


def read_motion(name: str, content: bytes, description: Description = UNDESCRIBED) -> Motion:
    """Read the content of a motion file in the format of its name's suffix, one of `SUFFIXES`; ``description`` has what
    the file lacks.

    Raises MotionError if the file cannot be read, or contains no body.
    """
    suffix = Path(name).suffix.lower()
    if suffix not in _READERS:
        raise MotionError(f"{name}: expected one of {', '.join(SUFFIXES)}")
    try:
        fps, skeleton, positions, up = documented(_READERS[suffix])(content, description)
    except MotionError as error:
        raise MotionError(f"{name}: {error}") from error
    body = to_canonical(skeleton, positions)[0]
    return Motion(description.fps or fps, body @ TO_Z_UP[description.up or up or up_axis(body)].T)


_Read = tuple[float, Skeleton, Floats, str]
"""Type of a reader's result: frames per second, skeleton, positions (T, J, 3) metres, and the up axis if known."""


def file_rig(joints: Sequence[str], parents: Sequence[int], offsets: Floats, description: Description) -> Rig:
    """Return the rig of a file: as described, from a table, or recognised.

    Raises:
        MotionError: a described joint is missing, or no body is recognised.
    """
    if description.canonical:
        named = _described(joints, description.canonical)
        if not description.metres:
            raise MotionError("rig: expected metres, the size of the file's unit, beside [canonical]")
        return Rig(named, description.metres)
    if set(CMU_BVH.skeleton.joints) <= set(joints):
        return CMU_BVH
    return recognise(Tree(joints, parents, offsets), description.metres)


def _described(joints: Sequence[str], canonical: Mapping[str, str | Sequence[str]]) -> Skeleton:
    sources = {joint: [given] if isinstance(given, str) else list(given) for joint, given in canonical.items()}
    if missing := [n for names in sources.values() for n in names if n not in joints]:
        raise MotionError(f"rig [canonical]: expected names of joints, the file has no {', '.join(missing)}")
    return Skeleton("described", tuple(joints), {joint: dict.fromkeys(names, 1.0) for joint, names in sources.items()})


def _text(content: bytes) -> str:
    """Decode a text file: UTF-16 if it begins with that byte order mark, as Windows' "Unicode" does, else UTF-8."""
    return content.decode("utf-16" if content[:2] in (BOM_UTF16_LE, BOM_UTF16_BE) else "utf-8-sig", "replace")


def _bvh(content: bytes, description: Description) -> _Read:
    bvh = read_bvh(_text(content))
    rig = file_rig(bvh.joints, bvh.parents, bvh.offsets, description)
    used = [bvh.joints.index(joint) for joint in rig.skeleton.joints]
    metres = description.metres or rig.metres
    if not len(bvh.values):
        raise MotionError("expected frames after MOTION, got none: export it again, with its animation")
    positions = metres * bvh.positions(rig.lost_bones)[:, used]
    up = description.up or rig.up or up_axis(to_canonical(rig.skeleton, positions)[0])
    # many programs write a root's OFFSET into its channels too; added to them, it lifts the body off the floor at 0
    root = metres * bvh.offsets[Tree(bvh.joints, bvh.parents, bvh.offsets).path(used[0])[0]]
    lowest = float((positions @ TO_Z_UP[up][2]).min())
    lifted = abs(lowest - root @ TO_Z_UP[up][2]) < abs(lowest)
    return bvh.fps, rig.skeleton, positions - root * lifted, up


def _amass(content: bytes, _: Description) -> _Read:
    """Read SMPL, SMPL-H or SMPL-X poses as stored by AMASS: ``poses``, ``trans`` and the frame rate.

    No body model is used, so its licence does not apply. The rotations are applied to the rest skeleton of
    `prior.body.skeleton`, a generic adult, for any subject. Joint angles are those of the recording; bone lengths and
    the height of the root above the floor are not.
    """
    with open_npz(io.BytesIO(content), "poses", "trans") as archive:
        rate = next((k for k in ("mocap_framerate", "mocap_frame_rate") if k in archive), None)
        if rate is None:
            raise MotionError("expected an array mocap_framerate (or mocap_frame_rate, as SMPL-X' files name it)")
        fps, poses = float(archive[rate]), archive["poses"].astype(np.float64)
        trans = archive["trans"].astype(np.float64)
    if poses.ndim != 2 or poses.shape[1] < 3 * len(PARENTS) or trans.shape != (len(poses), 3):
        raise MotionError(f"expected poses (T, 66 or more) and trans (T, 3), got {poses.shape} and {trans.shape}")
    maps = poses[:, : 3 * len(PARENTS)].reshape(-1, 3)
    local = Rotation.from_rotvec(maps).as_matrix().reshape(len(poses), len(PARENTS), 3, 3)
    # SMPL's rest pose faces +z with y up; ours faces +x with z up
    steps = np.tile(REST_OFFSETS[:, [1, 2, 0]], (len(poses), 1, 1))
    steps[:, 0] = trans
    return fps, CANONICAL, forward(PARENTS, steps, local)[0], "z"


def _array(content: bytes, description: Description) -> _Read:
    positions = np.load(io.BytesIO(content), allow_pickle=False)
    skeleton = SKELETONS.get(description.skeleton or CANONICAL.name, CANONICAL)
    shape = (len(skeleton.joints), 3)
    if positions.ndim != 3 or positions.shape[1:] != shape or not description.fps:
        raise MotionError(
            f"expected an array (T, {shape[0]}, 3) of {skeleton.name}, and fps (and skeleton, if it is of another) by "
            f"{BY_RIG}; got {positions.shape} and {description.fps or 'no'} fps"
        )
    return description.fps, skeleton, positions.astype(np.float64) * (description.metres or 1.0), ""


def _trc(content: bytes, description: Description) -> _Read:
    rows = _text(content).splitlines()
    if len(rows) < 6 or not rows[0].startswith("PathFileType"):
        raise MotionError("expected a TRC file, which begins with PathFileType and has five lines before its numbers")
    header = dict(zip(rows[1].split("\t"), rows[2].split("\t"), strict=False))
    names = [name.strip() for name in rows[3].split("\t")[2::3]]
    names = names[: max((k + 1 for k, name in enumerate(names) if name), default=0)]
    if not names or "DataRate" not in header:
        raise MotionError(
            "expected DataRate in the second line and names of points in the fourth, separated by tabs; got "
            f"{rows[1][:40]!r} and {rows[3][:40]!r}"
        )
    cells = [row.replace(",", ".").split("\t") for row in rows[5:] if row.strip()]
    width = 2 + 3 * len(names)
    values = np.array([[float(c) if c.strip() else np.nan for c in (row + [""] * width)[:width]] for row in cells])
    fps = description.fps or float(header["DataRate"].replace(",", "."))
    points = values[:, 2:].reshape(len(values), len(names), 3)
    if not description.fps:
        points = _in_time(values[:, 1], fps, points)
    stated = header.get("NumFrames", "").strip()
    _refuse_cut(int(stated) if stated.isdigit() else 0, len(points))
    return _points(fps, names, points, header.get("Units", "m"), description)


def _in_time(times: Floats, fps: float, points: Floats) -> Floats:
    """Points (T, J, 3) of rows at ``times`` (T,) seconds, with rows of NaN for the frames between that have none."""
    steps = np.diff(times) * fps
    usual = np.median(steps) if len(steps) else 0.0
    if not usual > 0:  # the file has no times
        return points
    if abs(usual - 1.0) > 0.1:
        raise MotionError(
            f"expected one frame rate, got a DataRate of {fps:g} Hz and times of {fps / usual:.3g} Hz: correct one of "
            f"them, or say the right fps with {BY_RIG}"
        )
    rows = np.cumsum([0, *np.maximum(np.round(steps), 1).astype(int)])
    whole = np.full((rows[-1] + 1, *points.shape[1:]), np.nan)
    whole[rows] = points
    return whole


def _c3d(content: bytes, description: Description) -> _Read:
    try:
        import ezc3d
    except ImportError as error:
        raise MotionError("reading C3D needs ezc3d: install steadypose[mocap]") from error
    with NamedTemporaryFile(suffix=".c3d") as file:  # ezc3d reads files only by name
        file.write(content)
        file.flush()
        point = (read := ezc3d.c3d(file.name))["parameters"]["POINT"]
    # 255 names at most are in one parameter; the others are in LABELS2, LABELS3, ...
    names = [str(name) for key in sorted(point) if re.fullmatch(r"LABELS\d*", key) for name in point[key]["value"]]
    points = read["data"]["points"][:3].transpose(2, 1, 0)[:, : len(names)].astype(np.float64)
    _refuse_cut(_c3d_frames(content), len(points))
    units = (point["UNITS"]["value"] or ["mm"])[0]
    return _points(float(point["RATE"]["value"][0]), names, points, str(units), description)


def _c3d_frames(content: bytes) -> int:
    """Number of frames that a C3D's header states, 65535 at most; ezc3d returns the number that it has read."""
    big_endian = content[512 * (content[0] - 1) + 3] == 86
    first, last = struct.unpack_from(">HH" if big_endian else "<HH", content, 6)
    return last - first + 1


def _refuse_cut(stated: int, frames: int) -> None:
    if frames < stated:
        raise MotionError(
            f"expected {stated} frames, as its header says, got {frames}; the file is cut short: export it again"
        )


def _points(fps: float, names: Sequence[str], points: Floats, units: str, description: Description) -> _Read:
    """Read named points, which are skin markers of the Plug-in-Gait set or joints."""
    points = np.where((points == 0.0).all(axis=-1, keepdims=True), np.nan, points)  # how many programs write a gap
    unit = re.sub(r"(?:([cdm])[a-z]+)?met(?:er|re)s?", r"\1m", units.strip().lower())  # millimeters: mm
    metres = description.metres or POINT_UNITS.get(unit, 0.001)
    if not description.metres and 0 < metres * np.nanmax(np.abs(points), initial=0.0) < SMALLEST_M:
        raise MotionError(
            f"in its unit, {units}, all points are within {SMALLEST_M} m of the origin: the numbers seem to be metres; "
            f"if so, say metres = 1.0 with {BY_RIG}"
        )
    bare = [name.rpartition(":")[2].strip() for name in names]  # Subject:Point
    if description.canonical:
        whole = any(":" in str(joint) for joint in description.canonical.values())
        return fps, _described(names if whole else bare, description.canonical), points * metres, ""
    marked = set(MARKERS) <= set(bare)
    skeleton = CANONICAL if marked else recognise_points(bare)
    used = MARKERS if marked else {name for weights in skeleton.table.values() for name in weights}
    subjects = {
        name.rpartition(":")[0]: None for name, own in zip(names, bare, strict=True) if own in used and own != name
    }
    if len(subjects) > 1:
        raise MotionError(f"expected one body, got points of {', '.join(subjects)}: export each body alone")
    if marked:
        markers = {name: points[:, bare.index(name)] * metres for name in MARKERS}
        return fps, skeleton, joint_centres(markers, calibrate([markers])), ""
    return fps, skeleton, points[:, [bare.index(n) for n in skeleton.joints]] * metres, ""


_READERS: Mapping[str, Callable[[bytes, Description], _Read]] = {
    ".bvh": _bvh, ".trc": _trc, ".c3d": _c3d, ".npy": _array, ".npz": _amass,
}  # fmt: skip

SUFFIXES = tuple(_READERS)  # suffixes of motion files
