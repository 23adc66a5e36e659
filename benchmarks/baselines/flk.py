"""FLK as a baseline: a Kalman filter of every coordinate, with a recurrent network as motion model, and constant bones.

After Martini, Boldo and Bombieri, "FLK: A filter with learned kinematics for real-time 3D human pose estimation",
Signal Processing, 2024, and its public code. A GRU predicts the next pose from filtered ones; it is trained on
uncorrupted motion. A joint's speed sets how far its measurement is trusted: a slow one is taken as it is, a missing one
is predicted. Limbs keep their lengths once these are known. A low-pass filter follows. It has no delay.

Differences here: the displacements of all 22 joints are predicted, about the pelvis and in the frame of the hips, by
one layer of 256 units, as in the other recurrent baseline.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from steadypose.benchmarks.baselines.recurrent import BATCH, FRAMES, SCALE, WIDTH, _batch_first, _headings, _turned
from steadypose.benchmarks.baselines.smoothnet import Track, descend, windows
from steadypose.benchmarks.motion import MotionClips
from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import MIRROR, PARENTS, J
from steadypose.prior.timing.rate import FPS

SPACE = {"alpha": (1e-3, 10.0), "theta": (0.05, 0.99), "kept": (0.5, 1.0)}
"""Parameters that are tuned, named as in `filtered`. The authors' values are 0.01, 0.75 and 0.99."""

LEAST_FRAMES, MOST_SPREAD = 20, 0.02
"""A bone's length counts as known after more than this many frames, if its standard deviation is below this; metres."""

SAME_LENGTH = 0.01  # deviation of a bone's length that is not corrected, as a fraction

_LIMBS = [J[f"{side}_{part}"] for part in ("elbow", "wrist", "knee", "ankle", "foot") for side in ("left", "right")]
_PARENTS = [PARENTS[joint] for joint in _LIMBS]
_JOINTS = len(MIRROR)


class MotionModel(nn.Module):
    """Predicts the next poses from poses (N, T, 22, 3), metres, and each joint's last displacement; also returns the
    state."""

    def __init__(self) -> None:
        super().__init__()
        self.gru = nn.GRU(6 * _JOINTS, WIDTH, batch_first=True)
        self.decode = nn.Linear(WIDTH, 3 * _JOINTS)

    def forward(self, poses: Tensor, moved: Tensor, state: Tensor | None = None) -> tuple[Tensor, Tensor | None]:
        turn = _headings(poses)
        about = poses - poses[:, :, J["pelvis"], None]
        x = SCALE * torch.cat([about @ turn, 10 * moved @ turn], dim=-1).flatten(2)
        known, state = self.gru(x, state)
        added = self.decode(known).unflatten(-1, (_JOINTS, 3)) / SCALE
        return poses + added @ turn.transpose(-1, -2), state


def train(motion: MotionClips, steps: int, seed: int, track: Track = lambda x: x) -> MotionModel:
    """Train to predict the next pose, with a mean square loss."""
    torch.manual_seed(seed)
    rng, net = np.random.default_rng((seed, 2)), MotionModel()

    def loss() -> Tensor:
        truth = _batch_first(_turned(motion.positions[windows(motion, FRAMES, BATCH, rng)], rng))
        now = truth[:, :-1]
        error = net(now, torch.diff(now, dim=1, prepend=now[:, :1]))[0] - truth[:, 1:]
        return (SCALE * error).square().mean()

    return descend(net, loss, steps, 3e-3, track)


class Bones:
    """Limb lengths of C bodies, as far as they are known."""

    def __init__(self, clips: int) -> None:
        self._moments = np.zeros((3, clips, len(_LIMBS)))  # frames, sum and sum of squares of lengths
        self._known = np.zeros((clips, len(_LIMBS)), dtype=bool)

    def take(self, poses: Floats) -> None:
        """Measure poses (C, 22, 3), metres; bones of missing joints are not measured."""
        length = np.linalg.norm(poses[:, _LIMBS] - poses[:, _PARENTS], axis=-1)
        self._moments += np.nan_to_num(np.stack([length / length, length, length**2]))
        frames, mean = self._moments[0], self._mean
        spread = np.sqrt(np.maximum(self._moments[2] / np.maximum(frames, 1.0) - mean**2, 0.0))
        self._known |= (frames > LEAST_FRAMES) & (spread < MOST_SPREAD)

    @property
    def _mean(self) -> Floats:
        return self._moments[1] / np.maximum(self._moments[0], 1.0)

    def put_right(self, poses: Floats) -> Floats:
        """Return poses (C, 22, 3) whose limbs have their mean lengths where these are known."""
        poses = poses.copy()
        for bone, (joint, parent) in enumerate(zip(_LIMBS, _PARENTS, strict=True)):
            offset, mean = poses[:, joint] - poses[:, parent], self._mean[:, bone]
            ratio = np.linalg.norm(offset, axis=-1) / np.where(self._known[:, bone], mean, np.nan)
            scaled = poses[:, parent] + offset / ratio[:, None]
            poses[:, joint] = np.where((np.abs(ratio - 1.0) > SAME_LENGTH)[:, None], scaled, poses[:, joint])
        return poses


@torch.inference_mode()
def filtered(
    net: nn.Module, seen: Floats, stamps_s: Floats, delay: int, alpha: float, theta: float, kept: float
) -> Floats:
    """Filter clips (T, C, 22, 3), metres, NaN where missing, by a network at 30 Hz; returns poses, NaN before a joint's
    first measurement.

    Trust in a measurement falls by ``alpha`` (s²/m²) with speed; above ``theta`` the measurement is taken as it is.
    ``kept`` is the weight of the current frame against the last output.
    """
    output, pose, covariance = seen.copy(), seen[0].copy(), np.ones(seen.shape[1:3])
    moved, returns = np.zeros_like(pose), np.zeros(covariance.shape, dtype=bool)
    bones, state = Bones(seen.shape[1]), None
    bones.take(pose)
    for t in range(1, len(seen)):
        step = stamps_s[t] - stamps_s[t - 1]
        next_, state = net(*(torch.from_numpy(np.nan_to_num(x)).float()[:, None] for x in (pose, moved)), state)
        predicted = pose + step * FPS * (next_[:, 0].numpy() - np.nan_to_num(pose))
        gone, new = np.isnan(seen[t, ..., 0]), np.isnan(pose[..., 0])
        speed = np.linalg.norm(np.where(gone[..., None], predicted, seen[t]) - output[t - 1], axis=-1) / step
        taken = ~gone & (new | (1.0 / (1.0 + alpha * speed**2) >= theta))
        ahead = covariance + 1.0 - (1.0 - alpha) * np.exp(-alpha * speed)
        noise = np.where(returns, 0.0, alpha * speed**2)
        gain = np.where(gone, 0.0, ahead / (ahead + noise))
        estimated = predicted + gain[..., None] * (np.nan_to_num(seen[t]) - predicted)
        estimated = np.where(taken[..., None], seen[t], estimated)
        covariance = np.where(taken | new, covariance, (1.0 - gain) * ahead)
        returns = gone | (returns & taken)
        pose, moved = estimated, np.nan_to_num(estimated - pose)
        bones.take(pose)
        now = bones.put_right(estimated)
        before = np.where(np.isnan(output[t - 1]), now, output[t - 1])
        output[t] = kept * now + (1.0 - kept) * before
    return output
