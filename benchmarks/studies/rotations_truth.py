"""Motion whose files have rotations, as 30 Hz clips, and errors of orientations: of all joints, of the root's heading
and tilt, along and about bones, and between frames."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import heading
from steadypose.prior.body.layouts import to_canonical
from steadypose.prior.body.skeleton import CHILDREN, JOINTS, REST_OFFSETS, J
from steadypose.prior.mocap.bvh import Bvh
from steadypose.prior.mocap.clip import Y_UP_TO_Z_UP, forward
from steadypose.prior.timing.rate import FPS
from steadypose.training.data.prepare import find_faults, resample
from steadypose.training.data.readers import bvh_motion, members

FRAMES, SKIPPED = 240, 60
"""Length of a clip, and number of frames at its start that are not scored, so that a filter's start does not count."""


class _Source(NamedTuple):
    """Location of recordings with rotations."""

    name: str  # name of the source
    archive: str  # its file
    turns: Mapping[str, str]  # the file's joint that rotates with each canonical joint, left and middle
    people: Mapping[str, tuple[str, ...]]  # marks in file names that identify the people of each split


_LIMBS = {
    "left_hip": "LeftUpLeg", "left_knee": "LeftLeg", "left_ankle": "LeftFoot",
    "left_collar": "LeftShoulder", "left_shoulder": "LeftArm", "left_elbow": "LeftForeArm",
    "neck": "Neck", "pelvis": "Hips", "spine1": "Spine1", "spine2": "Spine2",
}  # fmt: skip
SOURCES = (
    _Source(
        "CMU", "cmu_bvh.tar.xz",
        {"pelvis": "CC_Base_Hip", "spine1": "CC_Base_Spine01", "spine2": "CC_Base_Spine02", "spine3": "CC_Base_Spine02",
         "neck": "CC_Base_NeckTwist01", "left_hip": "CC_Base_L_Thigh", "left_knee": "CC_Base_L_Calf",
         "left_ankle": "CC_Base_L_Foot", "left_collar": "CC_Base_L_Clavicle", "left_shoulder": "CC_Base_L_Upperarm",
         "left_elbow": "CC_Base_L_Forearm"},
        {"val": ("002_",), "test": ()},
    ),
    _Source(
        "CMU (dance)", "cmu_dance.tar.xz",
        {"pelvis": "hip", "spine1": "abdomen", "spine2": "chest", "spine3": "chest", "neck": "neck",
         "left_hip": "lThigh", "left_knee": "lShin", "left_ankle": "lFoot", "left_collar": "lCollar",
         "left_shoulder": "lShldr", "left_elbow": "lForeArm"},
        {"val": (), "test": ("martial", "indian")},
    ),
    _Source(
        "DanceDB", "dancedb.tar.xz", {**_LIMBS, "spine3": "Spine3"},
        {"val": ("Andria_", "Elena_"), "test": ("Anna_", "Olivia_", "Theodora_")},
    ),
    _Source(
        "LAFAN1", "lafan1.tar.xz", {**_LIMBS, "spine3": "Spine2"},
        {"val": ("subject1",), "test": ("subject2", "subject3", "subject4")},
    ),
)  # fmt: skip
"""Sources. Nothing is trained on CMU's subject 02; DanceDB and LAFAN1 are only for choosing and measuring."""

SCORED = tuple(J[name] for name in JOINTS if not name.endswith(("foot", "wrist", "head")))
"""The 17 joints that carry another. The rotation of hands, toes and head does not affect any canonical joint."""


class Clips(NamedTuple):
    """Clips side by side, 30 Hz."""

    positions: Floats  # (T, C, 22, 3) metres, z up
    orientations: Floats  # (T, C, 17, 3, 3) of `SCORED`, world from the file's joint
    source: NDArray[np.str_]  # (C,) names
    person: NDArray[np.str_]  # (C,) marks of their people


def read(mocap: Path, split: str, most: int) -> Clips:
    """Read at most ``most`` clips of `FRAMES` frames of each source, spread evenly over its recordings."""
    found = [(source.name, *clip) for source in SOURCES for clip in _spread(list(_clips(mocap, source, split)), most)]
    names, people, positions, orientations = zip(*found, strict=True)
    return Clips(np.stack(positions, axis=1), np.stack(orientations, axis=1), np.array(names), np.array(people))


def _spread(clips: list[tuple[str, Floats, Floats]], most: int) -> list[tuple[str, Floats, Floats]]:
    rows = np.linspace(0, len(clips) - 1, min(most, len(clips))).round().astype(int)
    return [clips[row] for row in rows]


