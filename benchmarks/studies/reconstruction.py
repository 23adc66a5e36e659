"""Windowed reconstruction (Li et al. 2021, table 3): clean windows through the posterior's mean and the decoder.

Windows are encoded and decoded as refinement does (equations 10 and 11): of 8 frames and of 64, for each of which a
model ships, or 64 pieced together from 8, side by side or by sliding and keeping centre frames (equation 12). The
paper's peers, a VAE without the hierarchy and one without the skeleton, are trained here, and HM-VAE once more exactly
as they are (`benchmarks.baselines.window_vaes`). Joints are placed by forward kinematics on the person's bones with the
pelvis at the origin, so that errors are of the pose with its orientation, not of its place. The trivial peer repeats
the window's centre frame.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from steadypose.benchmarks.baselines import window_vaes
from steadypose.benchmarks.bench import Bench, Result
from steadypose.benchmarks.results import Table
from steadypose.benchmarks.scores import figures, score
from steadypose.prior.arrays import Floats
from steadypose.prior.fit.hmvae_network import HMVAE, MotionVAE
from steadypose.prior.fit.tensors import forward_kinematics, from_6d, load_network, remove_heading, to_6d
from steadypose.prior.models.hmvae import HMVAEConfig

DEPENDS_ON = ("hmvae weights", "hmvae64 weights")

FRAMES = 64


def run(bench: Bench) -> Result:
    """Every model over validation motion."""
    clips = bench.clips(FRAMES, 192)
    rotations = torch.from_numpy(clips.rotations).float().transpose(0, 1)  # (C, T, 22, 3, 3)
    bones = torch.from_numpy(clips.offsets).float()
    pieces = rotations.unflatten(1, (-1, 8)).flatten(0, 1)
    truths = {8: (pieces, bones.repeat_interleave(FRAMES // 8, dim=0)), FRAMES: (rotations, bones)}

    def joints(poses: torch.Tensor, on: torch.Tensor) -> Floats:
        return forward_kinematics(poses, on[:, None])[0].transpose(0, 1).double().numpy()

    def scored(method: str, frames: int, decode: Callable[[torch.Tensor], torch.Tensor]) -> dict[str, Any]:
        windows, on = truths[frames]
        truth = joints(windows, on)
        answer, nothing = joints(decode(windows), on), np.zeros(truth.shape[:-1], dtype=bool)
        if not np.isfinite(answer).all():
            raise ValueError(f"{method}, {frames} frames: expected joints, and its training has diverged")
        return {"method": method, "window": frames, **figures(score(answer, truth, nothing))}

    records = [scored("centre frame held", 8, lambda windows: windows[:, 3, None].expand_as(windows))]
    model, name = shipped("hmvae"), "HM-VAE as shipped"
    long = shipped("hmvae64")
    records += [
        scored(name, 8, lambda windows: reconstruct(model, windows)),
        scored(
            f"{name}, 8 frames side by side", FRAMES,
            lambda _: reconstruct(model, pieces).unflatten(0, (-1, FRAMES // 8)).flatten(1, 2),
        ),
        scored(f"{name}, 8 frames sliding", FRAMES, lambda windows: slide(model, windows)),
        scored(f"{name}, 64 frames", FRAMES, lambda windows: reconstruct(long, windows)),
    ]  # fmt: skip
    for frames in window_vaes.CONFIGS:
        for name in window_vaes.MODELS:
            model = bench.window_vae(name, frames)
            records.append(
                scored(f"{name}, trained alike", frames, lambda windows, model=model: reconstruct(model, windows))
            )
    records.sort(key=lambda record: record["window"])
    data = {"data": clips.source, "training steps": dict(window_vaes.STEPS), "records": records}
    truth = joints(rotations, bones)
    own = figures(score(truth, truth, np.zeros(truth.shape[:-1], dtype=bool)))["own_acceleration_mm"]
    return Result([_table(records, len(rotations), own)], data)


def _table(records: list[dict[str, Any]], clips: int, own_acceleration_mm: float) -> Table:
    keys = {
        "position_mm": "MPJPE, mm", "pa_mm": "PA-MPJPE, mm", "own_acceleration_mm": "acceleration, mm/frame²",
        "acceleration_mm": "acceleration error, mm/frame²",
    }  # fmt: skip
    steps = " and ".join(f"{count} of windows of {frames}" for frames, count in window_vaes.STEPS.items())
    return Table(
        name="reconstruction",
        title="Reconstruction of clean windows (HM-VAE, table 3)",
        columns=["method", "frames", *keys.values()],
        rows=[[r["method"], str(r["window"]), *(f"{r[key]:.2f}" for key in keys)] for r in records],
        note=(
            f"{clips} clips of {FRAMES} frames, 22 joints, pelvis at the origin. Acceleration of the truth: "
            f"{own_acceleration_mm:.2f} mm/frame². Trained alike: from scratch on the default set, same losses "
            f"and steps ({steps} frames, {window_vaes.FRAMES_A_STEP} frames a step), and as many latent dimensions and "
            "parameters. Not comparable with the paper's figures, which are on AMASS."
        ),
    )


def shipped(name: str) -> HMVAE:
    """A model that ships: ``hmvae``, of 8 frames, or ``hmvae64``."""
    return load_network(HMVAE, HMVAEConfig.from_dict, "default", name)


@torch.inference_mode()
def reconstruct(model: MotionVAE, windows: torch.Tensor) -> torch.Tensor:
    """Windows (B, T, 22, 3, 3) of local rotations, encoded and decoded; the heading is taken off and put back."""
    turned, back = remove_heading(windows, model.window // 2 - 1)
    decoded = from_6d(torch.cat([model.reconstruct(to_6d(part)) for part in turned.split(512)]))
    decoded[:, :, 0] = back[:, None] @ decoded[:, :, 0]
    return decoded


def slide(model: MotionVAE, clips: torch.Tensor) -> torch.Tensor:
    """Clips (C, T, 22, 3, 3) by windows that slide by one frame; each frame from where it is nearest to the centre."""
    window, frames = model.window, clips.shape[1]
    starts = np.arange(frames - window + 1)
    wanted = np.clip(np.arange(frames) - (window // 2 - 1), 0, starts[-1])
    windows = torch.stack([clips[:, s : s + window] for s in starts], dim=1)
    decoded = reconstruct(model, windows.flatten(0, 1)).unflatten(0, (len(clips), -1))
    return torch.stack([decoded[:, s, t - s] for t, s in enumerate(wanted)], dim=1)
