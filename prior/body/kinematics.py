"""Kinematics of the canonical skeleton (forward kinematics, headings, contact labels), and rotations.

Rotations are local (child in the parent's frame). The root's rotation is its orientation in the frame of the positions.
With identity rotations, the body is in a T-pose facing +x, left +y, up +z. See `prior.body.inverse_kinematics` for
rotations from positions, and `prior.body.bone_lengths` for a person's bones.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.types import Pose
from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.skeleton import BONES_BETWEEN, JOINTS, PARENTS, J, finite_joints
from steadypose.prior.compiled import njit

_DEPTH = BONES_BETWEEN[0].tolist()
LEVELS: list[slice] = [
    slice(_DEPTH.index(depth), len(_DEPTH) - _DEPTH[::-1].index(depth)) for depth in range(max(_DEPTH) + 1)
]
"""Joints by depth in the tree. Joints of one level depend only on the level above and are processed together."""

CONTACT_JOINTS: tuple[int, ...] = tuple(
    J[f"{side}_{part}"] for part in ("knee", "ankle", "foot", "wrist") for side in ("left", "right")
)
"""The eight joints with contact labels: HuMoR's nine without the hips, which are never in contact in its data."""

REST_SPEED, LOAD_SPEED = 0.15, 0.7
"""Largest speeds of a joint at rest (HuMoR's contact) and of a joint that bears load, m/s. The second is larger because
a foot rolls from heel to toe. Compared with force plates, the first detects 69 % of walking feet under load, the second
96 %, without false detections."""

CONTACT_HEIGHT: Floats = np.array([0.04 if JOINTS[j].endswith("foot") else 0.08 for j in CONTACT_JOINTS])
"""(8,) largest height of a joint in contact above the *lowest height that the joint can have*, metres; see
`label_contacts`."""

REST_HEIGHT: Floats = np.array(
    [{"knee": 0.05, "ankle": 0.07, "foot": 0.015, "wrist": 0.02}[JOINTS[j].split("_")[1]] for j in CONTACT_JOINTS]
)
"""(8,) height of the joint's centre above the floor while the limb rests on it, metres; a heel's is the ankle's."""


def forward_kinematics(rotations: Floats, offsets: Floats, root: Floats) -> tuple[Floats, Floats]:
    """Compute joint positions (..., 22, 3) metres and global rotations (..., 22, 3, 3), in the frame of the root's
    rotation, from local rotations (..., 22, 3, 3), bones (..., 22, 3) and the root's position (..., 3) metres.

    `prior.fit.tensors` has a version with gradients.
    """
    world = global_rotations(rotations)
    positions = np.empty(rotations.shape[:-1])
    positions[..., 0, :] = root
    for level in LEVELS[1:]:
        parents = list(PARENTS[level])
        bones = world[..., parents, :, :] @ offsets[..., level, :, None]
        positions[..., level, :] = positions[..., parents, :] + bones[..., 0]
    return positions, world


def global_rotations(local: Floats) -> Floats:
    """Convert local rotations (..., 22, 3, 3) to rotations (..., 22, 3, 3) in the root's frame of reference."""
    world = local.copy()
    for level in LEVELS[1:]:
        world[..., level, :, :] = world[..., list(PARENTS[level]), :, :] @ local[..., level, :, :]
    return world


def heading(root_rotation: NDArray[np.floating]) -> Floats:
    """Return the yaw (...) in radians of root rotations (..., 3, 3), z up: the direction that the body faces.

    The yaw is computed from the body's left axis, which stays almost horizontal unless the body lies on its side. The
    forward axis does not: in a bow it points to the floor.
    """
    left = root_rotation[..., :, 1]
    return np.arctan2(-left[..., 0], left[..., 1])


