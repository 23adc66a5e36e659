"""Writes one cleaned body at a constant rate, with constant bone lengths, as BVH, CSV or TRC.

BVH is in centimetres, y up, with a T pose that faces +z as rest pose; a person who faces the camera does too. CSV is as
`nodes.sources.recording` reads it. TRC is as OpenSim reads it.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from steadypose.msgs.recording import RecordingReader
from steadypose.msgs.topics import POSE_WORLD
from steadypose.msgs.types import PoseWorld
from steadypose.nodes.sinks.drawing import ahead
from steadypose.nodes.sources.npz import read_arrays, read_stamps
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import forward_kinematics, global_rotations, rigid_alignment
from steadypose.prior.body.skeleton import CHILDREN, JOINTS, PARENTS, J

Y_UP: Floats = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""(3, 3) rotation from x forward, y left, z up to the axes of animation programs: x left, y up, z forward."""


class ExportError(ValueError):
    """There is no motion to export. The text says what was expected, what there is, and what to do."""


@dataclass(frozen=True)
class BodyMotion:
    """A body's motion at a constant frame rate."""

    fps: float  # frame rate, Hz
    root: Floats  # (T, 3) metres, world, z up: the pelvis
    rotations: Floats  # (T, 22, 4) xyzw, local; the pelvis' to the world
    offsets: Floats  # (22, 3) metres, each joint in its parent's frame
    start_s: float = 0.0  # stamp of the first frame, seconds

    def ahead(self) -> "BodyMotion":
        """The motion with its world turned for animation programs (`drawing.ahead`)."""
        root, rotations = self.root, self.rotations.copy()
        root, rotations[:, 0] = ahead(root, rotations[:, 0])
        return replace(self, root=root, rotations=rotations)

    @property
    def positions(self) -> Floats:
        """(T, 22, 3) metres, world, by forward kinematics."""
        matrices = Rotation.from_quat(self.rotations.reshape(-1, 4)).as_matrix()
        return forward_kinematics(matrices.reshape(*self.rotations.shape[:2], 3, 3), self.offsets, self.root)[0]


def read_motion(path: Path, body: int | None = None) -> BodyMotion:
    """Read the motion of one body (``body``: its id; None: that present the longest) from an output of ``steadypose
    clean``.

    Its frame rate is that of the stamps. Gaps are interpolated. Raises ExportError if there is no such motion.
    """
    stamps, positions, rotations = _from_npz(path, body) if path.suffix == ".npz" else _from_recording(path, body)
    known = np.isfinite(positions).all(axis=(1, 2)) & np.isfinite(rotations).all(axis=(1, 2))
    if known.sum() < 2:
        raise ExportError(f"{path}: expected a body in two frames at least, got {known.sum()}; was anybody recognised?")
    stamps = stamps[known]
    if (back := np.flatnonzero(np.diff(stamps) <= 0)).size:
        got = f"{stamps[back[0] + 1]:.9f} s after {stamps[back[0]]:.9f} s"
        raise ExportError(f"{path}: expected increasing stamps, got {got}; sort the input by stamp, and clean it again")
    return steady(stamps, positions[known], rotations[known])


def steady(stamps_s: Floats, positions: Floats, rotations: Floats) -> BodyMotion:
    """Resample a motion to a constant rate, with constant bone lengths, from stamps (T,) seconds, increasing, positions
    (T, 22, 3) metres, world, and local rotations (T, 22, 4) xyzw. The body is placed by the mean of all its joints: its
    bones do not fit the positions, and placed by the pelvis, it would be off by the pelvis' error as a whole.
    """
    rate = _rate(stamps_s)
    nearest = min(COMMON_HZ, key=lambda common: abs(common - rate))
    fps = nearest if abs(nearest - rate) <= SAME * nearest else float(np.round(rate, 3))
    fps = next((video for video in VIDEO_HZ if abs(video - rate) <= ROUNDED * video), fps)
    body = BodyMotion(fps, positions[:, 0], rotations, _bones(positions, rotations))
    placed = body.root + (positions - body.positions).mean(axis=1)
    rate = rate if abs(fps - rate) <= ROUNDED * fps else fps
    at = stamps_s[0] + np.arange(int((stamps_s[-1] - stamps_s[0]) * rate + 0.01) + 1) / rate
    at = at.clip(max=stamps_s[-1])
    turned = np.stack([Slerp(stamps_s, Rotation.from_quat(rotations[:, j]))(at).as_quat() for j in range(22)], axis=1)
    root = np.stack([np.interp(at, stamps_s, placed[:, axis]) for axis in range(3)], axis=1)
    return BodyMotion(fps, root, turned, body.offsets, float(stamps_s[0]))


