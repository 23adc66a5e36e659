"""A real Kinect's errors against a Vicon system, on UI-PRMD, and those of a simulated one on the same motions.

The Kinect's joints are compared with the Vicon's joint centres after a robust rigid alignment a clip and without the
constant offset between the two definitions of a joint (in the frame of the joint's bone, the median over all clips).
What is left is the error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.body.bone_lengths import estimate_offsets
from steadypose.prior.body.inverse_kinematics import solve_rotations
from steadypose.prior.body.kinematics import global_rotations
from steadypose.prior.body.layouts import KINECT22, to_canonical
from steadypose.prior.body.skeleton import JOINTS, PARENTS
from steadypose.prior.sim.noise import NoiseModel, draw_errors, ray_axes, travelled
from steadypose.training.data.ui_prmd import KinectPair

SEEN = np.flatnonzero(KINECT22.observable)
"""(S,) the canonical joints that this Kinect gives"""
_FAILED = ("m03", "s01")


@dataclass(frozen=True)
class Clip:
    """A clip in the Kinect's frame (z up, the camera at the origin).

    Attributes:
        fps: frames a second.
        truth: (T, 22, 3) metres, the Vicon's joint centres plus the definition's offset: where the Kinect should
            have seen each joint.
        kinect: (T, 22, 3) metres, where it saw them; NaN for joints it does not give.
    """

    fps: float
    truth: Floats
    kinect: Floats


def align(moving: Floats, fixed: Floats) -> tuple[Floats, Floats]:
    """The rotation and translation that lay ``moving`` (N, 3) on ``fixed`` (N, 3), both metres.

    Iteratively reweighted (Cauchy, 5 cm), so that a few wild joints do not turn the body. Points that are not
    finite on both sides are left out.
    """
    finite = np.isfinite(moving).all(axis=1) & np.isfinite(fixed).all(axis=1)
    a, b = moving[finite], fixed[finite]
    weight = np.ones(len(a))
    rotation, shift = np.eye(3), np.zeros(3)
    for _ in range(5):
        total = weight.sum()
        ca, cb = weight @ a / total, weight @ b / total
        u, _, vt = np.linalg.svd((weight[:, None] * (a - ca)).T @ (b - cb))
        sign = np.array([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))])
        rotation = (vt.T * sign) @ u.T
        shift = cb - rotation @ ca
        weight = 1 / (1 + (np.linalg.norm(a @ rotation.T + shift - b, axis=1) / 0.05) ** 2)
    return rotation, shift


def usable(pair: KinectPair) -> bool:
    """Whether the Kinect tracked at all: in s01's lunges (m03) it lost the legs, half a metre off, throughout."""
    return (pair.movement, pair.subject) != _FAILED


def prepare(pairs: Sequence[KinectPair]) -> list[Clip]:
    """Bring both systems' joints into the Kinect's frame, with the constant offset between the definitions learned."""
    kinect = [to_canonical(KINECT22, p.kinect)[0] for p in pairs]
    frames = _bone_frames(pairs)
    offset = np.zeros((len(JOINTS), 3))

    def placed(pair: KinectPair, bones: Floats, seen: Floats) -> tuple[Floats, Floats, Floats]:
        """Joints with the offset so far, joint centres, and bones' frames: all moved into the Kinect's frame."""
        shifted = pair.vicon + np.einsum("tjab,jb->tja", bones, offset)
        rotation, shift = align(shifted[:, SEEN].reshape(-1, 3), seen[:, SEEN].reshape(-1, 3))
        return shifted @ rotation.T + shift, pair.vicon @ rotation.T + shift, rotation @ bones

    for _ in range(3):
        local = []
        for pair, bones, seen in zip(pairs, frames, kinect, strict=True):
            _, centres, turned = placed(pair, bones, seen)
            local.append(np.einsum("tjba,tjb->tja", turned, seen - centres))
        offset[SEEN] = np.nanmedian(np.concatenate(local)[:, SEEN], axis=0)
    return [Clip(p.fps, placed(p, g, k)[0], k) for p, g, k in zip(pairs, frames, kinect, strict=True)]


def _bone_frames(pairs: Sequence[KinectPair]) -> list[Floats]:
    """(T, 22, 3, 3) world orientation of the bone that ends in each joint, from the Vicon's joint centres."""
    parents = np.maximum(PARENTS, 0)
    frames: list[Floats] = []
    bones = {
        s: estimate_offsets(np.concatenate([p.vicon for p in pairs if p.subject == s])[::10])
        for s in {p.subject for p in pairs}
    }
    for p in pairs:
        frames.append(global_rotations(solve_rotations(p.vicon, bones[p.subject]))[:, parents])
    return frames


def errors(clip: Clip) -> Floats:
    """(T, S, 3) metres: the error of the joints seen, along the camera's ray, to its right, up.

    Aligned once more, so that real and simulated clips are treated alike.
    """
    rotation, shift = align(clip.kinect[:, SEEN].reshape(-1, 3), clip.truth[:, SEEN].reshape(-1, 3))
    difference = clip.kinect[:, SEEN] @ rotation.T + shift - clip.truth[:, SEEN]
    return np.einsum("tjkx,tjx->tjk", ray_axes(clip.truth[:, SEEN]), difference)


def simulate(clips: Sequence[Clip], model: NoiseModel, rng: np.random.Generator) -> list[Clip]:
    """The same motions as a simulated Kinect would have seen them. Joints the Vicon lost stay lost."""
    out: list[Clip] = []
    for clip in clips:
        filled = np.where(np.isfinite(clip.truth), clip.truth, [0.0, 2.5, 0.0])
        dt = np.full(len(filled), 1 / clip.fps)
        drawn = draw_errors(np.minimum(travelled(filled), 0.2), dt, rng, model)
        noisy = clip.truth + np.einsum("tjk,tjkx->tjx", drawn.steady + drawn.quick, ray_axes(filled))
        out.append(replace(clip, kinect=np.where(np.isfinite(clip.kinect), noisy, np.nan)))
    return out