def yaw_matrix(angle: NDArray[np.floating] | float) -> Floats:
    """Rotation (..., 3, 3) about z by ``angle`` (...) radians."""
    angle = np.asarray(angle, dtype=np.float64)
    matrix = np.zeros((*angle.shape, 3, 3))
    matrix[..., 0, 0] = matrix[..., 1, 1] = np.cos(angle)
    matrix[..., 1, 0] = np.sin(angle)
    matrix[..., 0, 1] = -matrix[..., 1, 0]
    matrix[..., 2, 2] = 1.0
    return matrix


def quaternions(rotations: NDArray[np.floating]) -> Floats:
    """Convert rotations (..., 3, 3) to unit quaternions (..., 4), xyzw, from their largest component (Shepperd 1978).

    scipy's ``Rotation`` gives the same result, but takes longer for a body than all later steps together.
    """
    shape = np.shape(rotations)[:-2]
    converted = np.empty((*shape, 4))
    flat = np.ascontiguousarray(rotations, dtype=np.float64).reshape(-1, 3, 3)
    _write_quaternions(flat, converted.reshape(-1, 4))
    return converted


@njit(cache=True)
def _write_quaternions(rotations, out):
    for row in range(len(rotations)):
        m, q = rotations[row], out[row]
        trace = m[0, 0] + m[1, 1] + m[2, 2]
        i = 0
        for axis in range(1, 3):
            if m[axis, axis] > m[i, i]:
                i = axis
        j, k = (i + 1) % 3, (i + 2) % 3
        if trace > m[i, i]:
            q[0], q[1], q[2], q[3] = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], 1 + trace
        else:
            q[i], q[j], q[k], q[3] = 1 - trace + 2 * m[i, i], m[j, i] + m[i, j], m[k, i] + m[i, k], m[k, j] - m[j, k]
        length = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
        for axis in range(4):
            q[axis] /= length


def quaternion_product(p: NDArray[np.floating], q: NDArray[np.floating]) -> Floats:
    """Product of quaternions (..., 4), xyzw: the rotation by ``q``, then by ``p``."""
    (a, b, c, d), (x, y, z, w) = np.moveaxis(p, -1, 0), np.moveaxis(q, -1, 0)
    product = [
        d * x + w * a + b * z - c * y,
        d * y + w * b + c * x - a * z,
        d * z + w * c + a * y - b * x,
        d * w - a * x - b * y - c * z,
    ]
    return np.stack(product, axis=-1)


def rotation_matrix(quaternion: NDArray[np.floating]) -> Floats:
    """Convert a quaternion (4,), xyzw, of any norm but 0 to a rotation (3, 3)."""
    return rotation_matrices(np.asarray(quaternion / np.linalg.norm(quaternion)))


def rotation_matrices(q: Floats) -> Floats:
    """Convert unit quaternions (..., 4), xyzw, to rotations (..., 3, 3)."""
    x, y, z, w = np.moveaxis(q, -1, 0)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
        2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
        2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return np.stack(rows, axis=-1).reshape(*q.shape[:-1], 3, 3)


class SensorFrame(NamedTuple):
    """The pose of a sensor in the world."""

    rotation: Floats  # (3, 3) from the sensor's frame to the world's
    origin: Floats  # (3,) metres, position of the sensor

    @classmethod
    def of(cls, pose: Pose) -> SensorFrame:
        """Build the frame from a message's pose."""
        return cls(_rotation(pose.orientation.tobytes()), pose.position)

    def levelled(self) -> SensorFrame:
        """The same orientation, with the sensor at the origin."""
        return SensorFrame(self.rotation, np.zeros(3))

    def to_world(self, positions: Floats) -> Floats:
        """Transform positions (..., 3) metres from the sensor's frame to the world."""
        return positions @ self.rotation.T + self.origin

    def from_world(self, positions: Floats) -> Floats:
        """Transform positions (..., 3) metres from the world to the sensor's frame."""
        return (positions - self.origin) @ self.rotation


