"""Completion of body parts that are hidden for a whole window: legs, arms, all but a few joints.

Baselines are the mean pose, the conditional mean of one Gaussian over training poses (with the true heading of every
frame), the nearest training window, and HG-VAE's completion, which the live node uses. Joints are compared relative to
the root, which is known. Windows have 50 frames, as HG-VAE's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch

from steadypose.benchmarks.baselines.body import ConditionalGaussian
from steadypose.benchmarks.baselines.inbetween import NearestPose
from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.intervals import ratio
from steadypose.benchmarks.motion import as_set, prepared_set
from steadypose.benchmarks.provenance import COMPLETE
from steadypose.benchmarks.results import Result, Table
from steadypose.benchmarks.scores import ends_mm
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import heading
from steadypose.prior.body.skeleton import JOINTS, J
from steadypose.prior.complete.body import Fill, complete
from steadypose.prior.complete.parts import PartsCompleter
from steadypose.prior.fit.tensors import load_network
from steadypose.prior.models.completer import LiveCompleter
from steadypose.prior.models.completer_features import read_window
from steadypose.prior.models.hgvae.config import SCALE, HGVAEConfig
from steadypose.prior.models.hgvae.features import body_size, from_tracks, to_tracks
from steadypose.training.data.hgvae_windows import standardise
from steadypose.training.networks.hgvae import HGVAE

DEPENDS_ON = (COMPLETE, "completer weights", "hgvae weights")

FRAMES = 50


def _named(*parts: str) -> list[int]:
    return [joint for joint, name in enumerate(JOINTS) if name.endswith(parts)]


HIDDEN: Mapping[str, list[int]] = {
    "legs": _named("knee", "ankle", "left_foot", "right_foot"),
    "left arm": [J["left_shoulder"], J["left_elbow"], J["left_wrist"]],
    "right arm": [J["right_shoulder"], J["right_elbow"], J["right_wrist"]],
    "both lower arms": _named("elbow", "wrist"),
    "all but pelvis, chest, head, wrists, ankles": [
        joint for joint, name in enumerate(JOINTS) if not name.endswith(("pelvis", "head", "wrist", "ankle", "spine3"))
    ],
}
"""Hidden joints, by name."""

_NETWORK = "complete"


def run(bench: Bench) -> Result:
    """Run every method for every hidden part."""
    clips = bench.clips(FRAMES, 64)
    train = prepared_set(bench.data, "train") if bench.data.is_file() else as_set(bench.training_clips())
    nearest = NearestPose(train, FRAMES)
    gaussian = ConditionalGaussian(bench.training_clips().positions.reshape(-1, 22, 3))
    completer = LiveCompleter.load("default")
    hgvae = load_network(HGVAE, HGVAEConfig.from_dict, "default", "hgvae")
    truth = clips.positions.swapaxes(0, 1)
    yaw = heading(clips.rotations[:, :, 0]).T

    def by(fill: Fill) -> Callable[[Floats, list[int]], Floats]:
        return lambda given, hidden: np.stack(
            [complete(fill, *one).positions for one in zip(given, clips.offsets, strict=True)]
        )

    methods: dict[str, Callable[[Floats, list[int]], Floats]] = {
        "mean pose": by(mean_pose(completer)),
        "conditional Gaussian": lambda given, hidden: gaussian(given, yaw),
        "nearest training window": lambda given, hidden: nearest(given, yaw[:, 0], hidden),
        "HG-VAE's completion": lambda given, hidden: by_hgvae(hgvae, given, clips.offsets),
        "transformer alone": by(completer),
        _NETWORK: by(PartsCompleter(completer)),
    }
    records: list[dict[str, Any]] = []
    errors: dict[tuple[str, str], Floats] = {}
    for part, hidden in bench.progress.track(list(HIDDEN.items()), description="completion"):
        given = truth.copy()
        given[:, :, hidden] = np.nan
        for name, method in methods.items():
            answer = method(given, hidden)
            off = np.linalg.norm((answer - answer[:, :, :1]) - (truth - truth[:, :, :1]), axis=-1)[:, :, hidden]
            error = errors[part, name] = off.mean(axis=(1, 2))
            bends = [np.linalg.norm(np.diff(x[:, :, hidden], n=2, axis=1), axis=-1).mean() for x in (answer, truth)]
            records.append(
                {
                    "hidden": part, "method": name, "hidden_mm": round(float(error.mean()) * 1e3, 2),
                    "hidden_ci_mm": ends_mm(error, clips.person),
                    "acceleration_of_true": round(float(bends[0] / bends[1]), 3),
                }
            )  # fmt: skip
    ratios = [
        {
            "hidden": part,
            "baseline": baseline,
            "ratio": [round(v, 3) for v in ratio(errors[part, _NETWORK], errors[part, baseline], clips.person)[:3]],
        }
        for part in HIDDEN
        for baseline in methods
        if baseline != _NETWORK
    ]
    data = {"data": clips.source, "records": records, "completer over baseline": ratios}
    return Result([_table(records, ratios, len(clips.offsets))], data)


def mean_pose(completer: LiveCompleter) -> Fill:
    """Fill hidden joints with the mean pose, on the person's bones."""

    def fill(positions: Floats, offsets: Floats) -> tuple[Floats, Floats]:
        window = read_window(positions, offsets, completer.usual)
        rotations = window.rotations.copy()
        rotations[:, :, 0] = window.turn[:, None] @ rotations[:, :, 0]
        return rotations, window.root @ window.turn.swapaxes(1, 2) + window.origin[:, None]

    return fill


@torch.inference_mode()
def by_hgvae(model: HGVAE, given: Floats, offsets: Floats) -> Floats:
    """Complete windows (C, T, 22, 3) metres, NaN where hidden, by HG-VAE's completion network; offsets (C, 22, 3)
    metres."""
    sizes = body_size(offsets)
    tracks = to_tracks(given, sizes)
    hung = standardise(model, tracks.x)
    completed, _ = model.completed(hung, torch.from_numpy(tracks.observed).float(), 0.0)
    x = completed.double().numpy() * SCALE + model.mean.double().numpy()[:, None]
    return np.where(np.isfinite(given), given, from_tracks(x, tracks, sizes))


def _table(records: list[dict[str, Any]], ratios: list[dict[str, Any]], clips: int) -> Table:
    methods = list(dict.fromkeys(r["method"] for r in records))
    found = {(r["hidden"], r["method"]): r for r in records}
    share = {(r["hidden"], r["baseline"]): f"{r['ratio'][0]:.2f}" for r in ratios}
    rows = [
        [
            part,
            *(f"{found[part, m]['hidden_mm']:.0f}" for m in methods),
            *(share[part, m] for m in ("nearest training window", "HG-VAE's completion")),
            *(f"{found[part, m]['acceleration_of_true']:.2f}" for m in (_NETWORK, "HG-VAE's completion")),
        ]
        for part in HIDDEN
    ]
    return Table(
        name="completion",
        title="Parts of the body that nobody sees, mm off",
        columns=[
            "hidden",
            *methods,
            "complete, of nearest",
            "of HG-VAE's",
            "its acceleration, of the true",
            "HG-VAE's",
        ],
        rows=rows,
        note=(
            f"{clips} windows of {FRAMES} frames, spread evenly over the sources; joints hidden in all frames, about "
            "the root, which is known. `complete` is the transformer with HG-VAE's completion as a second opinion."
        ),
    )
