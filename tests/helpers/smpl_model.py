"""A model file of SMPL's form, made of random numbers: a real one is licensed."""

from typing import Any

import numpy as np

from steadypose.prior.body.skeleton import PARENTS, REST_POSITIONS

TREE = (*PARENTS, 20, 21)
VERTICES = 4  # of a joint


def model_arrays(betas: int = 10, seed: int = 0) -> dict[str, Any]:
    """A body of 24 joints, each the mean of a few vertices; the first beta is size, the others change it here and
    there."""
    rng = np.random.default_rng(seed)
    joints = REST_POSITIONS[:, [1, 2, 0]]  # SMPL's axes: left, up, forward
    joints = np.concatenate([joints, joints[20:] + [[0.08, 0.0, 0.0], [-0.08, 0.0, 0.0]]])
    joints = joints + rng.normal(0.0, 0.01, joints.shape) + [0.0, -0.2, 0.03]
    around = rng.normal(0.0, 0.05, (VERTICES, len(TREE), 3))
    vertices = (joints + around - around.mean(axis=0)).reshape(-1, 3)
    shapes = rng.normal(0.0, 0.004, (len(vertices), 3, betas))
    shapes[..., 0] += 0.04 * vertices
    tree = np.array([TREE, range(len(TREE))], dtype=np.int64) % 2**32
    return {
        "v_template": vertices, "shapedirs": shapes, "kintree_table": tree.astype(np.uint32),
        "J_regressor": np.tile(np.eye(len(TREE)), VERTICES) / VERTICES,
        "posedirs": rng.normal(0.0, 0.001, (len(vertices), 3, 9 * (len(TREE) - 1))),
        "weights": np.tile(np.eye(len(TREE)), (VERTICES, 1)), "f": np.zeros((1, 3), dtype=np.uint32),
    }  # fmt: skip
