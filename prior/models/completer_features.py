"""Sizes and features of the completer, and the interpolation that it corrects. Training and live inference share them.

The estimate is the sum of three parts. The *line* interpolates each joint between its known frames, rotations by slerp
and the root by lerp. A joint that is known on one side only is held; a joint that is never known has the mean pose. The
*bend* is the natural cubic spline through the known frames, minus the line; the network outputs a gate for it. The
*correction* is the rest of the network's output, minus the line through its values at known frames (`anchored`), so it
is zero at known frames, and the motion is continuous. In short gaps, a small share of it is used (`correction_share`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Bools, Floats, Floats32
from steadypose.prior.body.inverse_kinematics import place_joints, solve_rotations
from steadypose.prior.body.kinematics import from_rotation_vectors, heading, quaternions, rotation_matrices, yaw_matrix
from steadypose.prior.body.skeleton import CHILDREN, HIPS, PARENTS, J, finite_joints, limbs
from steadypose.prior.compiled import njit
from steadypose.prior.models.line import Line, draw_line, lerp, write_slerp, write_splines
from steadypose.prior.models.weights import WeightsError
from steadypose.prior.timing.rate import FPS

JOINTS = 22
Float = TypeVar("Float", np.float32, np.float64)

BENDS = JOINTS * 6 + 3
"""Number of values in a frame's bend: first two columns of each rotation, and the root's position."""

FEATURES = JOINTS * (6 + 3 + 3 + 3) + 9 + BENDS
"""Number of features of a frame: each joint's rotation (6D), position, velocity, known flag, and nearness of the last
and next known frame; the root's position, velocity, flag and nearness; and the bend."""

OUTPUTS = JOINTS * 6 + 3 + JOINTS + 1
"""Number of outputs of a frame: corrections of each joint's 6D rotation and of the root's position (metres), and logits
of the gates of each joint's and the root's bend."""

NEAR = 8.0  # distance from a known frame at which the nearness 1 / (1 + d / NEAR) is one half, frames

SHARE_FRAMES = 75.0
"""Length of a gap, frames, at which the whole correction is applied; in shorter gaps, a share proportional to their
length. Among curves compared on validation people, by source, it is the simplest that is at no gap much worse than the
cubic or the line (benchmarks/NOTEBOOK.md)."""

MAX_BEND = 2.0  # bound of the root's bend along an axis, metres

_FASTEST = 10.0  # m/s
_SPINE = [J["spine1"], J["spine2"]]
_HINGED_LIMBS = np.array(limbs(("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist")))
_LEAVES = [joint for joint, children in enumerate(CHILDREN) if not children]


@dataclass(frozen=True)
class CompleterConfig:
    """The sizes of the completer."""

    width: int = 160  # width of the transformer's tokens, one per frame
    heads: int = 8  # number of attention heads of each layer
    layers: int = 6  # number of layers
    reach: int = 64  # frames at which relative positions are clipped
    far_sigma: tuple[float, ...] = (0.1,) * JOINTS
    """(22,) metres along an axis, error of each joint far from the frames in which it is known (validation people)"""
    half_frames: float = 10.0
    """frames from a joint's last known frame at which its error is half of `far_sigma`, if none follows"""

    @classmethod
    def from_dict(cls, config: dict[str, Any]) -> CompleterConfig:
        """Build the configuration from the JSON of a weights file; raises WeightsError for an earlier version's."""
        if "far_sigma" not in config:
            raise WeightsError(
                "completer: expected weights of this version, which have an error for each joint: train again"
            )
        return cls(**{**config, "far_sigma": tuple(config["far_sigma"])})


class Window(NamedTuple):
    """Input of the completer for B windows, each transformed so that the first known root is at the origin and faces
    +x."""

    features: Floats32  # (B, T, FEATURES) float32
    rotations: Floats  # (B, T, 22, 3, 3) local rotations of the line
    root: Floats  # (B, T, 3) metres, root positions of the line
    bend: Floats32
    """(B, T, 23, 6) cubics minus the line: first two columns of the rotations and, last, the root (three values in
    metres and three zeros)"""
    line: Line  # the interpolation
    turn: Floats  # (B, 3, 3) rotations from the window's frame to the world
    origin: Floats  # (B, 3) metres, world, origin of the window's frame


