"""Motion completion by optimisation through HM-VAE (section 4, equations 14 and 15): latents first, then the decoder
too.

The paper starts from random latents; here, they are encoded from the completer's output. There are three differences
from the official code: losses are means over known entries only, the best iterate is kept instead of the last, and the
output is continuous at the known poses, where the official code overwrites key frames. It needs torch.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.kinematics import rotation_matrices
from steadypose.prior.body.skeleton import finite_joints
from steadypose.prior.complete.parts import PartsCompleter
from steadypose.prior.fit.hmvae_network import HMVAE
from steadypose.prior.fit.tensors import forward_kinematics, from_6d, load_network, remove_heading, to_6d
from steadypose.prior.models.completer_features import rotations_of_6d, solved_rotations
from steadypose.prior.models.hmvae import HMVAEConfig
from steadypose.prior.models.line import anchored, draw_line

MODEL = "hmvae64"  # name of the model's weights

LATENT_STEPS, LATENT_RATE, RANDOM_RATE = 50, 0.01, 0.1
DECODER_STEPS, DECODER_RATE = 100, 1e-4
"""Steps and learning rates of Adam, in the first phase over the latents and in the second over the decoder too. The
official rate of the latents suits random ones; it moves the completer's latents too far (benchmarks/NOTEBOOK.md)."""

JOINT_WEIGHT = 10.0  # weight lambda_1 of equation 14
STAY_WEIGHT = 1000.0  # weight lambda_2 of equation 15, of the mean squared change of each of the decoder's tensors
AGREE_WEIGHT = 1.0  # weight of the mean squared difference between overlapping windows


@dataclass(frozen=True)
class _Known:
    """The known entries of W windows of T frames, in the windows' frames."""

    columns: Tensor  # (W, T, 22, 6) first two columns of local rotations
    rotations: Tensor  # (W, T, 22, 1) 1 where rotations are known, else 0
    joints: Tensor  # (W, T, 22, 3) metres relative to the root
    places: Tensor  # (W, T, 22, 1) 1 where joints are known, else 0
    offsets: Tensor  # (22, 3) metres, bones

    def loss(self, decoded: Tensor) -> Tensor:
        """Equation 14 for windows (W, T, 22, 6); each term is a mean over known entries."""
        matrices = from_6d(decoded)
        joints, _ = forward_kinematics(matrices, self.offsets)
        count = self.rotations.sum().clamp(min=1.0)
        l_6d = ((decoded - self.columns).square() * self.rotations).sum() / (6 * count)
        l_rot = ((matrices - from_6d(self.columns)).square() * self.rotations[..., None]).sum() / (9 * count)
        l_joints = ((joints - self.joints).square() * self.places).sum() / (3 * self.places.sum().clamp(min=1.0))
        return l_6d + l_rot + JOINT_WEIGHT * l_joints