def _clips(mocap: Path, source: _Source, split: str) -> Iterator[tuple[str, Floats, Floats]]:
    """Yield every clip without faults of a source's people of this split: person, positions and orientations."""
    if not (marks := source.people[split]):
        return
    for name, content in sorted(members(mocap / source.archive, (".bvh",), lambda _: None)):
        person = next((mark for mark in marks if mark in name), None)
        if person is None:
            continue
        bvh, skeleton, places = bvh_motion(content.decode("ascii", "replace"))
        joints, _ = to_canonical(skeleton, places)
        turns = _orientations(bvh, source.turns)[len(bvh.values) - len(joints) :]
        positions = resample(joints, bvh.fps)
        orientations = _at_rate(turns, bvh.fps, len(positions))
        bad, _ = find_faults(positions)
        for first in range(0, len(positions) - FRAMES + 1, FRAMES):
            if not bad[rows := slice(first, first + FRAMES)].any():
                yield person, positions[rows], orientations[rows]


def _orientations(bvh: Bvh, turns: Mapping[str, str]) -> Floats:
    """Return the orientations of `SCORED`, z up, (T, 17, 3, 3)."""
    local, column = np.broadcast_to(np.eye(3), (len(bvh.values), len(bvh.joints), 3, 3)).copy(), 0
    for joint, channels in enumerate(bvh.channels):
        turning = [column + i for i, channel in enumerate(channels) if channel.endswith("rotation")]
        if turning:
            order = "".join(channel[0] for channel in channels if channel.endswith("rotation"))
            local[:, joint] = Rotation.from_euler(order, bvh.values[:, turning], degrees=True).as_matrix()
        column += len(channels)
    every = forward(bvh.parents, bvh.offsets, local)[1]
    return Y_UP_TO_Z_UP @ every[:, [bvh.joints.index(_turner(JOINTS[joint], turns)) for joint in SCORED]]


def _turner(joint: str, turns: Mapping[str, str]) -> str:
    """Return the file's joint that rotates with a canonical one. The right side's name is the left's with the side
    changed."""
    if not joint.startswith("right"):
        return turns[joint]
    name = turns[joint.replace("right", "left")]
    if "Left" in name:
        return name.replace("Left", "Right")
    return name.replace("_L_", "_R_") if "_L_" in name else "r" + name[1:]


def _at_rate(orientations: Floats, fps: float, frames: int) -> Floats:
    """Resample (T, J, 3, 3) to 30 Hz by slerp, (T', J, 3, 3)."""
    if abs(fps - FPS) < 1e-3:
        return orientations[:frames]
    asked, own = np.arange(frames) / FPS, np.arange(len(orientations)) / fps
    asked = np.minimum(asked, own[-1])
    slerps = [Slerp(own, Rotation.from_matrix(orientations[:, joint])) for joint in range(orientations.shape[1])]
    return np.stack([slerp(asked).as_matrix() for slerp in slerps], axis=1)


_BALLS = [SCORED.index(J[name]) for name in ("left_hip", "right_hip", "left_shoulder", "right_shoulder")]
STRAIGHT, BENT = np.radians((10.0, 30.0))
"""Bend of knee or elbow below which a limb is straight, and above which it is bent, radians."""
SLOW, FAST = 0.5, 1.5  # speeds of the joint at the bone's end below which it is slow, and above which it is fast, m/s
_ROUNDS, _NEAR = 8, np.radians(2.0)


def child_of(joint: int) -> int:
    """Return the joint at the end of the bone that a joint rotates: for pelvis and chest, the one above."""
    return {J["pelvis"]: J["spine1"], J["spine3"]: J["neck"]}.get(joint, CHILDREN[joint][0])


_BONE = np.array([REST_OFFSETS[child_of(j)] / np.linalg.norm(REST_OFFSETS[child_of(j)]) for j in SCORED])


def align(truth: Floats, perfect: Floats) -> Floats:
    """Return the file's orientations (T, C, 17, 3, 3) in a method's own convention: ``truth @ A``.

    A file's joint at rest has another orientation than the canonical one and than any method's. A (C, 17, 3, 3), one
    constant rotation per clip and joint, is the median of ``truth.T @ perfect`` over the clip (Weiszfeld's rounds on
    chordal means). ``perfect`` is the method's output for the joints without noise. What then differs on a noise-free
    input is definition: a pelvis computed from hips and spine bends with the spine, and a straight limb shows no twist.
    """
    apart = truth.swapaxes(-1, -2) @ perfect
    weight, mean = np.ones(apart.shape[:-2]), apart[0]
    for _ in range(_ROUNDS):
        u, _, vt = np.linalg.svd(np.einsum("tcj,tcjab->cjab", weight, apart))
        u[..., -1] *= np.linalg.det(u @ vt)[..., None]
        mean = u @ vt
        weight = 1.0 / np.maximum(angle(mean.swapaxes(-1, -2) @ apart), _NEAR)
    return truth @ mean


