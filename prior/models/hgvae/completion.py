"""Where the joints are that nobody saw, in one pass: the network that completes a window before HG-VAE looks at it.

HG-VAE's own encoder learns this badly: a node is one coordinate of one joint, all nodes share their weights, and the
likelihood of what was seen to the millimetre drowns what was hidden by decimetres. Here a node is a part of the
window's time and its features are the whole body, so that a knee follows from hip, ankle and the other leg.

People mostly hold still what they held still: then the line beside the joint above (`prior.models.hgvae.features`) is
right to the millimetre, and no network is. So what the network corrects is fused with that line, each by its variance;
the line's grows with the time from a sighting and with how much this joint of this person has moved while it was seen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from steadypose.prior.body.skeleton import PARENT, PARENTS
from steadypose.prior.models.layers.graph import JOINT_NODES, LOG_VAR_RANGE, SCALE, GraphBlock, GraphLinear

NEAR = 8.0
"""Frames from a sighting at which half is told of it. What is told falls as 1 / (1 + d / NEAR): by an exponential, an
arm seen a second ago would pass for one never seen."""

LAG = 5
"""Frames over which it is measured how much a joint moves beside the one above."""

GROWTH = 1.5
"""Exponent with which the variance of the line grows with the time from a sighting: 1 is a random walk's, 2 that of
constant speed. With two more parameters it can be learned; then the sensors of training that get joints plainly wrong
decide it, and arms that hold still are moved again."""

STILL = 0.004
"""Metres along an axis in `LAG` frames: what a joint that was never seen to move may do."""

CENTIMETRE = 0.01 / SCALE
"""in the network's units: how much joints jump about is told in these, by its logarithm"""

SLOW = 0.01
LEAST_SLOW = 0.002
"""Metres along an axis: errors that last are told in the one by their logarithm, those under the other as none."""

SURE = 0.01
"""Metres along an axis: a guess with this standard deviation is half believed."""

FIRST_LOG_VAR = -3.0
"""What the network's zero stands for, in units of `SCALE`: 4.5 cm."""

_JOINTS = JOINT_NODES // 3
_FRAME = JOINT_NODES + 2 * _JOINTS
"""Numbers that tell of a frame: tracks, and how near a joint's last and next sighting are."""

_WINDOW = 2 * _JOINTS + 2
"""Numbers that tell of a window: how much joints jump about, each and all, how much they move, and the sensor."""

_NEVER = -1.0


def _hanging() -> NDArray[np.float32]:
    """(22, 22) 1 where the line of a joint moves with that of another: its own, and those of the joints above."""
    hangs = np.eye(_JOINTS, dtype=np.float32)
    for joint in range(1, _JOINTS):
        if PARENTS[joint] > 0:
            hangs[joint] += hangs[PARENTS[joint]]
    return hangs


_HANGS = _hanging()


@dataclass(frozen=True)
class CompletionConfig:
    """Sizes.

    Attributes:
        patch: frames in a node; a window has whole patches.
        features: of each node.
        blocks: graph convolutional blocks between reading and writing.
    """

    patch: int = 5
    features: int = 256
    blocks: int = 4


class Told(NamedTuple):
    """Windows as the network reads them.

    Attributes:
        nodes: (B, T / patch, inputs) float32.
        moved: (B, 22) float32, by how much a joint moves in `LAG` frames beside the one above, without the noise: mean
            of the square along an axis, in units of `SCALE`.
        noise: (B, 22) float32, variance of a sighting along an axis: from frame to frame, and what lasts.
        apart: (B, 22, T) float32, frames from a sighting, less where it lies between two; 0 where seen, -1 of a joint
            never seen.
    """

    nodes: NDArray[np.float32]
    moved: NDArray[np.float32]
    noise: NDArray[np.float32]
    apart: NDArray[np.float32]


