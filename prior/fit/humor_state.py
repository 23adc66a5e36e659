"""The state of a moving body, and the canonical frame of each transition (HuMoR, section 3 and B.1).

HuMoR's state holds SMPL's root, joint rotations and joints, and their velocities. Here, joints follow from the
rotations and the person's bones, and velocities are differences from the previous step. The parts of a state therefore
cannot contradict each other, and no consistency term is needed.
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
"""Number of features of a state: root, 6D rotations, root-relative joints, velocities, and the root's turning."""

CHANGE = 3 + 3 * JOINT_COUNT  # number of values of a step: displacement of the root, and rotation vectors of all joints

_MIN_LEVEL = 1e-4
"""Least horizontal component of the body's left axis; a body that lies exactly on its side has no heading."""


@dataclass(frozen=True)
class State:
    """States of any number of bodies, z up, floor at 0, with equal leading dimensions (...)."""

    root: Tensor  # (..., 3) metres, the pelvis
    rotations: Tensor  # (..., 22, 3, 3) local; the root's is its orientation
    joints: Tensor  # (..., 22, 3) metres
    velocity: Tensor  # (..., 22, 3) m/s, velocities of the joints since the previous step
    turning: Tensor  # (..., 3) rad/s, angular velocity of the root since the previous step

    def __getitem__(self, at: object) -> State:
        """Select bodies by indices of the leading dimensions."""
        return State(*(getattr(self, field.name)[at] for field in fields(self)))


def stack(states: list[State], dim: int) -> State:
    """Stack states of several times along a new dimension."""
    return State(*(torch.stack([getattr(s, field.name) for s in states], dim) for field in fields(State)))


def choose(mask: Tensor, yes: State, no: State) -> State:
    """Select for each body (B,) the state ``yes`` (B, ...) where ``mask`` is true, otherwise ``no``."""

    def chosen(a: Tensor, b: Tensor) -> Tensor:
        return torch.where(mask.reshape(-1, *[1] * (a.dim() - 1)), a, b)

    return State(*(chosen(getattr(yes, field.name), getattr(no, field.name)) for field in fields(State)))


def states_of(root: Tensor, rotations: Tensor, offsets: Tensor) -> State:
    """Return the states (..., T - 1) of a motion from its second frame on; the first has no velocity. ``root`` (..., T,
    3) metres and local rotations (..., T, 22, 3, 3) are of one person's bones (..., 22, 3)."""
    joints = forward_kinematics(rotations, offsets.unsqueeze(-3), root)[0]
    velocity = joints.diff(dim=-3) * FPS
    turned = rotations[..., 1:, 0, :, :] @ rotations[..., :-1, 0, :, :].mT
    return State(
        root[..., 1:, :], rotations[..., 1:, :, :, :], joints[..., 1:, :, :], velocity, small_log(turned) * FPS
    )


def facing(orientation: Tensor) -> Tensor:
    """Return rotations (..., 3, 3) about z to the headings of bodies with these orientations (..., 3, 3).

    The result equals that of `prior.fit.tensors.heading`, without computing an angle, and has a derivative everywhere.
    """
    x, y = orientation[..., 0, 1], orientation[..., 1, 1]
    length = (x.square() + y.square()).clamp(min=_MIN_LEVEL**2).sqrt()
    cos, sin = y / length, -x / length
    zero = torch.zeros_like(cos)
    rows = [cos, -sin, zero, sin, cos, zero, zero, zero, torch.ones_like(cos)]
    return torch.stack(rows, dim=-1).reshape(*cos.shape, 3, 3)


def canonical(state: State, origin: State) -> State:
    """Transform ``state`` to the canonical frame of ``origin``, given by its position on the floor and its heading."""
    turn = facing(origin.rotations[..., 0, :, :])
    return _turned(_moved(state, -origin.root), turn.mT)


def placed(state: State, origin: State) -> State:
    """Invert `canonical`: transform from the canonical frame of ``origin`` to that of ``origin`` itself."""
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
    """(..., `FEATURES`) the networks' input from canonical states."""
    columns = state.rotations[..., :2].mT.flatten(-3)
    from_root = (state.joints[..., 1:, :] - state.root.unsqueeze(-2)).flatten(-2)
    return torch.cat([state.root, columns, from_root, state.velocity.flatten(-2), state.turning], dim=-1)


def pose_features(inputs: Tensor) -> Tensor:
    """(..., 133) the `features` to which the mixture of initial states is fitted, of states in their own frames.

    They are height, joints relative to the root, velocities and angular velocity, as in the official code. Rotations
    are omitted, because they follow from the joints except for twists.
    """
    of_joints = 3 + 6 * JOINT_COUNT
    return torch.cat([inputs[..., 2:3], inputs[..., of_joints:]], dim=-1)


def moved_by(state: State, change: Tensor, offsets: Tensor) -> State:
    """Advance canonical states (...) by a change (..., `CHANGE`) in metres and radians: HuMoR's Euler step, with
    rotations multiplied from the left. Bones are (..., 22, 3) metres."""
    turns = change[..., 3:].unflatten(-1, (JOINT_COUNT, 3))
    return posed(state, state.root + change[..., :3], small_exp(turns) @ state.rotations, offsets)


def posed(before: State, root: Tensor, rotations: Tensor, offsets: Tensor) -> State:
    """Return the state of a pose that follows ``before``, in its frame."""
    joints = forward_kinematics(rotations, offsets, root)[0]
    turned = rotations[..., 0, :, :] @ before.rotations[..., 0, :, :].mT
    return State(root, rotations, joints, (joints - before.joints) * FPS, small_log(turned) * FPS)


def small_exp(vector: Tensor) -> Tensor:
    """Convert rotation vectors (..., 3) to rotations (..., 3, 3) (Rodrigues); differentiable at 0."""
    square = vector.square().sum(dim=-1)[..., None, None]
    angle = (square + 1e-12).sqrt()
    skew = _skew(vector)
    half = torch.sin(angle / 2) / (angle / 2)
    return torch.eye(3, dtype=vector.dtype) + torch.sin(angle) / angle * skew + 0.5 * half.square() * (skew @ skew)


def small_log(rotation: Tensor) -> Tensor:
    """Convert rotations (..., 3, 3) by much less than half a turn, as in one step, to rotation vectors (..., 3)."""
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