def solved_rotations(positions: Floats, offsets: Floats, usual: Floats) -> tuple[Floats, Bools]:
    """Solve local rotations (..., 22, 3, 3), NaN where undetermined; also returns which (..., 22) are known.

    A rotation is known if its joint, the joint below and the rotation above are known. If only the spine between is
    unobserved, as with sensors without one, the chest counts as known, and the spine has the mean pose.

    Args:
        positions: (..., T, 22, 3) metres, z up; NaN where unknown.
        offsets: (22, 3) or (..., T, 22, 3) metres, bones.
        usual: (22, 3, 3) local rotations of the mean pose.
    """
    known = finite_joints(positions)
    fallback = np.full((*positions.shape, 3), np.nan)
    fallback[..., _SPINE, :, :] = usual[_SPINE]
    fallback[..., _LEAVES, :, :] = np.eye(3)
    rotations = solve_rotations(positions, offsets, fallback)
    determined = known & np.isfinite(rotations).all(axis=(-1, -2))
    chest = np.isfinite(rotations[..., J["spine3"], :, :]).all(axis=(-1, -2))
    for joint, children in enumerate(CHILDREN):
        if joint == 0:
            determined[..., 0] &= known[..., HIPS].all(axis=-1)
        elif joint in _SPINE or joint == J["spine3"]:
            determined[..., joint] = chest & determined[..., 0]
        else:
            determined[..., joint] &= determined[..., PARENTS[joint]]
            for child in children:
                determined[..., joint] &= known[..., child]
    _interpolate_twist(rotations, determined, known, np.broadcast_to(offsets, positions.shape))
    return rotations, determined


def _interpolate_twist(rotations: Floats, determined: Bools, known: Bools, offsets: Floats) -> None:
    """Interpolate, in place, the twist of upper arms and thighs over frames in which wrist or ankle are unknown.

    The bend of elbow or knee shows the twist, which the local rotation of forearm or shank is relative to. With a wrong
    twist, this rotation, interpolated between the known frames, would have a wrong direction in the world.
    """
    balls, middles, ends = _HINGED_LIMBS.T
    shape = (-1, determined.shape[-2], len(balls))
    aimed, shown = determined[..., balls].reshape(shape), known[..., ends].reshape(shape)
    twist = aimed & shown
    missing = aimed & ~shown & twist.any(axis=1, keepdims=True)
    if not missing.any():
        return
    solved, line = rotations[..., balls, :, :].reshape(*twist.shape, 3, 3), draw_line(twist)
    turns = quaternions(np.where(twist[..., None, None], solved, np.eye(3)))
    twisted = np.zeros((*twist.shape, 4))
    write_slerp(turns, line.before, line.after, line.weight, line.ever, np.zeros((len(balls), 4)), twisted)
    before = rotation_matrices(twisted[missing])
    bones = offsets[..., middles, :].reshape(*twist.shape, 3)[missing]
    now, then = (_unit((turn @ bones[..., None])[..., 0]) for turn in (solved[missing], before))
    axis = np.cross(then, now)
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    angle = np.arctan2(sine, (then * now).sum(axis=-1, keepdims=True))
    solved[missing] = from_rotation_vectors(axis * (angle / np.maximum(sine, 1e-9))) @ before
    rotations[..., balls, :, :] = solved.reshape(*determined.shape[:-1], len(balls), 3, 3)