def angle(rotation: Floats) -> Floats:
    """Return the angle (...) of rotations (..., 3, 3), radians, accurate for small ones too."""
    skew = rotation - rotation.swapaxes(-1, -2)
    sine = 0.5 * np.sqrt(skew[..., 2, 1] ** 2 + skew[..., 0, 2] ** 2 + skew[..., 1, 0] ** 2)
    return np.arctan2(sine, 0.5 * (np.trace(rotation, axis1=-2, axis2=-1) - 1.0))


def score(found: Floats, truth: Floats, positions: Floats) -> dict[str, Any]:
    """Return errors of orientations (T, C, 17, 3, 3), aligned, in degrees: the median and the 95th percentile."""
    error = found.swapaxes(-1, -2) @ truth
    off = angle(error)
    swing, twist = _swing_twist(error)
    root, true_root = found[:, :, 0], truth[:, :, 0]
    turned, tilt = wrapped(heading(root) - heading(true_root)), tilt_between(root, true_root)
    result: dict[str, Any] = {
        "all": spread(off), "root": spread(off[:, :, 0]), "heading": spread(turned), "tilt": spread(tilt),
        "direction": spread(swing), "twist": spread(twist[:, :, _BALLS]),
        "turn beyond": _excess(found, truth), "root turn beyond": _excess(found[:, :, :1], truth[:, :, :1]),
        "joints": {JOINTS[joint]: spread(off[:, :, k]) for k, joint in enumerate(SCORED)},
    }  # fmt: skip
    ends = [child_of(joint) for joint in SCORED]
    speed = np.linalg.norm(np.gradient(positions[:, :, ends], 1 / 30, axis=0), axis=-1)
    result["by speed"] = {
        name: spread(off[mask])
        for name, mask in (
            ("slow", speed < SLOW),
            ("middling", (speed >= SLOW) & (speed < FAST)),
            ("fast", speed >= FAST),
        )
    }
    bend = _bend(positions)
    result["by bend"] = {
        name: spread(twist[:, :, _BALLS][mask])
        for name, mask in (
            ("straight", bend < STRAIGHT), ("half", (bend >= STRAIGHT) & (bend < BENT)), ("bent", bend >= BENT)
        )
    }  # fmt: skip
    return result


def spread(radians: Floats) -> list[float]:
    """Return the median and 95th percentile of the finite values, degrees."""
    finite = radians[np.isfinite(radians)]
    if not len(finite):
        return [float("nan")] * 2
    return [round(float(v), 2) for v in np.degrees(np.quantile(np.abs(finite), (0.5, 0.95)))]


def _excess(found: Floats, truth: Floats) -> float:
    """Return the mean excess of the estimated over the true rotation between frames, degrees a frame."""
    mine, real = (angle(r[:-1].swapaxes(-1, -2) @ r[1:]) for r in (found, truth))
    return round(float(np.degrees(np.nanmean(mine - real))), 3)


def tilt_between(found: Floats, truth: Floats) -> Floats:
    """Return the difference in tilt (...) of two orientations (..., 3, 3), radians, whatever their headings."""
    return np.arccos(np.clip((found[..., 2, :] * truth[..., 2, :]).sum(axis=-1), -1.0, 1.0))


def wrapped(angles: Floats) -> Floats:
    """Wrap angles to -pi to pi, radians."""
    return (angles + np.pi) % (2 * np.pi) - np.pi


def _swing_twist(error: Floats) -> tuple[Floats, Floats]:
    """Return the errors of a bone's direction and of its rotation about itself, radians, from (T, C, 17, 3, 3)."""
    bone = np.broadcast_to(_BONE, error.shape[:-1])
    moved = np.einsum("...ab,...b->...a", error, bone)
    swing = np.arctan2(np.linalg.norm(np.cross(bone, moved), axis=-1), (bone * moved).sum(axis=-1))
    skew = np.stack([error[..., 2, 1] - error[..., 1, 2], error[..., 0, 2] - error[..., 2, 0],
                     error[..., 1, 0] - error[..., 0, 1]], axis=-1)  # fmt: skip
    # the quaternion's vector part over its scalar part: skew / (1 + trace)
    about = (skew * bone).sum(axis=-1)
    return swing, np.abs(2.0 * np.arctan2(about, 1.0 + np.trace(error, axis1=-2, axis2=-1)))


def _bend(positions: Floats) -> Floats:
    """Return the bend (T, C, 4) of knees and elbows, radians."""
    chains = [(J[f"{side}_{a}"], J[f"{side}_{b}"], J[f"{side}_{c}"])
              for a, b, c in (("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist"))
              for side in ("left", "right")]  # fmt: skip
    start, middle, end = (positions[:, :, list(joints)] for joints in zip(*chains, strict=True))
    upper, lower = middle - start, end - middle
    return np.arctan2(np.linalg.norm(np.cross(upper, lower), axis=-1), (upper * lower).sum(axis=-1))