COMMON_HZ = (10.0, 12.0, 12.5, 15.0, 20.0, 24.0, 25.0, 30.0, 48.0, 50.0, 60.0, 72.0, 90.0, 100.0, 120.0, 144.0, 150.0,
             180.0, 200.0, 240.0, 250.0, 300.0)  # fmt: skip
"""Frame rates of cameras and motion capture, Hz."""
VIDEO_HZ = (23.976, 29.97, 59.94, 119.88)
"""Frame rates of video, Hz, which jitter alone does not tell from the common ones."""
SAME = 0.01  # largest deviation from a common rate that counts as rounding or jitter, ratio
ROUNDED = 1e-4
"""Largest one by which a file's frame time is rounded, such as 0.008333 s: frames then are the input's own."""


def _rate(stamps_s: Floats) -> float:
    """The rate of stamps (T,) in seconds, Hz: of the mean step without gaps, because stamps may be rounded."""
    steps = np.diff(stamps_s)
    return 1.0 / float(steps[steps < 1.5 * np.median(steps)].mean())


def _bones(positions: Floats, rotations: Floats) -> Floats:
    """(22, 3) metres, bones that fit rotations and positions best: each bone's median in its parent's frame."""
    matrices = Rotation.from_quat(rotations.reshape(-1, 4)).as_matrix().reshape(*rotations.shape[:2], 3, 3)
    parents = list(PARENTS[1:])
    bones = (positions[:, 1:] - positions[:, parents])[..., None]
    local = global_rotations(matrices)[:, parents].swapaxes(-1, -2) @ bones
    return np.concatenate([np.zeros((1, 3)), np.median(local[..., 0], axis=0)])


def _from_recording(path: Path, body: int | None) -> tuple[Floats, Floats, Floats]:
    with RecordingReader(path) as recording:
        if not recording.count(POSE_WORLD):
            got = ", ".join(recording.topics)
            raise ExportError(f"{path}: expected {POSE_WORLD}, got {got}; clean it first: steadypose clean {path} OUT")
        frames = [m for _, _, m in recording.messages([POSE_WORLD]) if isinstance(m, PoseWorld)]
    bodies = Counter(b.id for frame in frames for b in frame.bodies)
    chosen = _chosen(path, bodies, body)
    rows = {frame.stamp_ns: b for frame in frames for b in frame.bodies if b.id == chosen}
    stamps = np.array(sorted(rows))
    positions = np.stack([rows[s].positions for s in stamps.tolist()]).astype(np.float64)
    rotations = np.stack([rows[s].rotations for s in stamps.tolist()]).astype(np.float64)
    return stamps / 1e9, positions, rotations


RIGID = [J[name] for name in JOINTS if not name.endswith(("pelvis", "hip", "knee", "ankle", "foot"))]
"""Joints that `pose/world` rotates and shifts only; it also moves the others, so that feet stand."""


def _from_npz(path: Path, body: int | None) -> tuple[Floats, Floats, Floats]:
    arrays = read_arrays(path)
    if missing := {"positions", "world_positions", "rotations"} - arrays.keys():
        lacks = ", ".join(sorted(missing))
        raise ExportError(f"{path}: has no {lacks}; clean it first: steadypose clean {path} OUT.npz")
    seen, world, turned = (arrays[n].astype(np.float64) for n in ("positions", "world_positions", "rotations"))
    if "body_id" in arrays:
        ids = arrays["body_id"].tolist()
        there = {id: int(np.isfinite(world[:, k]).all(axis=(1, 2)).sum()) for k, id in enumerate(ids)}
        place = ids.index(_chosen(path, Counter(there), body))
        seen, world, turned = seen[:, place], world[:, place], turned[:, place]
    else:
        _chosen(path, Counter({0: 1}), body)  # a file of one body has no ids; `as_input` calls it 0
    stamps = read_stamps(path, arrays, len(seen)) / 1e9
    # the pelvis' rotation is in the sensor's frame, which may move: from there to the world, spine and arms are rigid
    known = np.isfinite(seen).all(axis=(1, 2)) & np.isfinite(world).all(axis=(1, 2))
    for row in np.flatnonzero(known & np.isfinite(turned[:, 0]).all(axis=1)):
        turn = Rotation.from_matrix(rigid_alignment(seen[row, RIGID], world[row, RIGID])[0])
        turned[row, 0] = (turn * Rotation.from_quat(turned[row, 0])).as_quat()
    return stamps, world, turned


