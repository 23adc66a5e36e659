"""Converts a fitted motion to SMPL or SMPL-H, for tools that read AMASS' files.

Only the data that determine joints are read from the user's own model file. In SMPL, the joints of the rest pose are
linear in the betas, and the rest is forward kinematics; skin and blend shapes move no joint (Loper et al. 2015,
equations 2 to 4 and 10). Neither the package `smplx`, which is not free for products, nor a model file of ours is
needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from steadypose.prior.arrays import Floats
from steadypose.prior.body.inverse_kinematics import solve_rotations
from steadypose.prior.body.skeleton import PARENT, PARENTS
from steadypose.prior.fit.humor_state import small_exp
from steadypose.prior.fit.motion import float_tensor
from steadypose.prior.fit.tensors import forward_kinematics
from steadypose.prior.npz import MotionError, open_npz
from steadypose.prior.timing.rate import FPS

BETAS, POSES = 16, 156
"""Numbers of values of a shape and of a pose in AMASS. A pose is SMPL-H's 52 rotation vectors; those of the hands are
0."""

LENGTH_SIGMA, JOINT_SIGMA, TURN_SIGMA = 0.01, 0.01, 0.3
"""Standard deviations of SMPL's bones and joints, metres, and of a joint's rotation from inverse kinematics, radians,
relative to betas of standard deviation 1. They prevent extreme shapes where betas cannot explain the joints."""

STEPS = 100

_AXES = [2, 0, 1]
"""Permutation of axes: SMPL's rest pose has left, up and forward as its axes, ours has forward, left and up."""


@dataclass(frozen=True)
class SmplShape:
    """A model's first 22 joints in the rest pose."""

    rest: Floats  # (22, 3) metres, joints of the mean shape; x forward, y left, z up
    change: Floats  # (22, 3, B) metres per unit of each beta, B up to `BETAS`
    gender: str  # gender in the file's name

    @classmethod
    def read(cls, path: Path) -> SmplShape:
        """Read a model's ``.npz``.

        Raises:
            MotionError: it lacks the arrays of SMPL and SMPL-H; the message says what was expected.
        """
        with open_npz(path, "v_template", "shapedirs", "J_regressor", "kintree_table") as arrays:
            try:
                vertices, shapes = arrays["v_template"].astype(np.float64), arrays["shapedirs"].astype(np.float64)
                regressor, tree = arrays["J_regressor"].astype(np.float64), np.asarray(arrays["kintree_table"])
            except ValueError as error:  # raised for pickled objects, such as sparse matrices
                raise MotionError(f"{path}: expected arrays of numbers: {error}") from error
        joints = len(PARENTS)
        got = f"v_template {vertices.shape}, shapedirs {shapes.shape}, J_regressor {regressor.shape}"
        if (
            vertices.shape[1:] != (3,) or shapes.shape[:-1] != vertices.shape or not shapes.shape[-1]
            or regressor.ndim != 2 or regressor.shape[1] != len(vertices) or len(regressor) < joints
        ):  # fmt: skip
            raise MotionError(f"{path}: expected (V, 3), (V, 3, betas) and ({joints} or more, V), got {got}")
        if tree.ndim != 2 or tree.shape[1] < joints or tuple(tree[0, 1:joints]) != PARENTS[1:]:
            raise MotionError(f"{path}: kintree_table: expected SMPL's joints, whose first {joints} have known parents")
        regressor = regressor[:joints]
        name = f"{path.parent.name} {path.stem}".lower()
        gender = next((known for known in ("female", "male") if known in name), "neutral")
        change = np.einsum("jv,vxb->jxb", regressor, shapes[..., :BETAS])
        return cls((regressor @ vertices)[:, _AXES], change[:, _AXES], gender)

    def joints(self, betas: Floats) -> Floats:
        """(22, 3) metres, joints in the rest pose for betas (B,)."""
        return self.rest + self.change @ betas

    def of_lengths(self, lengths: Floats) -> Floats:
        """Fit betas (B,) to bone lengths (22,), metres; the root's is ignored."""

        def residuals(betas: Floats) -> Floats:
            placed = self.joints(betas)
            off = np.linalg.norm(placed - placed[PARENT], axis=-1) - lengths
            return np.concatenate([off[1:] / LENGTH_SIGMA, betas])

        return least_squares(residuals, np.zeros(self.change.shape[-1])).x


