"""A SmoothNet-style baseline: a small network along time only, the same for every coordinate of every joint.

After Zeng et al., "SmoothNet: A Plug-and-Play Network for Refining Human Poses in Videos", ECCV 2022: fully connected
residual blocks over a window of 32 frames, with losses on positions and accelerations. Here it also receives in which
frames a joint was missing, and is trained on this project's motion, corrupted as in the studies. One training serves
every delay: for a delay of k, the output is the frame k before the newest of the window.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from steadypose.benchmarks.baselines.filters import hold_last, missing
from steadypose.benchmarks.corruption import LIMBS, correlated, gaussian, hide, spiked
from steadypose.benchmarks.motion import MotionClips
from steadypose.prior.arrays import Floats

WINDOW = 32  # length of a window, frames
_WIDTH, _BLOCKS = 128, 3
_SCALE = 10.0  # units per metre in the network
_BATCH = 16  # windows of whole bodies

Track = Callable[[Iterable[int]], Iterable[int]]  # type of what shows the progress of a loop


class SmoothNet(nn.Module):
    """Maps positions along an axis (N, 32), missing ones held, and their missing mask (N, 32) to positions (N, 32)."""

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


def train(motion: MotionClips, steps: int, seed: int, track: Track = lambda x: x) -> SmoothNet:
    torch.manual_seed(seed)
    rng, net = np.random.default_rng((seed, 1)), SmoothNet()

    def loss() -> Tensor:
        truth = motion.positions[windows(motion, WINDOW, _BATCH, rng)]
        error = net(*_inputs(corrupt(truth, rng))) - torch.from_numpy(np.moveaxis(truth, 0, -1)).float()
        return error.abs().mean() + error.diff(n=2, dim=-1).abs().mean()

    return descend(net, loss, steps, 1e-2, track)


Network = TypeVar("Network", bound=nn.Module)


def descend(net: Network, loss: Callable[[], Tensor], steps: int, rate: float, track: Track) -> Network:
    """Minimise ``loss()`` by Adam, with one cycle of learning rates up to ``rate`` and clipped gradients."""
    optimiser = torch.optim.Adam(net.parameters())
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=steps)
    for _ in track(range(steps)):
        found = loss()
        optimiser.zero_grad()
        found.backward()
        nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimiser.step()
        schedule.step()
    return net.eval()


def windows(motion: MotionClips, length: int, count: int, rng: np.random.Generator) -> tuple[NDArray, NDArray]:
    """Return the frames (T, N) and clips (N,) of random windows of at most ``length`` frames."""
    frames, clips = motion.positions.shape[:2]
    length = min(length, frames)
    rows = rng.integers(frames - length, endpoint=True, size=count) + np.arange(length)[:, None]
    return rows, rng.integers(clips, size=count)


@torch.inference_mode()
def smooth(net: SmoothNet, seen: Floats, delays: Sequence[int]) -> list[Floats]:
    """Smooth clips (T, ..., 3) at each delay, all from the same windows."""
    last = len(seen) - 1
    lead = np.broadcast_to(seen[:1], (WINDOW - 1, *seen.shape[1:]))  # a clip shorter than the window repeats its start
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
    """Return held positions and the missing mask, (..., 3, T), of (T, ..., 3)."""
    held = hold_last(seen, np.arange(len(seen), dtype=np.float64), 0)
    gone = np.repeat(missing(seen)[..., None], 3, axis=-1)
    return tuple(torch.from_numpy(np.moveaxis(x, 0, -1)).float().contiguous() for x in (held, gone))  # type: ignore[return-value]


def corrupt(truth: Floats, rng: np.random.Generator) -> Floats:
    """Corrupt each window (T, B, 22, 3) with its own noise.

    The noise is 0.5 to 8 cm, independent or correlated. A third has spikes. In half a limb is missing, but never from
    the start.
    """
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