class Optimiser:
    """Completes windows like `PartsCompleter`, by optimisation through ``model`` from the output of ``completer``,
    which also gives the root. ``seed`` draws initial latents, as in the paper; None takes those of that output."""

    def __init__(self, model: HMVAE, completer: PartsCompleter, seed: int | None = None) -> None:
        self._model, self._completer, self._seed = model.eval(), completer, seed

    @classmethod
    def load(cls, weights: str, completer: PartsCompleter, seed: int | None = None) -> Optimiser:
        """Load the weights of this name.

        Raises:
            FileNotFoundError: there are none; the message lists those that exist.
        """
        return cls(load_network(HMVAE, HMVAEConfig.from_dict, weights, MODEL), completer, seed)

    def __call__(self, positions: Floats, offsets: Floats) -> tuple[Floats, Floats]:
        """Return local rotations (B, T, 22, 3, 3), and the completer's root (B, T, 3) metres, like `PartsCompleter`."""
        rotations, root = self._completer(positions, offsets)
        for window in range(len(positions)):
            rotations[window] = self._searched(positions[window], offsets[window], rotations[window])
        return rotations, root

    def _searched(self, positions: Floats, offsets: Floats, start: Floats) -> Floats:
        """Optimise the rotations (T, 22, 3, 3) of one window, from the completer's ``start`` (T, 22, 3, 3)."""
        usual = rotation_matrices(self._completer.usual)
        solved, known = solved_rotations(positions, np.broadcast_to(offsets, positions.shape), usual)
        frames, length = len(positions), self._model.window
        starts = np.unique(np.linspace(0, max(frames - length, 0), -(-frames // length) or 1).round().astype(int))
        rows = starts[:, None] + np.arange(length)
        inside, rows = rows < frames, np.minimum(rows, frames - 1)
        begun, back = remove_heading(torch.from_numpy(start[rows]).float(), length // 2 - 1)
        given = np.where(known[..., None, None], solved, start)
        about = torch.from_numpy(given[rows]).float()
        about[:, :, 0] = back.mT[:, None] @ about[:, :, 0]
        joints = torch.from_numpy(np.nan_to_num(positions - positions[:, :1])[rows]).float() @ back[:, None]
        placed = finite_joints(positions - positions[:, :1])
        seen = _Known(
            to_6d(about), _mask(known[rows] & inside[..., None]), joints, _mask(placed[rows] & inside[..., None]),
            torch.from_numpy(offsets).float(),
        )  # fmt: skip
        decoded = from_6d(self._search(to_6d(begun), seen, starts, back))
        decoded[:, :, 0] = back[:, None] @ decoded[:, :, 0]
        columns, total = np.zeros((frames, 22, 6)), np.zeros(frames)
        fade = np.minimum(np.arange(1, length + 1), np.arange(length, 0, -1)).astype(np.float64)
        for k, window in enumerate(to_6d(decoded).double().numpy()):
            some = rows[k][inside[k]]
            columns[some] += fade[inside[k], None, None] * window[inside[k]]
            total[some] += fade[inside[k]]
        return self._meeting_known(columns / total[:, None, None], given, known)

    def _search(self, begun: Tensor, seen: _Known, starts: NDArray[np.int64], back: Tensor) -> Tensor:
        """Return the windows (W, T, 22, 6) of least loss over all iterations."""
        model = copy.deepcopy(self._model)  # phase two changes its decoder
        with torch.no_grad():
            posterior = model.encode(begun)
        latents = [posterior.local_mean.clone(), posterior.global_mean.clone()]
        if self._seed is not None:
            generator = torch.Generator().manual_seed(self._seed)
            latents = [torch.randn(latent.shape, generator=generator) for latent in latents]
        decoder = [model.from_local, model.from_global, model.decoder]
        weights = [p for part in decoder for p in part.parameters()]
        before = [p.detach().clone() for p in weights]
        for p in model.parameters():
            p.requires_grad = False
        for latent in latents:
            latent.requires_grad = True
        best, least = begun, torch.tensor(torch.inf)
        optimiser = torch.optim.Adam(latents, lr=LATENT_RATE if self._seed is None else RANDOM_RATE)
        schedule = torch.optim.lr_scheduler.StepLR(optimiser, LATENT_STEPS, gamma=0.1)
        for step in range(LATENT_STEPS + DECODER_STEPS + 1):
            if step == LATENT_STEPS:
                for p in weights:
                    p.requires_grad = True
                optimiser.add_param_group({"params": weights, "lr": DECODER_RATE})
            decoded = model.placed(model.decode(latents[0], latents[1]), begun)
            loss = seen.loss(decoded) + AGREE_WEIGHT * _disagreement(decoded, starts, back)
            if step >= LATENT_STEPS:
                stray = [(a - b).square().mean() for a, b in zip(weights, before, strict=True)]
                loss = loss + STAY_WEIGHT * torch.stack(stray).sum()
            if loss.detach() < least:
                best, least = decoded.detach(), loss.detach()
            if step == LATENT_STEPS + DECODER_STEPS:
                break
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
        return best

    def _meeting_known(self, columns: Floats, given: Floats, known: Bools) -> Floats:
        """Return rotations (T, 22, 3, 3) from ``columns`` (T, 22, 6), corrected over time to meet the known ones."""
        line = draw_line(known[None])
        wanted = given[..., :2].swapaxes(-1, -2).reshape(columns.shape)
        off = np.where(known[..., None], wanted - columns, 0.0)[None]
        everything = slice(0, known.shape[1])
        return rotations_of_6d(columns + (off - anchored(off, line, everything))[0])


def _mask(known: Bools) -> Tensor:
    return torch.from_numpy(known[..., None].astype(np.float32))


def _disagreement(decoded: Tensor, starts: NDArray[np.int64], back: Tensor) -> Tensor:
    """Mean squared difference of overlapping windows (W, T, 22, 6), each turned by ``back`` (W, 3, 3)."""
    total = decoded.new_zeros(())
    turned = from_6d(decoded)
    for k in range(len(starts) - 1):
        shift = int(starts[k + 1] - starts[k])
        first, second = turned[k, shift:], turned[k + 1, : turned.shape[1] - shift]
        roots = [back[k + n] @ part[:, 0] for n, part in enumerate((first, second))]
        total = total + (first[:, 1:] - second[:, 1:]).square().mean() + (roots[0] - roots[1]).square().mean()
    return total