def _chosen(path: Path, bodies: Counter[int], body: int | None) -> int:
    if not bodies or (body is not None and body not in bodies):
        there = ", ".join(str(id) for id in bodies) or "none"
        raise ExportError(f"{path}: no body{'' if body is None else f' {body}'} to export; bodies in it: {there}")
    return bodies.most_common(1)[0][0] if body is None else body


CENTIMETRES = 100.0
ORDER = "ZXY"

ENDS = {
    "head": (0.0, 18.0, 3.0),
    "foot": (0.0, 0.0, 7.0),
    "left_wrist": (17.0, 0.0, 0.0),
    "right_wrist": (-17.0, 0.0, 0.0),
}
"""Ends of head, feet and hands of a generic adult relative to their joints: x left, y up, z forward, centimetres."""


def to_bvh(motion: BodyMotion, names: Sequence[str] = JOINTS) -> bytes:
    """The content of a BVH file; ``names`` are those of the 22 joints."""
    motion = motion.ahead()
    lines = ["HIERARCHY"]
    order: list[int] = []

    def write(joint: int, depth: int) -> None:
        order.append(joint)
        offset = CENTIMETRES * Y_UP @ motion.offsets[joint]
        channels = " ".join(f"{axis}rotation" for axis in ORDER)
        rows = [
            f"{'JOINT' if joint else 'ROOT'} {names[joint]}",
            "{",
            f"\tOFFSET {_row(offset)}",
            f"\tCHANNELS 3 {channels}" if joint else f"\tCHANNELS 6 Xposition Yposition Zposition {channels}",
        ]
        lines.extend("\t" * depth + row for row in rows)
        for child in CHILDREN[joint]:
            write(child, depth + 1)
        if not CHILDREN[joint]:
            name = JOINTS[joint]
            end = ENDS["foot" if name.endswith("foot") else name]
            lines.extend("\t" * (depth + 1) + row for row in ("End Site", "{", f"\tOFFSET {_row(np.array(end))}", "}"))
        lines.append("\t" * depth + "}")

    write(J["pelvis"], 0)
    # a change of axes rotates a rotation's vector
    turns = Rotation.from_rotvec(Rotation.from_quat(motion.rotations[:, order].reshape(-1, 4)).as_rotvec() @ Y_UP.T)
    angles = turns.as_euler(ORDER, degrees=True).reshape(len(motion.root), -1)
    rows = np.concatenate([CENTIMETRES * motion.root @ Y_UP.T, angles], axis=1)
    lines += ["MOTION", f"Frames: {len(rows)}", f"Frame Time: {1 / motion.fps:.9f}", *map(_row, rows)]
    return ("\n".join(lines) + "\n").encode()


def _row(values: np.ndarray) -> str:
    return " ".join(f"{value:.6f}" for value in values)


def to_csv(motion: BodyMotion) -> bytes:
    """The content of a CSV: ``stamp`` in seconds; for each joint ``_x _y _z`` metres, world, z up, and local
    ``_qx _qy _qz _qw``."""
    parts = ("x", "y", "z", "qx", "qy", "qz", "qw")
    rows = np.concatenate([motion.positions, motion.rotations], axis=-1).reshape(len(motion.root), -1)
    stamps = motion.start_s + np.arange(len(rows)) / motion.fps
    lines = [
        "# skeleton: smpl22",
        "# up: z",
        ",".join(["stamp", *(f"{joint}_{part}" for joint in JOINTS for part in parts)]),
        *(f"{stamp:.9f}," + ",".join(f"{value:.6f}" for value in row) for stamp, row in zip(stamps, rows, strict=True)),
    ]
    return ("\n".join(lines) + "\n").encode()


def to_trc(motion: BodyMotion) -> bytes:
    """The content of a TRC file with markers at the joints: millimetres, y up."""
    rows = (1000.0 * motion.ahead().positions @ Y_UP.T).reshape(len(motion.root), -1)
    frames, rate = len(rows), f"{motion.fps:g}"
    lines = [
        "PathFileType\t4\t(X/Y/Z)\tsteadypose.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{frames}\t{len(JOINTS)}\tmm\t{rate}\t1\t{frames}",
        "Frame#\tTime\t" + "\t\t\t".join(JOINTS) + "\t\t",
        "\t\t" + "\t".join(f"{axis}{k + 1}" for k in range(len(JOINTS)) for axis in "XYZ"),
        "",
        *(
            "\t".join([str(k + 1), f"{k / motion.fps:.6f}", *(f"{value:.4f}" for value in row)])
            for k, row in enumerate(rows)
        ),
    ]
    return ("\n".join(lines) + "\n").encode()
