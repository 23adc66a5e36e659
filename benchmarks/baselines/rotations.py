"""Baselines for rotations.

Of all joints: a Kalman filter of each joint's orientation, and a recurrent network from positions to 6D rotations (Zhou
et al. 2019, "On the Continuity of Rotation Representations in Neural Networks"). Of the root, frame by frame: the line
of hips and shoulders, the rest pose's trunk laid on the joints, and that corrected by a ridge regression on the whole
body.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from scipy.linalg import solve_discrete_are
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from steadypose.benchmarks.baselines.recurrent import BATCH, FRAMES, WIDTH, _batch_first, _in_body_frame, _inputs
from steadypose.benchmarks.baselines.smoothnet import Track, corrupt, descend, windows
from steadypose.benchmarks.corruption import gaussian
from steadypose.benchmarks.motion import MotionClips
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import global_rotations
from steadypose.prior.body.skeleton import REST_POSITIONS, TRUNK, J
from steadypose.prior.models.posture import trunk_frame
from steadypose.prior.timing.rate import FPS

DENSITIES = tuple(10.0**power for power in range(-1, 6))
"""Process densities that are searched, rad²/s³, over the noise's variance in units of 0.01 rad²."""


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
        self.gru = nn.GRU(7 * len(J), WIDTH, batch_first=True)
        self.decode = nn.Linear(WIDTH, 6 * len(self.joints))

    def forward(self, held: Tensor, gone: Tensor) -> Tensor:
        x, turn = _in_body_frame(held, gone)
        six = self.decode(self.gru(x)[0]).unflatten(-1, (len(self.joints), 2, 3))
        first = nn.functional.normalize(six[..., 0, :], dim=-1)
        second = six[..., 1, :] - (first * six[..., 1, :]).sum(dim=-1, keepdim=True) * first
        second = nn.functional.normalize(second, dim=-1)
        columns = torch.stack([first, second, torch.linalg.cross(first, second)], dim=-1)
        return turn[:, :, None] @ columns


def train_rotations(
    motion: MotionClips, joints: Sequence[int], lag: int, steps: int, track: Track = lambda x: x
) -> RotationNet:
    torch.manual_seed(0)
    rng, net = np.random.default_rng(1), RotationNet(joints, lag)
    truth = global_rotations(motion.rotations)[:, :, net.joints]

    def loss() -> Tensor:
        picked = windows(motion, FRAMES, BATCH, rng)
        spun = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi, (BATCH, 1))).as_matrix()
        seen = corrupt(np.einsum("bij,tbkj->tbki", spun, motion.positions[picked]), rng)
        wanted = _batch_first(spun[:, None] @ truth[picked])
        return (net(*_inputs(seen))[:, lag:] - wanted[:, : wanted.shape[1] - lag]).abs().mean()

    return descend(net, loss, steps, 3e-3, track)


@torch.inference_mode()
def predict_rotations(net: RotationNet, seen: Floats) -> Floats:
    """Return orientations (T, C, R, 3, 3) of joints (T, C, 22, 3); the last ``lag`` frames repeat the last one."""
    padded = np.concatenate([seen, np.repeat(seen[-1:], net.lag, axis=0)])
    return net(*_inputs(padded)).numpy().swapaxes(0, 1)[net.lag :].astype(np.float64)


RIDGE, NOISE = 1e-3, 0.02
"""Ridge penalty of standardised features, per frame; and noise along an axis in which the ridge regression is fitted,
metres."""

Baseline = Callable[[Floats], Floats]
"""Maps joints (N, 22, 3) metres to root orientations (N, 3, 3), up to a constant rotation."""


def kabsch(positions: Floats) -> Floats:
    """Return the rotation (N, 3, 3) that brings the rest pose's trunk nearest to the trunk's joints (Kabsch 1976)."""
    trunk = list(TRUNK)
    seen, rest = positions[:, trunk], REST_POSITIONS[trunk]
    across = np.einsum("nja,jb->nab", seen - seen.mean(axis=1, keepdims=True), rest - rest.mean(axis=0))
    u, _, vt = np.linalg.svd(across)
    u[..., -1] *= np.linalg.det(u @ vt)[:, None]
    return u @ vt


def ridge(clips: MotionClips, seed: int) -> Baseline:
    """Correct `kabsch` by a ridge regression on all joints in its frame, fitted to these clips with noise."""
    truth = clips.positions.reshape(-1, 22, 3)
    noisy = gaussian(truth, NOISE, np.random.default_rng(seed))
    turned = kabsch(noisy)
    target = Rotation.from_matrix(turned.swapaxes(-1, -2) @ clips.rotations.reshape(-1, 22, 3, 3)[:, 0]).as_rotvec()
    x = _features(noisy, turned)
    mean, scale = x.mean(axis=0), x.std(axis=0) + 1e-6
    x = (x - mean) / scale
    fitted = np.linalg.solve(x.T @ x + RIDGE * len(x) * np.eye(x.shape[1]), x.T @ (target - target.mean(axis=0)))

    def corrected(positions: Floats) -> Floats:
        turned = kabsch(positions)
        vector = (_features(positions, turned) - mean) / scale @ fitted + target.mean(axis=0)
        return turned @ Rotation.from_rotvec(vector).as_matrix()

    return corrected


def _features(positions: Floats, turned: Floats) -> Floats:
    """Return the joints (N, 66) about the trunk's middle, in its frame."""
    return ((positions - positions[:, list(TRUNK)].mean(axis=1, keepdims=True)) @ turned).reshape(len(positions), -1)


def baselines(clips: MotionClips, seed: int) -> Mapping[str, Baseline]:
    """Return the baselines by name; ``clips`` are of training people."""
    return {"hips and shoulders": trunk_frame, "trunk, Kabsch": kabsch, "trunk, Kabsch and ridge": ridge(clips, seed)}