class CompletionNet(nn.Module):
    """A better guess of what was hidden, and how far off it will be; of windows of ``frames``."""

    def __init__(self, frames: int, config: CompletionConfig) -> None:
        super().__init__()
        if frames % config.patch:
            raise ValueError(f"expected frames in whole patches of {config.patch}, got {frames}")
        self.config = config
        nodes, features = frames // config.patch, config.features
        self.read = GraphLinear(nodes, nodes, _FRAME * config.patch + _WINDOW, features)
        self.blocks = nn.Sequential(*(GraphBlock(nodes, features) for _ in range(config.blocks)))
        self.write = GraphLinear(nodes, nodes, features, (JOINT_NODES + _JOINTS) * config.patch)
        self.register_buffer("hangs", torch.from_numpy(_HANGS), persistent=False)
        with torch.no_grad():
            self.write.weight.mul_(0.1)  # begins near the guess

    hangs: Tensor

    def forward(self, nodes: Tensor, moved: Tensor, noise: Tensor, apart: Tensor) -> tuple[Tensor, Tensor]:
        """The correction (B, 66, T) and the log-variance by joint (B, 22, T) of what it comes to, in units of `SCALE`.

        The arguments are those of `Told`.
        """
        written = self.write(self.blocks(F.gelu(self.read(nodes.transpose(0, 1))))).transpose(0, 1)
        return self.fuse(written, moved, noise, apart)

    def fuse(self, written: Tensor, moved: Tensor, noise: Tensor, apart: Tensor) -> tuple[Tensor, Tensor]:
        """What `forward` gives, from what the network writes (B, T / patch, 88 patch), and from the line.

        They are fused as normal distributions are, by their product.
        """
        found, log_var = written.split([JOINT_NODES * self.config.patch, _JOINTS * self.config.patch], dim=-1)
        log_var = (_by_track(log_var, _JOINTS) + FIRST_LOG_VAR).clamp(*LOG_VAR_RANGE)
        drift = (moved + (STILL / SCALE) ** 2)[:, :, None] * (apart.clamp(min=0.0) / LAG) ** GROWTH
        held = self.hangs @ torch.where(apart > 0, drift + noise[:, :, None], 0.0)
        leaning = torch.where(apart == _NEVER, 1.0, held / (held + log_var.exp()))
        fused = log_var + leaning.clamp(min=1e-6).log()
        return _by_track(found, JOINT_NODES) * leaning.repeat_interleave(3, dim=1), fused.clamp(*LOG_VAR_RANGE)

    def complete(
        self, deviations: Tensor, observed: Tensor, slow: NDArray[np.floating] | float
    ) -> tuple[Tensor, Tensor]:
        """Windows (B, 66, T) with a better guess of what was not observed, and its log-variance by joint (B, 22, T).

        The arguments are those of `tell`.
        """
        told = tell(deviations.numpy(), observed.numpy(), slow, self.config.patch)
        correction, log_var = self(*(torch.from_numpy(part) for part in told))
        return torch.where(observed > 0, deviations, deviations + correction), log_var


def certainty(observed: Tensor, log_var: Tensor) -> Tensor:
    """(B, 66, T) how far a completed window is to be believed: 1 where seen; of a guess half, if it is good to `SURE`.

    Args:
        observed: (B, 66, T) more than 0 where seen.
        log_var: (B, 22, T) of what was completed, in units of `SCALE`.
    """
    guessed = torch.sigmoid(2 * math.log(SURE / SCALE) - log_var)
    return torch.where(observed > 0, 1.0, guessed.repeat_interleave(3, dim=1))


def _by_track(nodes: Tensor, tracks: int) -> Tensor:
    """(B, T / patch, patch * tracks) to (B, tracks, T)"""
    return nodes.unflatten(-1, (-1, tracks)).flatten(1, 2).transpose(1, 2)


