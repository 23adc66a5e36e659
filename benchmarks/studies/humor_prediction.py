"""Futures (Table 1): how near the best of fifty comes to what happened, and how different they are."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from steadypose.benchmarks.motion import MotionClips
from steadypose.prior.body.kinematics import CONTACT_JOINTS
from steadypose.prior.fit.humor_network import HumorNet, Rollout, sample
from steadypose.prior.fit.humor_state import State, states_of

SAMPLES, LONG_S = 50, 5.0
"""As in the paper."""

SPARED = 4
"""Times fewer samples are drawn of the long futures: pairs are many."""

LOWEST_M, HIGHEST_M = 0.1, 1.6
"""Of a pelvis: a future in which it is ever lower or higher has gone astray. None of the truth has."""


def initial_states(clips: MotionClips) -> tuple[State, State, Tensor]:
    """First states (C,), all that follow (C, T), of people on their bones, and these bones."""
    root, rotations = (
        torch.from_numpy(np.ascontiguousarray(values.swapaxes(0, 1))).float()
        for values in (clips.positions[:, :, 0], clips.rotations)
    )
    offsets = torch.from_numpy(clips.offsets).float()
    states = states_of(root, rotations, offsets)
    return states[:, 0], states[:, 1:], offsets


@torch.no_grad()
def predict(model: HumorNet, clips: MotionClips, samples: int) -> dict[str, Any]:
    """Figures of Table 1 for one model; clips of a little over two seconds."""
    first, truth, offsets = initial_states(clips)
    steps = truth.root.shape[1]
    generator = torch.Generator().manual_seed(0)
    futures = sample(model, _times(first, samples), steps, offsets.repeat_interleave(samples, 0), generator)
    joints = futures.states.joints.unflatten(0, (-1, samples))
    error = (joints - truth.joints.unsqueeze(1)).norm(dim=-1).mean(dim=-1)  # (C, S, T)
    best = error.mean(dim=-1).argmin(dim=1)
    rows = torch.arange(len(best))
    few = max(samples // SPARED, 2)
    long = sample(model, _times(first, few), int(LONG_S * 30), offsets.repeat_interleave(few, 0), generator)
    found = {
        "ade_mm": _mm(error.mean(dim=-1)[rows, best].mean()),
        "fde_mm": _mm(error[rows, best, -1].mean()),
        "apd_mm": _mm(_pairwise(long.states.joints.unflatten(0, (-1, few)))),
        "astray_percent": round(100 * float(_astray(long)), 2),
    }
    likeliest = sample(model, first, steps, offsets, None)
    found["likeliest_ade_mm"] = _mm((likeliest.states.joints - truth.joints).norm(dim=-1).mean())
    if model.config.contacts:
        said = futures.contacts.unflatten(0, (-1, samples))[rows, best][..., len(CONTACT_JOINTS) :] > 0
        true = torch.from_numpy(np.ascontiguousarray(clips.contacts[2:].swapaxes(0, 1)))
        found["contact_accuracy"] = round(float((said == true).float().mean()), 4)
    return found


def stand_still(clips: MotionClips) -> dict[str, Any]:
    """The same of a body that stays as it is, the plainest guess."""
    first, truth, _ = initial_states(clips)
    error = (first.joints.unsqueeze(1) - truth.joints).norm(dim=-1).mean(dim=-1)
    return {"ade_mm": _mm(error.mean()), "fde_mm": _mm(error[:, -1].mean()), "likeliest_ade_mm": _mm(error.mean())}


def _times(state: State, count: int) -> State:
    return state[torch.arange(len(state.root)).repeat_interleave(count)]


def _pairwise(joints: Tensor) -> Tensor:
    """Mean distance of joints (C, S, T, 22, 3) between all pairs of samples."""
    first, second = torch.triu_indices(joints.shape[1], joints.shape[1], offset=1)
    return torch.stack([(clip[first] - clip[second]).norm(dim=-1).mean() for clip in joints]).mean()


def _astray(long: Rollout) -> Tensor:
    height = long.states.root[..., 2]
    return ((height < LOWEST_M) | (height > HIGHEST_M) | ~torch.isfinite(height)).any(dim=1).float().mean()


def _mm(value: Tensor) -> float:
    return round(float(value) * 1e3, 1)
