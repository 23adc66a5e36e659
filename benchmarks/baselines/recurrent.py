"""A whole-body denoiser as a baseline: a causal recurrent network over all joints at once.

A GRU of 256 units receives the joints about the last pelvis, in the frame of the last hips, with missing joints held;
which joints are missing; and each joint's displacement since the frame before. It predicts a correction of the held
joints of each frame that a delay needs. It is trained on the corrupted motion of the SmoothNet-style baseline, rotated
about the vertical at random, and mirrored.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from steadypose.benchmarks.baselines.filters import hold_last, missing
from steadypose.benchmarks.baselines.smoothnet import Track, corrupt, descend, windows
from steadypose.benchmarks.motion import MotionClips
from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import MIRROR, J

WIDTH, BATCH, FRAMES = 256, 32, 60  # units of the network; clips per step, and their length
SCALE = 5.0  # units per metre in the network
_JOINTS = len(MIRROR)


class RecurrentDenoiser(nn.Module):
    """Maps held joints (N, T, 22, 3) and their missing mask (N, T, 22) to joints (N, T, D, 22, 3) at D delays."""

    def __init__(self, delays: Sequence[int]) -> None:
        super().__init__()
        self.delays = tuple(delays)
        self.gru = nn.GRU(7 * _JOINTS, WIDTH, batch_first=True)
        seen, asked = 7 * _JOINTS * len(self.delays), 3 * _JOINTS * len(self.delays)
        self.decode = nn.Linear(WIDTH + seen, asked)

    def forward(self, held: Tensor, gone: Tensor) -> Tensor:
        x, turn = _in_body_frame(held, gone)
        # keep the noise of earlier frames out of the state
        known = torch.cat([self.gru(x)[0], self.at_delay(x).flatten(2)], dim=-1)
        added = self.decode(known).unflatten(-1, (len(self.delays), _JOINTS, 3)) / SCALE
        return self.at_delay(held) + added @ turn[:, :, None].transpose(-1, -2)

    def at_delay(self, values: Tensor) -> Tensor:
        """Return values (N, T, ...) of as many frames before as each delay, or of the start: (N, T, D, ...)."""
        frames = torch.arange(values.shape[1])[:, None] - torch.tensor(self.delays)
        return values[:, frames.clamp(min=0)]


def train(
    motion: MotionClips, delays: Sequence[int], steps: int, seed: int, track: Track = lambda x: x
) -> RecurrentDenoiser:
    torch.manual_seed(seed)
    rng, net = np.random.default_rng((seed, 1)), RecurrentDenoiser(delays)

    def loss() -> Tensor:
        truth = _turned(motion.positions[windows(motion, FRAMES, BATCH, rng)], rng)
        error = net(*_inputs(corrupt(truth, rng))) - net.at_delay(_batch_first(truth))
        return error.abs().mean() + error.diff(n=2, dim=1).abs().mean()

    return descend(net, loss, steps, 3e-3, track)


@torch.inference_mode()
def smooth(net: RecurrentDenoiser, seen: Floats) -> list[Floats]:
    """Denoise clips (T, C, 22, 3) at each of the network's delays.

    The last frames of a clip are those of the shortest delay that has them.
    """
    found = net(*_inputs(seen)).numpy().swapaxes(0, 1).astype(np.float64)
    answers = []
    for number, delay in enumerate(net.delays):
        answer = np.empty(seen.shape)
        answer[: len(seen) - delay] = found[delay:, :, number]
        for back in range(delay):
            nearest = max(n for n, d in enumerate(net.delays) if d <= back)
            answer[len(seen) - 1 - back] = found[len(seen) - 1 - back + net.delays[nearest], :, nearest]
        answers.append(answer)
    return answers


def _in_body_frame(held: Tensor, gone: Tensor) -> tuple[Tensor, Tensor]:
    """Return the input (N, T, 154) about the pelvis, in the frames (N, T, 3, 3) of the hips, and these frames."""
    moved = torch.diff(held, dim=1, prepend=held[:, :1])
    origin, turn = held[:, :, J["pelvis"], None], _headings(held)
    x = torch.cat([SCALE * (held - origin) @ turn, 10 * SCALE * moved @ turn, gone[..., None]], dim=-1)
    return x.flatten(2), turn


def _headings(held: Tensor) -> Tensor:
    """Return frames (N, T, 3, 3), as columns, whose second axis is the level direction from right to left hip."""
    left = held[:, :, J["left_hip"]] - held[:, :, J["right_hip"]]
    left = nn.functional.normalize(left * torch.tensor([1.0, 1.0, 0.0]), dim=-1, eps=1e-3)
    up = torch.tensor([0.0, 0.0, 1.0]).expand_as(left)
    return torch.stack([torch.linalg.cross(left, up), left, up], dim=-1)


def _turned(truth: Floats, rng: np.random.Generator) -> Floats:
    """Rotate each clip (T, B, 22, 3) about the vertical, and mirror half of them."""
    angle = rng.uniform(0, 2 * np.pi, truth.shape[1])
    turn = np.zeros((truth.shape[1], 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = np.cos(angle)
    turn[:, 1, 0], turn[:, 0, 1], turn[:, 2, 2] = np.sin(angle), -np.sin(angle), 1.0
    mirrored = (rng.random(truth.shape[1]) < 0.5)[:, None, None]
    truth = np.where(mirrored, truth[:, :, MIRROR] * (1.0, -1.0, 1.0), truth)
    return np.einsum("bij,tbkj->tbki", turn, truth)


def _inputs(seen: Floats) -> tuple[Tensor, Tensor]:
    held = np.nan_to_num(hold_last(seen, np.arange(len(seen), dtype=np.float64), 0))
    return _batch_first(held), _batch_first(missing(seen).astype(float))


def _batch_first(values: Floats) -> Tensor:
    return torch.from_numpy(values.swapaxes(0, 1)).float()