@lru_cache(maxsize=8)
def _rotation(quaternion: bytes) -> Floats:
    return rotation_matrix(np.frombuffer(quaternion))


def from_rotation_vectors(vectors: Floats) -> Floats:
    """Convert rotation vectors (..., 3), radians, to rotations (..., 3, 3) (Rodrigues)."""
    rotations = np.empty((*vectors.shape, 3))
    _rodrigues(np.ascontiguousarray(vectors).reshape(-1, 3), rotations.reshape(-1, 3, 3))
    return rotations


@njit(cache=True)
def _rodrigues(vectors, rotations):
    for row in range(len(vectors)):
        v, r = vectors[row], rotations[row]
        square = v[0] ** 2 + v[1] ** 2 + v[2] ** 2
        angle = math.sqrt(square)
        sine = math.sin(angle) / angle if angle > 1e-9 else 1.0
        half = math.sin(0.5 * angle) / (0.5 * angle) if angle > 1e-9 else 1.0
        turn = 0.5 * half * half
        for i in range(3):
            for j in range(3):
                r[i, j] = turn * v[i] * v[j]
            r[i, i] += 1.0 - turn * square
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            r[a, b] -= sine * v[i]
            r[b, a] += sine * v[i]


def to_rotation_vectors(rotations: Floats) -> Floats:
    """Convert rotations (..., 3, 3) by less than a half turn to rotation vectors (..., 3), radians."""
    vectors = np.empty(rotations.shape[:-1])
    _rotation_vectors(np.ascontiguousarray(rotations).reshape(-1, 3, 3), vectors.reshape(-1, 3))
    return vectors


@njit(cache=True)
def _rotation_vectors(rotations, vectors):
    for row in range(len(rotations)):
        r, v = rotations[row], vectors[row]
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            v[i] = 0.5 * (r[b, a] - r[a, b])
        sine = math.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2)
        if sine > 1e-9:
            angle = math.atan2(sine, 0.5 * (r[0, 0] + r[1, 1] + r[2, 2] - 1.0))
            for i in range(3):
                v[i] *= angle / sine


def rigid_alignment(source: NDArray[np.floating], target: NDArray[np.floating]) -> tuple[Floats, Floats]:
    """Return the rotation R (3, 3) and translation t (3,) that minimise the sum of |R source + t - target|².

    Points (..., 3) that are not finite in both arrays are ignored. Raises ValueError if fewer than three are left.
    """
    both = finite_joints(source) & finite_joints(target)
    a, b = source[both], target[both]
    if len(a) < 3:
        raise ValueError(f"alignment: expected at least 3 points that both have, got {len(a)}")
    centre_a, centre_b = a.mean(axis=0), b.mean(axis=0)
    from scipy.spatial.transform import Rotation  # imported here: 9 MB that nodes do not need

    rotation = Rotation.align_vectors(b - centre_b, a - centre_a)[0].as_matrix()
    return rotation, centre_b - rotation @ centre_a


def label_contacts(positions: NDArray[np.floating], fps: float, speed: float = REST_SPEED) -> Bools:
    """Label contacts (T, 8) of `CONTACT_JOINTS` from motion (T, 22, 3) metres, world, floor at z = 0: joints that are
    low, and slower than ``speed`` m/s (`REST_SPEED` or `LOAD_SPEED`).

    Thresholds are in SI units, so labels do not depend on the frame rate (HuMoR's are per frame). Joint centres do not
    touch the floor, so heights are measured from the centre's height while the limb rests.
    """
    p = np.asarray(positions, dtype=np.float64)[:, list(CONTACT_JOINTS)]
    if len(p) < 2:
        return np.zeros((len(p), len(CONTACT_JOINTS)), dtype=bool)
    speeds = np.linalg.norm(np.gradient(p, 1.0 / fps, axis=0), axis=-1)
    return (speeds < speed) & (p[..., 2] - REST_HEIGHT < CONTACT_HEIGHT)
