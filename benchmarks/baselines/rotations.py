"""Baselines for rotations: a Kalman filter of each joint's orientation, and a recurrent network from positions to 6D
rotations (Zhou et al. 2019, "On the Continuity of Rotation Representations in Neural Networks")."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
import torch
from scipy.linalg import solve_discrete_are
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from steadypose.benchmarks.baselines.recurrent import _batch_first, _headings, _inputs
from steadypose.benchmarks.baselines.smoothnet import corrupt, descend, windows
from steadypose.benchmarks.motion import MotionClips
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import global_rotations
from steadypose.prior.body.skeleton import J
from steadypose.prior.timing.rate import FPS

DENSITIES = tuple(10.0**power for power in range(-1, 6))
"""Process densities that are searched, rad²/s³, over the noise's variance in units of 0.01 rad²."""

_WIDTH, _SCALE, _BATCH, _FRAMES = 256, 5.0, 32, 60


def smooth_rotations(seen: Floats, density: float, lag: int) -> Floats:
    """Smooth orientations (T, ..., 3, 3) by an error-state Kalman filter of constant angular velocity and a fixed lag.

    In its steady state, whose gains depend on ``density`` alone. The last frames of a clip have the shorter lag that
    is left.
    """
    step, noise = 1.0 / FPS, np.array([[0.01]])
    f = np.array([[1.0, step], [0.0, 1.0]])
    q = density * 0.01 * np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
    h = np.array([[1.0, 0.0]])
    predicted = solve_discrete_are(f.T, h.T, q, noise)
    gain = (predicted @ h.T / (predicted[0, 0] + noise))[:, 0]
    updated = predicted - np.outer(gain, predicted[0])
    back = updated @ f.T @ np.linalg.inv(predicted)

    shape = seen.shape
    measured = seen.reshape(len(seen), -1, 3, 3)
    turn, rate = Rotation.from_matrix(measured[0]), np.zeros((measured.shape[1], 3))
    turns, rates = [turn], [rate]
    for now in measured[1:]:
        turn = turn * Rotation.from_rotvec(step * rate)
        apart = (turn.inv() * Rotation.from_matrix(now)).as_rotvec()
        turn, rate = turn * Rotation.from_rotvec(gain[0] * apart), rate + gain[1] * apart
        turns.append(turn)
        rates.append(rate)
    found = []
    for t in range(len(turns)):
        last = min(t + lag, len(turns) - 1)
        turn, rate = turns[last], rates[last]
        for k in range(last - 1, t - 1, -1):
            ahead = turns[k] * Rotation.from_rotvec(step * rates[k])
            apart, faster = (ahead.inv() * turn).as_rotvec(), rate - rates[k]
            turn = turns[k] * Rotation.from_rotvec(back[0, 0] * apart + back[0, 1] * faster)
            rate = rates[k] + back[1, 0] * apart + back[1, 1] * faster
        found.append(turn.as_matrix())
    return np.stack(found).reshape(shape)


class RotationNet(nn.Module):
    """Maps held joints (N, T, 22, 3) and their missing mask (N, T, 22) to orientations (N, T, R, 3, 3), ``lag`` frames
    back: a GRU with the inputs and the width of the whole-body denoiser."""

    def __init__(self, joints: Sequence[int], lag: int) -> None:
        super().__init__()
        self.joints, self.lag = list(joints), lag
        self.gru = nn.GRU(7 * len(J), _WIDTH, batch_first=True)
        self.decode = nn.Linear(_WIDTH, 6 * len(self.joints))

    def forward(self, held: Tensor, gone: Tensor) -> Tensor:
        moved = torch.diff(held, dim=1, prepend=held[:, :1])
        origin, turn = held[:, :, J["pelvis"], None], _headings(held)
        x = torch.cat([_SCALE * (held - origin) @ turn, 10 * _SCALE * moved @ turn, gone[..., None]], dim=-1)
        six = self.decode(self.gru(x.flatten(2))[0]).unflatten(-1, (len(self.joints), 2, 3))
        first = nn.functional.normalize(six[..., 0, :], dim=-1)
        second = six[..., 1, :] - (first * six[..., 1, :]).sum(dim=-1, keepdim=True) * first
        second = nn.functional.normalize(second, dim=-1)
        columns = torch.stack([first, second, torch.linalg.cross(first, second)], dim=-1)
        return turn[:, :, None] @ columns


def train_rotations(
    motion: MotionClips,
    joints: Sequence[int],
    lag: int,
    steps: int,
    track: Callable[[Iterable[int]], Iterable[int]] = lambda x: x,
) -> RotationNet:
    """Train on clips corrupted anew in every step."""
    torch.manual_seed(0)
    rng, net = np.random.default_rng(1), RotationNet(joints, lag)
    truth = global_rotations(motion.rotations)[:, :, net.joints]

    def loss() -> Tensor:
        picked = windows(motion, _FRAMES, _BATCH, rng)
        spun = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi, (_BATCH, 1))).as_matrix()
        seen = corrupt(np.einsum("bij,tbkj->tbki", spun, motion.positions[picked]), rng)
        wanted = _batch_first(spun[:, None] @ truth[picked])
        return (net(*_inputs(seen))[:, lag:] - wanted[:, : wanted.shape[1] - lag]).abs().mean()

    return descend(net, loss, steps, 3e-3, track)


@torch.inference_mode()
def predict_rotations(net: RotationNet, seen: Floats) -> Floats:
    """Return orientations (T, C, R, 3, 3) of joints (T, C, 22, 3); the last ``lag`` frames repeat the last one."""
    padded = np.concatenate([seen, np.repeat(seen[-1:], net.lag, axis=0)])
    return net(*_inputs(padded)).numpy().swapaxes(0, 1)[net.lag :].astype(np.float64)
