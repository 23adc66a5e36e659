"""Models that are moments of motion and take seconds to fit.

They are the Gaussian of postures (``steadypose train posture``) and the covariance of joints' accelerations
(``steadypose train body_modes --data MOCAP``).
"""

import json
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.numpy import save_file
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from steadypose.prior.body.skeleton import HIPS, MIRROR, SHOULDERS
from steadypose.prior.models.pelvis import rigid_pelvis
from steadypose.prior.models.posture import DIMENSIONS, TURNS, body_size, trunk_frame
from steadypose.prior.models.weights import LICENCES
from steadypose.training.data.dataset import MotionSet
from steadypose.training.data.recordings import Motion, load_motion, write_arrays
from steadypose.training.loop import TrainingOptions
from steadypose.training.weights import save_weights, write_card

FRAMES = 150_000
"""Number of bodies; sources are weighted by the square root of their length, because dance is short and different."""

TURN, SHIFT = 0.12, 0.02
"""Standard deviations of the error of a noisy trunk frame, about an axis in radians and along an axis in metres."""


class Posture(nn.Module):
    """Mean (69,) and Cholesky factor (69, 69) of the covariance: 22 joints, metres of a body of the rest skeleton's
    size, and the rotation vector of the pelvis, radians."""

    mean: Tensor
    factor: Tensor

    def __init__(self, postures: NDArray[np.float64]) -> None:
        """Of postures (N, 69)."""
        super().__init__()
        factor = np.linalg.cholesky(np.cov(postures.T) + 1e-8 * np.eye(DIMENSIONS + TURNS))
        self.register_buffer("mean", torch.from_numpy(postures.mean(axis=0)))
        self.register_buffer("factor", torch.from_numpy(factor))


def train_posture(options: TrainingOptions) -> Path:
    """Fit the Gaussian to the training split of ``options.data``; returns the path of the weights."""
    path, rng = options.path("posture"), np.random.default_rng(options.seed)
    motion = MotionSet.load(options.data, options.weights, "train")
    lengths = np.diff(motion.clip_start)
    of_source = {source: lengths[motion.source == source].sum() for source in np.unique(motion.source)}
    weight = np.repeat([of_source[source] ** -0.5 for source in motion.source], lengths)
    rows = np.sort(rng.choice(len(weight), min(FRAMES, len(weight)), replace=False, p=weight / weight.sum()))
    positions, offsets = (values[rows].numpy().astype(np.float64) for values in (motion.positions, motion.offsets))
    save_weights(path, Posture(postures(positions, offsets, rng)), {}, {
        "Model": "a Gaussian of the 22 joints and the pelvis' rotation in the trunk's frame",
        "Data": f"prepared motion, training split: {len(rows)} frames, of {', '.join(sorted(of_source))}, each by "
        "the root of its length; mirrored by chance",
        "Licence": LICENCES[options.weights],
        "Training": f"`steadypose train posture`: moments; frame off by {TURN} rad and {SHIFT} m; seed {options.seed}",
    })  # fmt: skip
    return path


def postures(
    positions: NDArray[np.float64], offsets: NDArray[np.float64], rng: np.random.Generator
) -> NDArray[np.float64]:
    """(N, 69) postures of bodies (N, 22, 3), in their trunk frames with random errors."""
    mirrored = rng.random(len(positions)) < 0.5
    for values in (positions, offsets):
        values[mirrored] = values[mirrored][:, MIRROR] * (1.0, -1.0, 1.0)
    centred = positions - positions[:, [*HIPS, *SHOULDERS]].mean(axis=1, keepdims=True)
    off = Rotation.from_rotvec(rng.normal(0.0, TURN, (len(positions), 3))).as_matrix()
    frame = trunk_frame(positions) @ off.swapaxes(-1, -2)
    local = centred @ frame / body_size(offsets)[:, None, None] + rng.normal(0.0, SHIFT, (len(positions), 1, 3))
    turn = Rotation.from_matrix(frame.swapaxes(-1, -2) @ rigid_pelvis(positions, offsets)).as_rotvec()
    return np.concatenate([local.reshape(len(local), -1), turn], axis=1)


def covariance_of(motion: Motion) -> NDArray[np.float64]:
    """(22, 22) covariance along an axis of the accelerations of motion at its own speed, with mean variance 1.

    It is the mean of the sources' covariances, each relative to its mean variance, so that long sources do not
    dominate.
    """
    parts = []
    for source in sorted(set(motion.source)):
        total = np.zeros((22, 22))
        for clip in np.flatnonzero((motion.source == source) & (motion.speed == 1.0)):
            bent = np.diff(motion.positions[slice(*motion.start[clip : clip + 2])].astype(np.float64), n=2, axis=0)
            total += np.einsum("tja,tka->jk", bent, bent)
        parts.append(22.0 * total / np.trace(total))
    return np.mean(parts, axis=0)


def train_modes(options: TrainingOptions) -> Path:
    """Compute it from recordings in ``options.data`` that are licensed for products; returns the weights' path."""
    path = options.path("body_modes")
    motion = load_motion(write_arrays(options.data, options.path("mixture").parent / "arrays"), "train")
    path.parent.mkdir(parents=True, exist_ok=True)
    save_file({"covariance": covariance_of(motion).astype(np.float32)}, path, metadata={"config": json.dumps({})})
    write_card(path, {
        "Model": "covariance of joints' accelerations along an axis, relative to their mean variance (22, 22)",
        "Data": f"{', '.join(sorted(set(motion.source)))}: people of the training split, each source counting the same",
        "Licence": LICENCES["default"],
        "Training": "`steadypose train body_modes --data MOCAP`, seconds; nothing is drawn at random",
    })  # fmt: skip
    return path
