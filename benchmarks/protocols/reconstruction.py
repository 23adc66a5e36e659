"""Windowed reconstruction (Li et al. 2021, table 3): clean windows through the refinement model's posterior mean.

Windows are encoded and decoded as refinement does (equations 10 and 11). Frames of 8 are what the model was trained
on; 64 frames are pieced together, either of eight windows side by side or by sliding and keeping centre frames
(equation 12). Joints are placed by forward kinematics on the person's bones with the pelvis at the origin, so that
errors are of the pose with its orientation, not of its place. Bones at rest: the paper's "mean pose" has no meaning
in rotations, so the trivial peer repeats the window's centre frame.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.bench import Bench, Result
from benchmarks.results import Table
from benchmarks.scores import Scores, figures, score
from prior.checkpoint import load_weights
from prior.hmvae import HMVAE, HMVAEConfig, from_6d, to_6d
from prior.kinematics import forward_kinematics
from prior.motion_windows import remove_heading
from prior.refine import RefineSettings

Floats = NDArray[np.float64]

FRAMES = 64


def run(bench: Bench) -> Result:
    """The shipped refinement model over validation motion."""
    clips = bench.clips(FRAMES, 192)
    weights = RefineSettings().weights
    state, config = load_weights(weights, "hmvae")
    model = HMVAE(HMVAEConfig.from_dict(config))
    model.load_state_dict(state)
    model.eval()
    window = model.config.window
    rotations = torch.from_numpy(clips.rotations).float().transpose(0, 1)  # (C, T, 22, 3, 3)
    bones = torch.from_numpy(clips.offsets).float()

    def joints(poses: torch.Tensor, on: torch.Tensor = bones) -> Floats:
        return forward_kinematics(poses, on[:, None])[0].transpose(0, 1).double().numpy()

    pieces = rotations.unflatten(1, (-1, window)).flatten(0, 1)
    on = bones.repeat_interleave(rotations.shape[1] // window, dim=0)
    decoded = reconstruct(model, pieces)
    still = pieces[:, window // 2 - 1, None].expand_as(pieces)
    whole = joints(rotations)
    hidden = np.zeros(whole.shape[:-1], dtype=bool)
    parts = joints(pieces, on)
    found: dict[tuple[str, int], Scores] = {
        ("centre frame held", window): score(joints(still, on), parts, np.zeros(parts.shape[:-1], dtype=bool)),
        ("HM-VAE", window): score(joints(decoded, on), parts, np.zeros(parts.shape[:-1], dtype=bool)),
        (f"HM-VAE, {window} frames side by side", FRAMES): score(
            joints(decoded.unflatten(0, (len(rotations), -1)).flatten(1, 2)), whole, hidden
        ),
        (f"HM-VAE, {window} frames sliding", FRAMES): score(joints(slide(model, rotations)), whole, hidden),
    }
    records: list[dict[str, Any]] = [
        {"method": method, "window": frames, **figures(scores)} for (method, frames), scores in found.items()
    ]
    keys = {
        "position_mm": "MPJPE, mm", "pa_mm": "PA-MPJPE, mm", "own_acceleration_mm": "acceleration, mm/frame²",
        "acceleration_mm": "acceleration error, mm/frame²",
    }  # fmt: skip
    truth = figures(score(whole, whole, hidden))["own_acceleration_mm"]
    table = Table(
        name="reconstruction",
        title="Reconstruction of clean windows (HM-VAE, table 3)",
        columns=["method", "frames", *keys.values()],
        rows=[[r["method"], str(r["window"]), *(f"{r[key]:.2f}" for key in keys)] for r in records],
        note=(
            f"{len(rotations)} clips of {FRAMES} frames, 22 joints, pelvis at the origin, weights '{weights}'. "
            f"Acceleration of the truth: {truth:.2f} mm/frame². Not comparable with the paper's figures, which are on "
            "AMASS."
        ),
    )
    return Result([table], {"data": clips.source, "weights": weights, "records": records})


@torch.inference_mode()
def reconstruct(model: HMVAE, windows: torch.Tensor) -> torch.Tensor:
    """Windows (B, T, 22, 3, 3) of local rotations, encoded and decoded; the heading is taken off and put back."""
    turned, back = remove_heading(windows, model.config.window // 2 - 1)
    decoded = from_6d(torch.cat([model.reconstruct(to_6d(part)) for part in turned.split(512)]))
    decoded[:, :, 0] = back[:, None] @ decoded[:, :, 0]
    return decoded


def slide(model: HMVAE, clips: torch.Tensor) -> torch.Tensor:
    """Clips (C, T, 22, 3, 3) by windows that slide by one frame; each frame from where it is nearest to the centre."""
    window, frames = model.config.window, clips.shape[1]
    starts = np.arange(frames - window + 1)
    wanted = np.clip(np.arange(frames) - (window // 2 - 1), 0, starts[-1])
    windows = torch.stack([clips[:, s : s + window] for s in starts], dim=1)
    decoded = reconstruct(model, windows.flatten(0, 1)).unflatten(0, (len(clips), -1))
    return torch.stack([decoded[:, s, t - s] for t, s in enumerate(wanted)], dim=1)
