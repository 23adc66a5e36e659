"""Baselines that learn a Kinect's error from recordings with a reference, trained in seconds.

Both read poses in the trunk's frame, smoothed by a constant-velocity Kalman filter, and predict a correction of the
smoother's 13 scored joints. One is a ridge regression on one frame (66 inputs). The other is a temporal convolution
over 24 frames, up to 4 of them ahead, with 64 channels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from sklearn.linear_model import Ridge
from torch import Tensor, nn

from steadypose.benchmarks.baselines.kalman import fixed_lag
from steadypose.benchmarks.motion import side_by_side
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import rigid_alignment
from steadypose.prior.body.layouts import KINECT22, to_canonical
from steadypose.prior.body.skeleton import HIPS
from steadypose.prior.timing.rate import FPS
from steadypose.training.data.recordings import trunk_frame

_FRAMES, _MAX_AHEAD = 24, 4
_BATCH = 128
_MIN_SCALE = 0.01  # metres
_INPUT_NOISE = 0.1  # standard deviations
_SIDES = str.maketrans("LR", "RL")
_OTHER_SIDE = [
    KINECT22.joints.index(name[0].translate(_SIDES) + name[1:] if name[1].isupper() else name)
    for name in KINECT22.joints
]


@dataclass(frozen=True)
class Smoothed:
    inputs: Floats
    """(T, 66) metres, joints in the trunk's frame, from the middle of the hips; smoothed with the part of the delay
    that the regression does not look ahead itself"""
    answer: Floats
    """(T, 13, 3) metres, the scored joints, smoothed with the whole delay"""
    trunk: Floats
    """(T, 3, 3) the trunk's frame in that of the answer"""

    def corrected(self, missing: Floats) -> Floats:
        """Add a correction (T, 39) in the trunk's frame to the smoothed joints, (T, 13, 3)."""
        return self.answer + np.einsum("tab,tjb->tja", self.trunk, missing.reshape(len(missing), -1, 3))

    def missing(self, truth: Floats) -> Floats:
        """Return the correction (T, 39) from the smoothed joints to the truth, which is first aligned to them as a
        whole."""
        rotation, translation = rigid_alignment(truth, self.answer)
        gap = truth @ rotation.T + translation - self.answer
        return np.einsum("tba,tjb->tja", self.trunk, gap).reshape(len(gap), -1)


def smoothed(clips: Sequence[Floats], scored: Sequence[int], delay: int, ahead: int, density: float) -> list[Smoothed]:
    """Smooth clips (T, 22, 3) of a Kinect's own joints for a regression of this delay that itself looks ``ahead``."""
    seen = side_by_side(clips)
    stamps = np.arange(len(seen)) / FPS
    late = fixed_lag(seen, stamps, delay, 2, density)
    early = late if ahead == 0 else fixed_lag(seen, stamps, delay - ahead, 2, density)
    result = []
    for number, clip in enumerate(clips):
        answer = to_canonical(KINECT22, late[: len(clip), number])[0]
        result.append(Smoothed(_in_trunk(early[: len(clip), number]), answer[:, list(scored)], trunk_frame(answer)))
    return result


def _in_trunk(kinect: Floats) -> Floats:
    canonical = to_canonical(KINECT22, kinect)[0]
    hips = canonical[:, HIPS].mean(axis=1)
    return np.einsum("tba,tjb->tja", trunk_frame(canonical), kinect - hips[:, None]).reshape(len(kinect), -1)


def ridge(train: Sequence[Smoothed], truths: Sequence[Floats], penalty: float) -> Callable[[Smoothed], Floats]:
    """Fit on clips with their truths (T, 13, 3); returns a function from a clip to its estimate."""
    x = np.concatenate([clip.inputs for clip in train])
    y = np.concatenate([clip.missing(truth) for clip, truth in zip(train, truths, strict=True)])
    known = np.isfinite(y).all(axis=1)
    model = Ridge(alpha=penalty).fit(x[known], y[known])
    return lambda clip: clip.corrected(model.predict(clip.inputs))


