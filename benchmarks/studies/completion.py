"""Completion of body parts that are hidden for a whole window: legs, arms, all but a few joints.

Baselines are the mean pose, the conditional mean of one Gaussian over training poses (with the true heading of every
frame), the nearest training window, and HG-VAE's completion, which the live node uses. Joints are compared relative to
the root, which is known. Windows have 50 frames, as HG-VAE's. On a few of them, HM-VAE is searched too (HM-VAE, section
4), which takes seconds for each; and the mean pose stands for whole windows, which HM-VAE's table 3 lacks.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch

from steadypose.benchmarks.baselines.body import ConditionalGaussian
from steadypose.benchmarks.baselines.inbetween import NearestPose
from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.motion import MotionClips, as_set, prepared_set
from steadypose.benchmarks.provenance import COMPLETE
from steadypose.benchmarks.results import Result, Table
from steadypose.benchmarks.scores import procrustes, ratio
from steadypose.prior.arrays import Floats
from steadypose.prior.body.inverse_kinematics import place_joints
from steadypose.prior.body.kinematics import heading, rotation_matrices, yaw_matrix
from steadypose.prior.body.skeleton import JOINTS, J
from steadypose.prior.complete.body import Fill, complete
from steadypose.prior.complete.parts import PartsCompleter
from steadypose.prior.fit.optimise import Optimiser
from steadypose.prior.fit.tensors import load_network
from steadypose.prior.models.completer import LiveCompleter
from steadypose.prior.models.completer_features import read_window
from steadypose.prior.models.hgvae.config import SCALE, HGVAEConfig
from steadypose.prior.models.hgvae.features import body_size, from_tracks, to_tracks
from steadypose.training.data.hgvae_windows import standardise
from steadypose.training.networks.hgvae import HGVAE

DEPENDS_ON = (COMPLETE, "completer weights", "hgvae weights", "hmvae64 weights", "prior.fit.optimise")

FRAMES = 50
SEARCHED = 8  # number of windows on which HM-VAE is searched, five seconds for each and each hidden part


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

_NETWORK, _SEARCH = "complete", "complete --optimise"


def run(bench: Bench) -> Result:
    clips = bench.clips(FRAMES, 64)
    train = prepared_set(bench.data, "train") if bench.data.is_file() else as_set(bench.training_clips())
    nearest = NearestPose(train, FRAMES)
    gaussian = ConditionalGaussian(bench.training_clips().positions.reshape(-1, 22, 3))
    completer = LiveCompleter.load("default")
    hgvae = load_network(HGVAE, HGVAEConfig.from_dict, "default", "hgvae")
    truth = clips.positions.swapaxes(0, 1)
    yaw = heading(clips.rotations[:, :, 0]).T

    def by(fill: Fill) -> Callable[[Floats, list[int]], Floats]:
        return lambda given, hidden: completed(fill, given, clips.offsets)

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
            errors[part, name], figures = compared(method(given, hidden), truth, hidden)
            records.append({"hidden": part, "method": name, **figures})
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
    searches = search(bench, truth, clips.offsets, completer)
    usual = whole(clips, completer)
    data = {
        "data": clips.source, "records": records, "completer over baseline": ratios, "searches": searches,
        "mean pose": usual,
    }  # fmt: skip
    return Result([_table(records, ratios, len(clips.offsets)), _search_table(searches), _usual_table(usual)], data)


def search(bench: Bench, truth: Floats, offsets: Floats, completer: LiveCompleter) -> list[dict[str, Any]]:
    """Complete `SEARCHED` of the windows (C, T, 22, 3) by HM-VAE's search, beside the mean pose and its start."""
    some = np.unique(np.linspace(0, len(offsets) - 1, 1 if bench.quick else SEARCHED).round().astype(int))
    parts = PartsCompleter(completer)
    fills = {"mean pose": mean_pose(completer), _NETWORK: parts, _SEARCH: Optimiser.load("default", parts)}
    records: list[dict[str, Any]] = []
    for part, hidden in bench.progress.track(list(HIDDEN.items()), description="search"):
        given = truth[some].copy()
        given[:, :, hidden] = np.nan
        for name, fill in fills.items():
            began = time.process_time()
            answer = completed(fill, given, offsets[some])
            seconds = round((time.process_time() - began) / len(some), 2)
            _, figures = compared(answer, truth[some], hidden)
            records.append({"hidden": part, "method": name, "windows": len(some), **figures, "seconds": seconds})
    return records


