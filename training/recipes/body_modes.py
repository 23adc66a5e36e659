"""Learns the covariance of joints' accelerations: ``steadypose train body_modes --data MOCAP``."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save_file

from steadypose.prior.models.weights import LICENCES
from steadypose.training.data.recordings import Motion, load_motion, write_arrays
from steadypose.training.loop import TrainingOptions


def covariance_of(motion: Motion) -> NDArray[np.float64]:
    """(22, 22) covariance along an axis of the accelerations of motion at its own speed, of mean variance 1: the mean
    of its sources', each relative to its own mean variance, so that the longest recording does not decide."""
    parts = []
    for source in sorted(set(motion.source)):
        total = np.zeros((22, 22))
        for clip in np.flatnonzero((motion.source == source) & (motion.speed == 1.0)):
            bent = np.diff(motion.positions[slice(*motion.start[clip : clip + 2])].astype(np.float64), n=2, axis=0)
            total += np.einsum("tja,tka->jk", bent, bent)
        parts.append(22.0 * total / np.trace(total))
    return np.mean(parts, axis=0)


def train_modes(options: TrainingOptions) -> Path:
    """Learn it from the recordings in the folder ``options.data`` that are free for products; the weights' path."""
    path = options.path("body_modes")
    arrays = options.path("mixture").parent / "arrays"
    if not (arrays / "pairs.npz").is_file():
        write_arrays(options.data, arrays)
    motion = load_motion(arrays / "motion-train.npz")
    path.parent.mkdir(parents=True, exist_ok=True)
    save_file({"covariance": covariance_of(motion).astype(np.float32)}, path, metadata={"config": json.dumps({})})
    card = {
        "Model": "covariance of joints' accelerations along an axis, relative to their mean variance (22, 22)",
        "Data": f"{', '.join(sorted(set(motion.source)))}: people of the training split, each source counting the same",
        "Licence": LICENCES["default"],
        "Training": "`steadypose train body_modes --data MOCAP`, seconds; nothing is drawn at random",
    }
    lines = [f"# {path.stem}", "", *(f"- **{heading}**: {content}" for heading, content in card.items())]
    path.with_suffix(".md").write_text("\n".join(lines) + "\n")
    return path