def tell(
    deviations: NDArray[np.floating], observed: NDArray[np.floating], slow: NDArray[np.floating] | float, patch: int
) -> Told:
    """Windows as `CompletionNet` reads them.

    Args:
        deviations: (B, 66, T) tracks about the training mean in units of `SCALE`, what was not seen guessed.
        observed: (B, 66, T) more than 0 where seen.
        slow: (B,) metres along an axis, the errors of the sensor that last.
        patch: frames in a node.
    """
    count, _, frames = deviations.shape
    told = np.empty((count, frames // patch, _FRAME * patch + _WINDOW), dtype=np.float32)
    moved, noise = np.empty((2, count, _JOINTS), dtype=np.float32)
    apart = np.empty((count, _JOINTS, frames), dtype=np.float32)
    _tell(deviations.astype(np.float32), observed.astype(np.float32), patch, told, moved, noise, apart)
    slow = np.reshape(np.maximum(slow, LEAST_SLOW), (-1, 1))
    told[..., -1] = np.log(slow / SLOW)
    noise += (slow / SCALE) ** 2
    return Told(told, moved, noise, apart)


@njit(cache=True)
def _tell(deviations, observed, patch, told, moved, noise, apart):
    count, tracks, frames = deviations.shape
    joints = tracks // 3
    frame = tracks + 2 * joints
    seen = np.empty((joints, frames))
    for b in range(count):
        for track in range(tracks):
            for t in range(frames):
                told[b, t // patch, (t % patch) * frame + track] = deviations[b, track, t]
        for joint in range(joints):
            since = frames
            for t in range(frames):
                seen[joint, t] = min(
                    observed[b, 3 * joint, t], observed[b, 3 * joint + 1, t], observed[b, 3 * joint + 2, t]
                )
                since = 0 if seen[joint, t] > 0 else min(since + 1, frames)
                apart[b, joint, t] = since
                near = 1.0 / (1.0 + since / NEAR) if since < frames else 0.0
                told[b, t // patch, (t % patch) * frame + tracks + joint] = near
            since = frames
            for t in range(frames - 1, -1, -1):
                since = 0 if seen[joint, t] > 0 else min(since + 1, frames)
                near = 1.0 / (1.0 + since / NEAR) if since < frames else 0.0
                told[b, t // patch, (t % patch) * frame + tracks + joints + joint] = near
                last = apart[b, joint, t]
                if last == frames and since == frames:
                    apart[b, joint, t] = _NEVER
                elif last == frames or since == frames:
                    apart[b, joint, t] = min(last, since)
                elif since > 0:
                    apart[b, joint, t] = last * since / (last + since)
        _tell_noise(deviations[b], seen, told[b, :, patch * frame :], noise[b])
        _tell_moved(deviations[b], seen, moved[b])
        for joint in range(joints):
            told[b, :, patch * frame + joints + 1 + joint] = 0.5 * math.log(moved[b, joint] / CENTIMETRE**2 + 1e-3)
            moved[b, joint] = max(moved[b, joint] - 2 * noise[b, joint], 0.0)


@njit(cache=True)
def _tell_moved(deviations, seen, moved):
    """How much each joint moves in `LAG` frames beside the one above; as all do, where that was not to be seen."""
    tracks, frames = deviations.shape
    joints = tracks // 3
    counts = np.zeros(joints)
    moved[:] = 0.0
    for joint in range(joints):
        above = PARENT[joint]
        for t in range(LAG, frames):
            if seen[joint, t] > 0 and seen[joint, t - LAG] > 0:
                counts[joint] += 1
                for axis in range(3):
                    way = deviations[3 * joint + axis, t] - deviations[3 * joint + axis, t - LAG]
                    if above > 0:
                        way -= deviations[3 * above + axis, t] - deviations[3 * above + axis, t - LAG]
                    moved[joint] += way * way / 3
    together = moved.sum() / max(counts.sum(), 1.0)
    for joint in range(joints):
        moved[joint] = moved[joint] / counts[joint] if counts[joint] > 0 else together


@njit(cache=True)
def _tell_noise(deviations, seen, told, noise):
    """How much each joint jumps about, by the second difference of its track, and how much all do, to every node."""
    tracks, frames = deviations.shape
    joints = tracks // 3
    squares, counts = np.zeros(joints), np.zeros(joints)
    for joint in range(joints):
        for t in range(1, frames - 1):
            if seen[joint, t - 1] > 0 and seen[joint, t] > 0 and seen[joint, t + 1] > 0:
                counts[joint] += 1
                for axis in range(3):
                    track = deviations[3 * joint + axis]
                    squares[joint] += (track[t - 1] - 2 * track[t] + track[t + 1]) ** 2
    together = squares.sum() / max(counts.sum(), 1.0)
    for joint in range(joints + 1):
        alone = joint < joints and counts[joint] > 3
        square = squares[joint] / counts[joint] if alone else together
        told[:, joint] = 0.25 * math.log(square / CENTIMETRE**2 + 1e-3)
        if joint < joints:
            noise[joint] = square / 18  # a second difference has six times the variance, and this is of three axes
