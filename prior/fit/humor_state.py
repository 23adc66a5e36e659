"""The state of a moving body, and the canonical frame of each transition (HuMoR, section 3 and B.1).

HuMoR's state holds SMPL's root, joint rotations and joints, and the velocities of all. Here joints are those that the
rotations and this person's bones give, and velocities are differences to the step before, so that no two parts of a
state can contradict each other and no term has to make them agree.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from steadypose.prior.body.skeleton import PARENTS
from steadypose.prior.fit.tensors import forward_kinematics
from steadypose.prior.timing.rate import FPS

JOINT_COUNT = len(PARENTS)

FEATURES = 3 + 6 * JOINT_COUNT + 3 * (JOINT_COUNT - 1) + 3 * JOINT_COUNT + 3
"""Numbers of a state: root, rotations (6D), joints from the root, velocities of joints, and how fast the root turns."""

CHANGE = 3 + 3 * JOINT_COUNT
"""Numbers of a step: how far the root moves, and rotation vectors of all joints."""

_MIN_LEVEL = 1e-4
"""Of the horizontal part of the body's left axis: one who lies exactly on a side faces nowhere."""


@dataclass(frozen=True)
class State:
    """Of any number of bodies, z up, the floor at 0; leading dimensions (...) are alike.

    Attributes:
        root: (..., 3) metres, the pelvis.
        rotations: (..., 22, 3, 3) local; the root's is its orientation.
        joints: (..., 22, 3) metres.
        velocity: (..., 22, 3) m/s of the joints, since the step before.
        turning: (..., 3) rad/s, the rotation vector of the root since the step before.
    """

    root: Tensor
    rotations: Tensor
    joints: Tensor
    velocity: Tensor
    turning: Tensor

    def __getitem__(self, at: object) -> State:
        """Some of the bodies: indices of leading dimensions."""
        return State(*(getattr(self, field.name)[at] for field in fields(self)))

    def detach(self) -> State:
        """Without gradients."""
        return State(*(getattr(self, field.name).detach() for field in fields(self)))


def stack(states: list[State], dim: int) -> State:
    """States of several times as one, along a new dimension."""
    return State(*(torch.stack([getattr(s, field.name) for s in states], dim) for field in fields(State)))


def choose(mask: Tensor, yes: State, no: State) -> State:
    """Of each body (B,) the state ``yes`` (B, ...) where ``mask`` is true, else ``no``."""

    def chosen(a: Tensor, b: Tensor) -> Tensor:
        return torch.where(mask.reshape(-1, *[1] * (a.dim() - 1)), a, b)

    return State(*(chosen(getattr(yes, field.name), getattr(no, field.name)) for field in fields(State)))


def states_of(root: Tensor, rotations: Tensor, offsets: Tensor) -> State:
    """The states (..., T - 1) of a motion from its second frame on: its first has no velocity.

    Args:
        root: (..., T, 3) metres.
        rotations: (..., T, 22, 3, 3) local.
        offsets: (..., 22, 3) metres, this person's bones, the same in all frames.
    """
    joints = forward_kinematics(rotations, offsets.unsqueeze(-3), root)[0]
    velocity = joints.diff(dim=-3) * FPS
    turned = rotations[..., 1:, 0, :, :] @ rotations[..., :-1, 0, :, :].mT
    return State(
        root[..., 1:, :], rotations[..., 1:, :, :, :], joints[..., 1:, :, :], velocity, small_log(turned) * FPS
    )


def facing(orientation: Tensor) -> Tensor:
    """Rotations (..., 3, 3) about z to where bodies of these orientations (..., 3, 3) face.

    The same as by atan2 of `training.data.dataset.heading`, without an angle between: the official acos has no
    derivative where the body faces along the axis already.
    """
    x, y = orientation[..., 0, 1], orientation[..., 1, 1]
    length = (x.square() + y.square()).clamp(min=_MIN_LEVEL**2).sqrt()
    cos, sin = y / length, -x / length
    zero = torch.zeros_like(cos)
    rows = [cos, -sin, zero, sin, cos, zero, zero, zero, torch.ones_like(cos)]
    return torch.stack(rows, dim=-1).reshape(*cos.shape, 3, 3)