@dataclass(frozen=True)
class SmplMotion:
    """A motion of T frames at 30 Hz, z up."""

    poses: Floats  # (T, `POSES`) radians, rotation vectors, the root's first
    betas: Floats  # (`BETAS`,) 0 where the model has fewer
    trans: Floats  # (T, 3) metres, translations
    gender: str  # gender of the model
    joints: Floats  # (T, 22, 3) metres, the model's joints

    @property
    def arrays(self) -> dict[str, Any]:
        """Return the arrays under AMASS' names."""
        return {
            "poses": self.poses, "betas": self.betas, "trans": self.trans, "gender": np.array(self.gender),
            "mocap_framerate": np.array(float(FPS)),
        }  # fmt: skip


def smpl_motion(shape: SmplShape, joints: Floats, lengths: Floats) -> SmplMotion:
    """Fit the motion of a model of this shape to joints (T, 22, 3) metres, z up, complete, with these bone lengths
    (22,)."""
    betas = shape.of_lengths(lengths)
    rest = shape.joints(betas)
    bones = np.where(PARENT[:, None] >= 0, rest - rest[PARENT], 0.0)
    start = float_tensor(solve_rotations(joints, bones))
    target, middle, change = float_tensor(joints), float_tensor(shape.rest), float_tensor(shape.change)
    moves = [torch.zeros(values.shape) for values in (betas, joints, joints[:, 0])]
    for move in moves:
        move.requires_grad = True
    scales = [0.3, 0.1, 0.01]  # of a step of 1 of the optimiser
    first = float_tensor(betas)
    optimiser = torch.optim.LBFGS(moves, max_iter=STEPS, line_search_fn="strong_wolfe")

    def posed() -> list[torch.Tensor]:
        beta, turns, off = (scale * move for scale, move in zip(scales, moves, strict=True))
        rotations = small_exp(turns) @ start
        placed = middle + change @ (first + beta)
        offsets = torch.cat([placed[:1], placed[1:] - placed[list(PARENTS[1:])]])
        return [first + beta, turns, rotations, forward_kinematics(rotations, offsets, target[:, 0] + off)[0]]

    def closure() -> torch.Tensor:
        optimiser.zero_grad()
        beta, turns, _, reached = posed()
        # another model's bones have the same errors in all frames, so together the frames count like one for betas
        energy = len(target) * beta.square().sum() + (turns / TURN_SIGMA).square().sum()
        energy = energy + ((reached - target) / JOINT_SIGMA).square().sum()
        energy.backward()
        return energy

    optimiser.step(closure)
    with torch.no_grad():
        beta, _, rotations, reached = (values.double().numpy() for values in posed())
    return SmplMotion(_poses(rotations), _padded(beta, BETAS), reached[:, 0] - _own_axes(shape.joints(beta)[0]),
                      shape.gender, reached)  # fmt: skip


def _poses(rotations: Floats) -> Floats:
    """(T, `POSES`) of local rotations (T, 22, 3, 3) between our axes; the root's leads from SMPL's to the world."""
    axes = np.eye(3)[_AXES]
    local = np.concatenate([rotations[:, :1] @ axes, axes.T @ rotations[:, 1:] @ axes], axis=1)
    vectors = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec()
    return _padded(vectors.reshape(len(rotations), -1), POSES)


def _own_axes(point: Floats) -> Floats:
    """(3,) in SMPL's axes of a point in ours."""
    return point @ np.eye(3)[_AXES]


def _padded(values: Floats, width: int) -> Floats:
    return np.concatenate([values, np.zeros((*values.shape[:-1], width - values.shape[-1]))], axis=-1)
