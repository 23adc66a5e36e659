"""FLK as a baseline: a Kalman filter of every coordinate, with a recurrent network as motion model, and constant bones.

After Martini, Boldo and Bombieri, "FLK: A filter with learned kinematics for real-time 3D human pose estimation", in
Signal Processing, 2024, and its public code. A GRU gives the next pose from filtered ones; it is trained on motion as
it is. A joint's speed sets how far its measurement is trusted: a slow one is taken as it is, a missing one predicted.
Limbs keep their lengths once these are known, and a low pass follows. Different here: all 22 joints are predicted, as
what each moves, about the pelvis and in the frame of the hips, and by one layer of 256 units, as of the other
recurrent baseline. It has no delay.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import torch
from torch import Tensor, nn

from steadypose.benchmarks.baselines.recurrent import _batch_first, _headings, _turned
from steadypose.benchmarks.motion import MotionClips
from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import MIRROR, PARENTS, J
from steadypose.prior.timing.rate import FPS

SPACE = {"alpha": (1e-3, 10.0), "theta": (0.05, 0.99), "kept": (0.5, 1.0)}
"""What is tuned, as `filtered` names it. The authors' values: 0.01, 0.75, 0.99."""

LEAST_FRAMES, MOST_SPREAD = 20, 0.02
"""A bone's length is known after more frames than this, if its standard deviation is less than this; metres."""

SAME_LENGTH = 0.01
"""Deviation of a bone's length that is left; a fraction."""

_LIMBS = [J[f"{side}_{part}"] for part in ("elbow", "wrist", "knee", "ankle", "foot") for side in ("left", "right")]
_JOINTS, _WIDTH, _SCALE, _BATCH, _FRAMES = len(MIRROR), 256, 5.0, 32, 60


class MotionModel(nn.Module):
    """Poses (N, T, 22, 3), metres, and what each joint moved to them, to those of the next frames; and the state."""

    def __init__(self) -> None:
        super().__init__()
        self.gru = nn.GRU(6 * _JOINTS, _WIDTH, batch_first=True)
        self.decode = nn.Linear(_WIDTH, 3 * _JOINTS)

    def forward(self, poses: Tensor, moved: Tensor, state: Tensor | None = None) -> tuple[Tensor, Tensor]:
        turn = _headings(poses)
        about = poses - poses[:, :, J["pelvis"], None]
        x = _SCALE * torch.cat([about @ turn, 10 * moved @ turn], dim=-1).flatten(2)
        known, state = self.gru(x, state)
        added = self.decode(known).unflatten(-1, (_JOINTS, 3)) / _SCALE
        return poses + added @ turn.transpose(-1, -2), state


def train(
    motion: MotionClips, steps: int, seed: int, track: Callable[[Iterable[int]], Iterable[int]] = lambda x: x
) -> MotionModel:
    """Train to predict the next pose, by the mean square."""
    torch.manual_seed(seed)
    rng = np.random.default_rng((seed, 2))
    net = MotionModel()
    optimiser = torch.optim.Adam(net.parameters())
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 3e-3, total_steps=steps)
    frames, clips = motion.positions.shape[:2]
    length = min(_FRAMES, frames)
    for _ in track(range(steps)):
        rows = rng.integers(frames - length, endpoint=True, size=_BATCH) + np.arange(length)[:, None]
        truth = _batch_first(_turned(motion.positions[rows, rng.integers(clips, size=_BATCH)], rng))
        now = truth[:, :-1]
        error = net(now, torch.diff(now, dim=1, prepend=now[:, :1]))[0] - truth[:, 1:]
        optimiser.zero_grad()
        (_SCALE * error).square().mean().backward()
        nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimiser.step()
        schedule.step()
    return net.eval()


@torch.inference_mode()
def filtered(net: MotionModel, seen: Floats, stamps_s: Floats, alpha: float, theta: float, kept: float) -> Floats:
    """Poses (T, C, 22, 3), metres; NaN before a joint is first measured.

    Args:
        net: the motion model; its frames are those of 30 Hz.
        seen: (T, C, 22, 3) metres, NaN where missing.
        stamps_s: (T,) seconds.
        alpha: how soon speed takes trust from a measurement, s²/m².
        theta: trust from which on a measurement is taken as it is.
        kept: weight of a frame against the output before it.
    """
    output, pose, covariance = seen.copy(), seen[0].copy(), np.ones(seen.shape[1:3])
    moved, was_missing = np.zeros_like(pose), np.zeros(covariance.shape, dtype=bool)
    lengths, state = [_lengths(pose)], None
    for t in range(1, len(seen)):
        step = stamps_s[t] - stamps_s[t - 1]
        found, state = net(*(torch.from_numpy(np.nan_to_num(x)).float()[:, None] for x in (pose, moved)), state)
        predicted = np.where(np.isnan(pose), np.nan, pose + step * FPS * (found[:, 0].numpy() - np.nan_to_num(pose)))
        gone = np.isnan(seen[t, ..., 0])
        speed = np.linalg.norm(np.where(gone[..., None], predicted, seen[t]) - output[t - 1], axis=-1) / step
        new = np.isnan(pose[..., 0])
        taken = ~gone & (new | (1.0 / (1.0 + alpha * speed**2) >= theta))
        ahead = covariance + 1.0 - (1.0 - alpha) * np.exp(-alpha * speed)
        noise = np.where(was_missing, 0.0, alpha * speed**2)
        gain = np.where(gone, 0.0, ahead / (ahead + noise))
        estimated = predicted + gain[..., None] * (np.nan_to_num(seen[t]) - predicted)
        estimated = np.where(taken[..., None], seen[t], estimated)
        covariance = np.where(taken | new, covariance, (1.0 - gain) * ahead)
        was_missing = gone
        lengths.append(_lengths(estimated))
        pose, moved = estimated, np.nan_to_num(estimated - pose)
        output[t] = _with_lengths(estimated, np.array(lengths))
        before = np.where(np.isnan(output[t - 1]), output[t], output[t - 1])
        output[t] = kept * output[t] + (1.0 - kept) * before
    return output


def _lengths(poses: Floats) -> Floats:
    """(C, 10) metres."""
    return np.linalg.norm(poses[:, _LIMBS] - poses[:, [PARENTS[j] for j in _LIMBS]], axis=-1)


def _with_lengths(poses: Floats, lengths: Floats) -> Floats:
    """Poses (C, 22, 3) whose limbs are as long as the mean of lengths (T, C, 10) where these are known."""
    if len(lengths) <= LEAST_FRAMES:
        return poses
    poses, mean = poses.copy(), lengths.mean(axis=0)
    for bone, joint in enumerate(_LIMBS):
        offset = poses[:, joint] - poses[:, PARENTS[joint]]
        now = np.linalg.norm(offset, axis=-1)
        wrong = (lengths[:, :, bone].std(axis=0) < MOST_SPREAD) & (np.abs(now / mean[:, bone] - 1.0) > SAME_LENGTH)
        scaled = poses[:, PARENTS[joint]] + offset * (mean[:, bone] / now)[:, None]
        poses[:, joint] = np.where(wrong[:, None], scaled, poses[:, joint])
    return poses
