"""A SmoothNet-style baseline: a small network along time alone, the same for every coordinate of every joint.

After Zeng et al., "SmoothNet: A Plug-and-Play Network for Refining Human Poses in Videos", ECCV 2022: fully connected
residual blocks over a window of 32 frames, losses on positions and accelerations. Here it also sees which frames a
joint was missing in, and is trained on this project's motion, corrupted as the protocols do. One training serves every
delay: of the 32 frames that a window gives, a delay of k keeps the one k before the newest.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
import torch
from torch import Tensor, nn

from steadypose.benchmarks.baselines.filters import hold_last, missing
from steadypose.benchmarks.corruption import LIMBS, correlated, gaussian, hide, spiked
from steadypose.benchmarks.motion import MotionClips
from steadypose.prior.arrays import Floats

WINDOW = 32
"""Frames."""
_WIDTH, _BLOCKS = 128, 3
_SCALE = 10.0  # a metre in the network's unit
_BATCH = 16  # windows of whole bodies


class SmoothNet(nn.Module):
    """(N, 32) positions along an axis, missing ones held, and (N, 32) which are missing, to (N, 32) positions."""

    def __init__(self) -> None:
        super().__init__()
        self.encode = nn.Sequential(nn.Linear(2 * WINDOW, _WIDTH), nn.LeakyReLU(0.1))
        self.blocks = nn.ModuleList(
            nn.Sequential(nn.Linear(_WIDTH, _WIDTH), nn.LeakyReLU(0.1), nn.Linear(_WIDTH, _WIDTH), nn.LeakyReLU(0.1))
            for _ in range(_BLOCKS)
        )
        self.decode = nn.Linear(_WIDTH, WINDOW)

    def forward(self, held: Tensor, gone: Tensor) -> Tensor:
        middle = held.mean(dim=-1, keepdim=True)
        x = self.encode(torch.cat([_SCALE * (held - middle), gone], dim=-1))
        for block in self.blocks:
            x = x + block(x)
        return held + self.decode(x) / _SCALE


def train(
    motion: MotionClips, steps: int, seed: int, track: Callable[[Iterable[int]], Iterable[int]] = lambda x: x
) -> SmoothNet:
    """Train on clips corrupted anew in every step."""
    torch.manual_seed(seed)
    rng = np.random.default_rng((seed, 1))
    net = SmoothNet()
    optimiser = torch.optim.Adam(net.parameters())
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 1e-2, total_steps=steps)
    frames, clips = motion.positions.shape[:2]
    for _ in track(range(steps)):
        rows = rng.integers(frames - WINDOW, endpoint=True, size=_BATCH) + np.arange(WINDOW)[:, None]
        truth = motion.positions[rows, rng.integers(clips, size=_BATCH)]
        held, gone = _inputs(corrupt(truth, rng))
        wanted = torch.from_numpy(np.moveaxis(truth, 0, -1)).float()
        answer = net(held, gone)
        position = (answer - wanted).abs().mean()
        acceleration = (answer - wanted).diff(n=2, dim=-1).abs().mean()
        optimiser.zero_grad()
        (position + acceleration).backward()
        optimiser.step()
        schedule.step()
    return net.eval()


@torch.inference_mode()
def smooth(net: SmoothNet, seen: Floats, delays: Sequence[int]) -> list[Floats]:
    """Answers (T, ..., 3) of clips (T, ..., 3) at each delay, all of them from the same windows."""
    last = len(seen) - 1
    lead = np.broadcast_to(seen[:1], (WINDOW - 1, *seen.shape[1:]))  # a clip younger than the window repeats its start
    held, gone = _inputs(np.concatenate([lead, seen]))
    answers = [np.empty(seen.shape) for _ in delays]
    for newest in range(len(seen)):
        window = net(held[..., newest : newest + WINDOW], gone[..., newest : newest + WINDOW]).numpy()
        for answer, delay in zip(answers, delays, strict=True):
            for back in range(delay + 1) if newest == last else (delay,):
                if back <= newest:
                    answer[newest - back] = window[..., WINDOW - 1 - back]
    return answers


def _inputs(seen: Floats) -> tuple[Tensor, Tensor]:
    """(..., 3, T) positions held, and which are missing, of (T, ..., 3)."""
    held = hold_last(seen, np.arange(len(seen), dtype=np.float64), 0)
    gone = np.repeat(missing(seen)[..., None], 3, axis=-1)
    return tuple(torch.from_numpy(np.moveaxis(x, 0, -1)).float().contiguous() for x in (held, gone))  # type: ignore[return-value]


def corrupt(truth: Floats, rng: np.random.Generator) -> Floats:
    """Each window with a noise of its own, (T, B, 22, 3): 0.5 to 8 cm, independent or correlated; spikes in a third
    of them; in half, a limb away, but never from the start."""
    size = np.exp(rng.uniform(np.log(0.005), np.log(0.08), truth.shape[1]))[:, None, None]
    zero = np.zeros_like(truth)
    kind = rng.random(truth.shape[1]) < 0.5
    noise = np.where(kind[:, None, None], gaussian(zero, 1.0, rng), correlated(zero, 1.0, rng))
    seen = truth + size * noise
    seen = np.where((rng.random(truth.shape[1]) < 0.33)[:, None, None], spiked(seen, rng), seen)
    hidden = np.zeros(truth.shape[:-1], dtype=bool)
    for window in np.flatnonzero(rng.random(truth.shape[1]) < 0.5):
        start = rng.integers(1, len(truth))
        end = start + rng.integers(1, len(truth))
        hidden[start:end, window, LIMBS[rng.integers(len(LIMBS))]] = True
    return hide(seen, hidden)