def _unit(vectors: Floats) -> Floats:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def read_window(positions: Floats, offsets: Floats, usual: Floats) -> Window:
    """Build the completer's input from windows (B, T, 22, 3) metres, z up, NaN where unknown, of bones (B, 22, 3);
    ``usual`` (22, 4) are local quaternions, xyzw, of the mean pose."""
    count, frames = positions.shape[:2]
    known = finite_joints(positions)
    bones = np.broadcast_to(offsets[:, None], positions.shape)
    rotations, rotations_known = solved_rotations(positions, bones, rotation_matrices(usual))
    line = draw_line(np.concatenate([rotations_known, known[..., :1]], axis=-1))
    rows = np.arange(count)
    facing = np.asarray(np.isfinite(rotations[:, :, 0]).all(axis=(-1, -2)))
    yaw = np.where(facing.any(axis=1), heading(rotations[rows, facing.argmax(axis=1), 0]), 0.0)
    turn = yaw_matrix(yaw)
    rooted = known[..., 0]
    somewhere = np.where(rooted.any(axis=1), rooted.argmax(axis=1), known.any(axis=2).argmax(axis=1))
    which = np.where(rooted.any(axis=1), 0, known[rows, somewhere].argmax(axis=1))
    origin = np.nan_to_num(positions[rows, somewhere, which])
    turned = np.where(rotations_known[..., None, None], rotations, np.eye(3))
    turned[:, :, 0] = turn.swapaxes(1, 2)[:, None] @ turned[:, :, 0]
    given = np.zeros((count, frames, 23, 4))
    given[:, :, :22] = quaternions(turned)
    moved = np.nan_to_num((positions - origin[:, None, None]) @ turn[:, None])
    given[:, :, 22, :3] = moved[:, :, 0]
    curve = np.zeros(given.shape)
    write_slerp(given[:, :, :22], line.before, line.after, line.weight, line.ever, usual, curve[:, :, :22])
    matrices = rotation_matrices(curve[:, :, :22])
    path = lerp(moved[:, :, :1], line, slice(22, 23))[:, :, 0]
    curve[:, :, 22, :3] = path
    write_splines(given, line.known, curve)
    bend = np.zeros((count, frames, 23, 6), dtype=np.float32)
    curve[:, :, :22] /= np.linalg.norm(curve[:, :, :22], axis=-1, keepdims=True)
    bent = rotation_matrices(curve[:, :, :22]) - matrices
    bend[:, :, :22] = bent[..., :2].swapaxes(-1, -2).reshape(count, frames, 22, 6)
    bend[:, :, 22, :3] = np.clip(curve[:, :, 22, :3] - path, -MAX_BEND, MAX_BEND)
    placed = np.where(known[..., None], moved - path[:, :, None], place_joints(matrices, bones))
    features = np.empty((count, frames, FEATURES), dtype=np.float32)
    _write(matrices, placed, path, known, features)
    features[..., -BENDS:] = bend.reshape(count, frames, -1)[..., :BENDS]
    return Window(features, matrices, path, bend, line, turn, origin)


def correction_share(line: Line, whole: float = SHARE_FRAMES) -> Floats32:
    """(B, T, K, 1) share of what a network adds to the cubic: proportional to the gap up to ``whole`` frames, and 1 if
    a track is known on one side only or never."""
    length = (line.after - line.before)[..., None]
    return np.where(length > 0, np.minimum(length / whole, 1.0), 1.0).astype(np.float32)


def growth(between: Floats, half: float) -> Floats:
    """Return the share of a joint's error far from its known frames at ``between`` (see `Uncertainty.of`) frames, one
    half at ``half`` frames. It is quadratic at first, because positions and velocities are known at the ends."""
    return 1.0 / (1.0 + np.square(half / between))


def rotations_of_6d(x: NDArray[Float]) -> NDArray[Float]:
    """Convert first two columns (..., 6) to rotations (..., 3, 3) by Gram-Schmidt (Zhou et al. 2019)."""
    first = x[..., :3] / np.linalg.norm(x[..., :3], axis=-1, keepdims=True)
    second = x[..., 3:] - (first * x[..., 3:]).sum(axis=-1, keepdims=True) * first
    second /= np.linalg.norm(second, axis=-1, keepdims=True)
    return np.stack([first, second, np.cross(first, second)], axis=-1)


@njit(cache=True)
def _write(matrices, placed, path, known, out):
    count, frames, joints = known.shape
    for row in range(count):
        for t in range(frames):
            here = out[row, t]
            for j in range(joints):
                at = 15 * j
                for i in range(3):
                    here[at + i] = matrices[row, t, j, i, 0]
                    here[at + 3 + i] = matrices[row, t, j, i, 1]
                    here[at + 6 + i] = placed[row, t, j, i]
                    step = placed[row, t, j, i] - placed[row, t - 1, j, i] if t else 0.0
                    here[at + 9 + i] = min(max(step * FPS, -_FASTEST), _FASTEST)
            at = 15 * joints
            for i in range(3):
                here[at + i] = path[row, t, i]
                step = path[row, t, i] - path[row, t - 1, i] if t else 0.0
                here[at + 3 + i] = min(max(step * FPS, -_FASTEST), _FASTEST)
        for k in range(joints + 1):
            j, at = (k, 15 * k + 12) if k < joints else (0, 15 * joints + 6)
            last = -1
            for t in range(frames):
                if known[row, t, j]:
                    last = t
                out[row, t, at] = known[row, t, j]
                out[row, t, at + 1] = 1.0 / (1.0 + (t - last) / NEAR) if last >= 0 else 0.0
            last = -1
            for t in range(frames - 1, -1, -1):
                if known[row, t, j]:
                    last = t
                out[row, t, at + 2] = 1.0 / (1.0 + (last - t) / NEAR) if last >= 0 else 0.0