def canonical(state: State, origin: State) -> State:
    """``state`` in the canonical frame of ``origin``: its position on the floor, and its heading."""
    turn = facing(origin.rotations[..., 0, :, :])
    return _turned(_moved(state, -origin.root), turn.mT)


def placed(state: State, origin: State) -> State:
    """The inverse of `canonical`: from the frame of ``origin`` to where that is."""
    turn = facing(origin.rotations[..., 0, :, :])
    return _moved(_turned(state, turn), origin.root)


def _moved(state: State, by: Tensor) -> State:
    """Moved on the floor."""
    flat = by * by.new_tensor([1.0, 1.0, 0.0])
    return State(state.root + flat, state.rotations, state.joints + flat.unsqueeze(-2), state.velocity, state.turning)


def _turned(state: State, turn: Tensor) -> State:
    """Turned about the vertical through 0 by rotations (..., 3, 3)."""
    orientation = turn @ state.rotations[..., 0, :, :]
    back = turn.mT  # rows of vectors are turned from the right
    return State(
        (state.root.unsqueeze(-2) @ back).squeeze(-2),
        torch.cat([orientation.unsqueeze(-3), state.rotations[..., 1:, :, :]], dim=-3),
        state.joints @ back,
        state.velocity @ back,
        (state.turning.unsqueeze(-2) @ back).squeeze(-2),
    )


def features(state: State) -> Tensor:
    """(..., `FEATURES`) what the networks read of canonical states."""
    columns = state.rotations[..., :2].mT.flatten(-3)
    from_root = (state.joints[..., 1:, :] - state.root.unsqueeze(-2)).flatten(-2)
    return torch.cat([state.root, columns, from_root, state.velocity.flatten(-2), state.turning], dim=-1)


def pose_features(inputs: Tensor) -> Tensor:
    """(..., 133) the `features` that the mixture of initial states is fitted to, of states in their own frames.

    Height, joints relative to the root, velocities and angular velocity, as in the official code, without the
    rotations, which follow from the joints except for twists.
    """
    of_joints = 3 + 6 * JOINT_COUNT
    return torch.cat([inputs[..., 2:3], inputs[..., of_joints:]], dim=-1)


def moved_by(state: State, change: Tensor, offsets: Tensor) -> State:
    """A step on from canonical states: HuMoR's Euler step, rotations changed from the left.

    Args:
        state: (...) canonical.
        change: (..., `CHANGE`) metres and radians.
        offsets: (..., 22, 3) metres, bones.
    """
    turns = change[..., 3:].unflatten(-1, (JOINT_COUNT, 3))
    return posed(state, state.root + change[..., :3], small_exp(turns) @ state.rotations, offsets)


def posed(before: State, root: Tensor, rotations: Tensor, offsets: Tensor) -> State:
    """The state of a pose that follows on ``before``, in its frame."""
    joints = forward_kinematics(rotations, offsets, root)[0]
    turned = rotations[..., 0, :, :] @ before.rotations[..., 0, :, :].mT
    return State(root, rotations, joints, (joints - before.joints) * FPS, small_log(turned) * FPS)


def small_exp(vector: Tensor) -> Tensor:
    """Rotations (..., 3, 3) of rotation vectors (..., 3): Rodrigues, with derivatives at 0 too."""
    square = vector.square().sum(dim=-1)[..., None, None]
    angle = (square + 1e-12).sqrt()
    skew = _skew(vector)
    half = torch.sin(angle / 2) / (angle / 2)
    return torch.eye(3, dtype=vector.dtype) + torch.sin(angle) / angle * skew + 0.5 * half.square() * (skew @ skew)


def small_log(rotation: Tensor) -> Tensor:
    """Rotation vectors (..., 3) of rotations (..., 3, 3) by well under half a turn: of a step, not of any two poses."""
    m = rotation
    axis = (
        torch.stack([m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]], dim=-1) / 2
    )
    sine = (axis.square().sum(dim=-1, keepdim=True) + 1e-12).sqrt()
    cosine = (m.diagonal(dim1=-2, dim2=-1).sum(dim=-1, keepdim=True) - 1.0) / 2
    return axis * (torch.atan2(sine, cosine) / sine)


def _skew(v: Tensor) -> Tensor:
    x, y, z = v.unbind(dim=-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*x.shape, 3, 3)