def completed(fill: Fill, given: Floats, offsets: Floats) -> Floats:
    """Return windows (C, T, 22, 3) of bodies with these bones, completed by `complete`."""
    return np.stack([complete(fill, *one).positions for one in zip(given, offsets, strict=True)])


def compared(answer: Floats, truth: Floats, hidden: list[int]) -> tuple[Floats, dict[str, float]]:
    """Return each window's error of hidden joints about the root, (C,) metres, and the mean figures of all."""
    off = np.linalg.norm((answer - answer[:, :, :1]) - (truth - truth[:, :, :1]), axis=-1)[:, :, hidden]
    bends = [np.linalg.norm(np.diff(x[:, :, hidden], n=2, axis=1), axis=-1).mean() for x in (answer, truth)]
    error = off.mean(axis=(1, 2))
    return error, {
        "hidden_mm": round(float(error.mean()) * 1e3, 2),
        "acceleration_of_true": round(float(bends[0] / bends[1]), 3),
    }


def whole(clips: MotionClips, completer: LiveCompleter) -> list[dict[str, Any]]:
    """Return the errors, mm, of the mean pose in every frame, with the true heading, or pelvis rotation, of each."""
    usual = np.broadcast_to(rotation_matrices(completer.usual), clips.rotations.shape)
    true = place_joints(clips.rotations, clips.offsets)
    records = []
    for known, first in (
        (
            "heading",
            yaw_matrix(heading(clips.rotations[:, :, 0])) @ yaw_matrix(-heading(usual[:, :, 0])) @ usual[:, :, 0],
        ),
        ("rotation of the pelvis", clips.rotations[:, :, 0]),
    ):
        joints = place_joints(np.concatenate([first[:, :, None], usual[:, :, 1:]], axis=2), clips.offsets)
        aligned = procrustes(joints, true)
        off = [1e3 * float(np.linalg.norm(x - true, axis=-1).mean()) for x in (joints, aligned)]
        records.append({"known": known, "position_mm": round(off[0], 2), "aligned_mm": round(off[1], 2)})
    return records


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
    columns = ["complete, of nearest", "of HG-VAE's", "its acceleration, of the true", "HG-VAE's"]
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
        "completion", "Parts of the body that nobody sees, mm off", ["hidden", *methods, *columns], rows,
        f"{clips} windows of {FRAMES} frames, spread evenly over the sources; joints hidden in all frames, about "
        "the root, which is known. `complete` is the transformer with HG-VAE's completion as a second opinion.",
    )  # fmt: skip


def _search_table(records: list[dict[str, Any]]) -> Table:
    return Table.of(
        "completion-search", "HM-VAE of 64 frames searched for a body that meets what is known (HM-VAE, section 4)",
        records,
        {"hidden": "{hidden}", "method": "{method}", "mm off": "{hidden_mm:.0f}",
         "acceleration, of the true": "{acceleration_of_true:.2f}", "s a window": "{seconds:.2f}"},
        f"{records[0]['windows']} of the windows.",
    )  # fmt: skip


def _usual_table(records: list[dict[str, Any]]) -> Table:
    return Table.of(
        "completion-usual", "The mean pose in place of every frame (the trivial row of HM-VAE, table 3)", records,
        {"known of each frame": "{known}", "MPJPE, mm": "{position_mm:.1f}", "PA-MPJPE, mm": "{aligned_mm:.1f}"},
        f"The windows of completion, of {FRAMES} frames, on the person's bones and with the pelvis at the origin.",
    )  # fmt: skip
