"""HuMoR's tables on our data: futures, noisy and hidden joints, a simulated detector, simulated depth; and figure 8.

The figures are not comparable with the paper's, whose data are AMASS and whose body is SMPL; the order of the methods
is. Ablations are trained alike and briefly, so a copy of the model that ships, trained as briefly, stands beside it.
Contact is load, of eight joints; the paper's ninth, the hips, never bears any.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from steadypose.benchmarks import product
from steadypose.benchmarks.baselines.kalman import bank
from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.corruption import below, gaussian, hide
from steadypose.benchmarks.motion import MotionClips, as_set, digest, prepared_set
from steadypose.benchmarks.provenance import CLEAN_22, ROOT
from steadypose.benchmarks.results import Result, Table
from steadypose.benchmarks.studies.humor_fits import (
    CAMERA,
    CAMERA_HEIGHT,
    HIDDEN_BELOW,
    NOISE,
    Answer,
    fitted,
    load_labels,
    pictures,
    scores,
    seen_joints,
    shipped,
    starts_of,
)
from steadypose.prior.body.kinematics import CONTACT_JOINTS
from steadypose.prior.fit.humor_network import HumorConfig, HumorNet, Rollout, sample
from steadypose.prior.fit.humor_state import State, states_of
from steadypose.prior.fit.solve import FitSettings
from steadypose.prior.fit.tensors import load_network
from steadypose.training.data.dataset import MotionSet
from steadypose.training.recipes.humor import Sequences, recipe_of

STEPS, BATCH, LEARNING_RATE, EVALUATIONS = 250, 64, 1e-3, 5
"""Steps, batch, learning rate and evaluations of a brief training: a forty-eighth of the sequences on which the shipped
model was trained."""

SHIPS, MVAE = "HuMoR, as it ships", "MVAE-like: none of the three"
BRIEF = "HuMoR, briefly trained"

VARIANTS: Mapping[str, HumorConfig] = {
    BRIEF: HumorConfig(),
    "standard prior": HumorConfig(learned_prior=False),
    "no delta": HumorConfig(residual=False),
    "no contacts": HumorConfig(contacts=False),
    MVAE: HumorConfig(learned_prior=False, residual=False, contacts=False),
}
"""Variants, named as in the paper. Without SMPL, there is one more: joints that need not be those of a body."""


def model_of(bench: Bench, name: str) -> HumorNet:
    """Return one of `VARIANTS`, trained now or loaded from ``runs``, or the model that ships."""
    if name == SHIPS:
        return shipped()
    bench.progress.stop()  # training draws its own progress bar
    try:
        config = VARIANTS[name]
        if bench.quick or not bench.data.is_file():
            motion = as_set(bench.training_clips())
            with tempfile.TemporaryDirectory() as runs:
                return _trained(config, motion, motion, Path(runs), name, steps=2)
        runs = ROOT / "runs" / f"humor-{digest(bench.data)}-{STEPS}"
        train, val = (prepared_set(bench.data, split) for split in ("train", "val"))
        return _trained(config, train, val, runs, name, STEPS)
    finally:
        bench.progress.start()


def _trained(config: HumorConfig, train: MotionSet, val: MotionSet, runs: Path, name: str, steps: int) -> HumorNet:
    stem = name.replace(" ", "-").replace(",", "").replace(":", "")
    path = runs / stem / f"{stem}.safetensors"
    if not path.is_file():
        recipe = recipe_of(config, Sequences.of(train), Sequences.of(val))
        recipe = replace(recipe, batch=BATCH, rate=LEARNING_RATE, evaluations=EVALUATIONS)
        torch.manual_seed(0)
        model = HumorNet(config)
        model.load_state_dict(dict(shipped().named_buffers()), strict=False)  # fitting them again takes a minute
        run = recipe.minimise(model, path.parent, steps, seed=0)
        run.save(path, model, asdict(config), {"Training": f"{steps} steps of {BATCH} sequences, for the bench"})
    return load_network(HumorNet, HumorConfig.from_dict, str(path), "humor")


SAMPLES, LONG_S = 50, 5.0  # number of samples, and length of long futures in seconds, as in the paper
SPARED = 4  # factor by which fewer samples are drawn of the long futures, because pairs are many

LOWEST_M, HIGHEST_M = 0.1, 1.6
"""Lowest and highest pelvis, metres. A future that ever leaves this range has diverged; the truth never does."""


def initial_states(clips: MotionClips) -> tuple[State, State, Tensor]:
    """Return first states (C,), all that follow (C, T), of people on their bones, and these bones."""
    root, rotations = (
        torch.from_numpy(np.ascontiguousarray(values.swapaxes(0, 1))).float()
        for values in (clips.positions[:, :, 0], clips.rotations)
    )
    offsets = torch.from_numpy(clips.offsets).float()
    states = states_of(root, rotations, offsets)
    return states[:, 0], states[:, 1:], offsets


@torch.no_grad()
def predict(model: HumorNet, clips: MotionClips, samples: int) -> dict[str, Any]:
    """Return the figures of Table 1 for one model; clips are a little over two seconds long."""
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
    """Return the same figures for a body that does not move, the simplest prediction."""
    first, truth, _ = initial_states(clips)
    error = (first.joints.unsqueeze(1) - truth.joints).norm(dim=-1).mean(dim=-1)
    return {"ade_mm": _mm(error.mean()), "fde_mm": _mm(error[:, -1].mean()), "likeliest_ade_mm": _mm(error.mean())}


def _times(state: State, count: int) -> State:
    return state[torch.arange(len(state.root)).repeat_interleave(count)]


def _pairwise(joints: Tensor) -> Tensor:
    """Return the mean distance of joints (C, S, T, 22, 3) between all pairs of samples."""
    first, second = torch.triu_indices(joints.shape[1], joints.shape[1], offset=1)
    return torch.stack([(clip[first] - clip[second]).norm(dim=-1).mean() for clip in joints]).mean()


def _astray(long: Rollout) -> Tensor:
    height = long.states.root[..., 2]
    return ((height < LOWEST_M) | (height > HIGHEST_M) | ~torch.isfinite(height)).any(dim=1).float().mean()


def _mm(value: Tensor) -> float:
    return round(float(value) * 1e3, 1)


DEPENDS_ON = (*CLEAN_22, "humor weights", "prior.fit", "training.recipes.humor")

FRAMES = 90
DELAY = 8  # delay of the live output from which fits start, frames
CLIPS, PICTURES, FUTURES = 4, 8, 12
"""Number of clips of Table 2, of Tables 3 and 4, and of Table 1, taken evenly from all sources of the split."""

_STILL, _RAW, _TRUTH = "stands still", "as observed", "truth"
_PER_FRAME = "per-frame fit, smoothed (stage 2)"


def run(bench: Bench) -> Result:
    models = {SHIPS: model_of(bench, SHIPS)} | {name: model_of(bench, name) for name in VARIANTS}
    count = 2 if bench.quick else FUTURES
    clips = bench.clips(62, count)
    samples = 4 if bench.quick else SAMPLES
    futures = [{"method": _STILL, **stand_still(clips)}]
    for name, model in bench.progress.track(models.items(), description="futures"):
        futures.append({"method": name, **predict(model, clips, samples)})
    clips = bench.clips(FRAMES, 2 if bench.quick else CLIPS)
    noisy = _noisy(bench, clips, models, hidden=False)
    hidden = _noisy(bench, clips, models, hidden=True)
    clips = bench.clips(FRAMES, 1 if bench.quick else PICTURES)
    detector = _pictures(bench, clips, models, depth=False)
    depth = _pictures(bench, clips, models, depth=True)
    few = len(clips.offsets)
    records = {"futures": futures, "noisy": noisy, "hidden": hidden, "detector": detector, "depth": depth}
    return Result(
        [_futures_table(futures, count), *_fit_tables(records, few)], {"data": clips.source, "records": records}
    )


def _noisy(bench: Bench, clips: MotionClips, models: dict[str, Any], *, hidden: bool) -> list[dict[str, Any]]:
    """Make Table 2: all joints with noise; with ``hidden``, without noise and joints below `HIDDEN_BELOW` hidden."""
    truth = clips.positions
    noise, lowest = (0.0, HIDDEN_BELOW) if hidden else (NOISE, 0.0)
    seen = hide(gaussian(truth, noise, np.random.default_rng(0)), below(truth, lowest))
    shipped_settings = product.PRODUCT["steadypose"]
    live = {delay: product.run(shipped_settings, seen, clips.stamps_s, delay) for delay in (4, DELAY)}
    answers: dict[str, list[Answer]] = {
        _TRUTH: _each(truth),
        "filter bank, offline": _each(bank(seen, clips.stamps_s, FRAMES)),
    }
    if not hidden:
        answers = {_TRUTH: _each(truth), _RAW: _each(seen)} | answers
    answers |= {f"steadypose live, delay {delay}": _each(found.positions[-FRAMES:]) for delay, found in live.items()}
    names = (_PER_FRAME, *reversed([*VARIANTS]), SHIPS)
    for name in bench.progress.track(names, description="hidden" if hidden else "noisy"):
        model, stages = (models[SHIPS], 2) if name == _PER_FRAME else (models[name], 3)
        answers[name] = [
            fitted(model, [start], seen_joints(seen[:, c]), stages, FitSettings())
            for c, start in enumerate(starts_of(live[DELAY], FRAMES))
        ]
    load, unseen = load_labels(clips), np.isnan(seen[..., 0])
    return [{"method": name, **scores(found, truth, unseen, load)} for name, found in answers.items()]


def _pictures(bench: Bench, clips: MotionClips, models: dict[str, Any], *, depth: bool) -> list[dict[str, Any]]:
    """Make Tables 3 and 4: key points of a simulated detector, alone or with the points of a simulated depth camera."""
    taken = [pictures(clips, c, np.random.default_rng((1, c))) for c in range(len(clips.offsets))]
    truth = np.stack([picture.truth for picture in taken], axis=1)
    unseen = np.stack([~picture.seen for picture in taken], axis=1)
    load = load_labels(clips)
    fits = {_PER_FRAME: (models[SHIPS], 2), MVAE: (models[MVAE], 3), SHIPS: (models[SHIPS], 3)}
    records = [{"method": _TRUTH, **scores(_each(truth), truth, unseen, load, -CAMERA_HEIGHT)}]
    for name, (model, stages) in bench.progress.track(fits.items(), description="depth" if depth else "detector"):
        found = [
            fitted(model, track.starts, track.observed, stages, CAMERA)
            for track in (picture.deep if depth else picture.flat for picture in taken)
        ]
        records.append({"method": name, **scores(found, truth, unseen, load, -CAMERA_HEIGHT)})
    return records


def _each(positions: np.ndarray) -> list[Answer]:
    return [Answer(positions[:, c]) for c in range(positions.shape[1])]


def _futures_table(records: Sequence[dict[str, Any]], clips: int) -> Table:
    keys = {
        "ade_mm": "ADE, best of 50, mm", "fde_mm": "FDE, mm", "likeliest_ade_mm": "ADE of the likeliest, mm",
        "contact_accuracy": "contact accuracy", "apd_mm": "APD over 5 s, mm", "astray_percent": "astray in 5 s, %",
    }  # fmt: skip
    return Table(
        "humor-futures", "Futures of 2 s (HuMoR's Table 1): 62 frames, the first two known", ["method", *keys.values()],
        [[r["method"], *(_cell(r, key) for key in keys)] for r in records],
        f"{clips} clips. All but what ships and the body that stands still are trained alike and briefly.",
    )  # fmt: skip


def _fit_tables(records: dict[str, list[dict[str, Any]]], few: int) -> list[Table]:
    keys = {
        "all_mm": "all, mm", "seen_mm": "observed, mm", "hidden_mm": "hidden, mm", "legs_mm": "legs, mm",
        "rooted_mm": "from the root, mm", "contact_accuracy": "contact accuracy",
        "acceleration_m_s2": "acceleration, m/s²",
        "acceleration_error_m_s2": "its error, m/s²", "penetration_percent": "penetration, %",
        "penetration_mm": "its depth, mm", "seconds": "s a clip",
    }  # fmt: skip
    titles = {
        "noisy": f"Joints with {NOISE * 100:.0f} cm of noise (Table 2), {CLIPS} clips of 3 s, floor known",
        "hidden": f"Joints below {HIDDEN_BELOW} m hidden, without noise (Table 2), the same clips",
        "detector": f"Key points of a simulated detector (Table 3), {few} clips of 3 s",
        "depth": f"The same with points of a simulated depth camera (Table 4), {few} clips of 3 s",
    }
    return [
        Table(
            f"humor-{name}", title, ["method", *keys.values()],
            [[r["method"], *(_cell(r, key) for key in keys)] for r in records[name]],
            "Mean over all joints, without alignment; legs: knees, ankles, toes; a filter has no answer "
            "for what it never saw. Seconds are of a processor.",
        )
        for name, title in titles.items()
    ]  # fmt: skip


def _cell(record: dict[str, Any], key: str) -> str:
    value = record.get(key)
    return "–" if value is None or np.isnan(value) else f"{value:.3f}" if key == "contact_accuracy" else f"{value:.1f}"