class TemporalConvolution(nn.Module):
    """Maps standardised poses (B, 24, 66) to the standardised correction (B, 39) of one of them."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Dropout(0.15), nn.Conv1d(66, 64, 8), nn.ReLU(), nn.Dropout(0.3),
            nn.Conv1d(64, 64, 8), nn.ReLU(), nn.Dropout(0.3),
            nn.Conv1d(64, 39, 10),
        )  # fmt: skip

    def forward(self, poses: Tensor) -> Tensor:
        return self.layers(poses.transpose(1, 2))[..., 0]


def temporal_convolution(
    train: Sequence[Smoothed], truths: Sequence[Floats], mirror: Sequence[int], ahead: int, steps: int, seed: int
) -> Callable[[Smoothed], Floats]:
    """Fit a temporal convolution, as `ridge` fits a regression, to clips and their truths (T, 13, 3).

    Six people are few, so half of each batch is mirrored (``mirror`` is the other side's joint of each), and all joints
    of a window are shifted a little. ``ahead`` frames of the window follow the estimated one.
    """
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    windows = torch.cat([_windows(clip, ahead) for clip in train])
    gaps = np.concatenate([clip.missing(truth) for clip, truth in zip(train, truths, strict=True)])
    known = np.flatnonzero(np.isfinite(gaps).all(axis=1))
    targets = torch.from_numpy(gaps).float()
    # Both sides count, so that standardised poses can be mirrored like poses.
    poses, errors = windows[known, -1 - ahead], targets[known]
    poses, errors = torch.cat([poses, _mirrored(poses, _OTHER_SIDE)]), torch.cat([errors, _mirrored(errors, mirror)])
    mean, scale = poses.mean(dim=0), poses.std(dim=0).clamp(min=_MIN_SCALE)
    error_mean, error_scale = errors.mean(dim=0), errors.std(dim=0)
    net = TemporalConvolution()
    optimiser = torch.optim.AdamW(net.parameters(), lr=1e-3, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 3e-3, total_steps=steps)
    for _ in range(steps):
        rows = torch.from_numpy(rng.choice(known, _BATCH))
        x, y = windows[rows], targets[rows]
        half = _BATCH // 2
        x = torch.cat([_mirrored(x[:half], _OTHER_SIDE), x[half:]])
        y = torch.cat([_mirrored(y[:half], mirror), y[half:]])
        found = net((x - mean) / scale + _INPUT_NOISE * torch.randn(_BATCH, 1, x.shape[2]))
        loss = (found * error_scale + error_mean - y).unflatten(1, (-1, 3)).norm(dim=-1).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    net.eval()

    @torch.inference_mode()
    def answer(clip: Smoothed) -> Floats:
        missing = net((_windows(clip, ahead) - mean) / scale) * error_scale + error_mean
        return clip.corrected(missing.double().numpy())

    return answer


def look_ahead(delay: int) -> int:
    """Return the number of frames that the convolution looks ahead at a delay; the smoother before it uses the rest."""
    return min(delay, _MAX_AHEAD)


def _windows(clip: Smoothed, ahead: int) -> Tensor:
    """Return windows (T, 24, 66), with the clip's ends repeated; views of one padded copy."""
    x = torch.from_numpy(clip.inputs).float()
    before = x[:1].expand(_FRAMES - 1 - ahead, -1)
    return torch.cat([before, x, x[-1:].expand(ahead, -1)]).unfold(0, _FRAMES, 1).transpose(1, 2)


def _mirrored(vectors: Tensor, other_side: Sequence[int]) -> Tensor:
    """Mirror vectors (..., 3 J) in the trunk's frame across its xz plane."""
    joints = vectors.unflatten(-1, (-1, 3))[..., list(other_side), :]
    return (joints * joints.new_tensor([1.0, -1.0, 1.0])).flatten(-2)
