"""HuMoR's tables on our data: futures, noisy and hidden joints, a simulated detector, simulated depth.

The figures are not comparable with the paper's, whose data are AMASS and whose body is SMPL; the order of the methods
is. Ablations are trained alike and briefly, so the model that ships has a copy trained as briefly beside it. Contact is
load, of eight joints; the paper's ninth, the hips, never bears any.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from steadypose.benchmarks import ours
from steadypose.benchmarks.bench import Bench, Result
from steadypose.benchmarks.humor.fits import (
    CAMERA_HEIGHT,
    HIDDEN_BELOW,
    NOISE,
    Answer,
    camera_settings,
    fitted,
    load_labels,
    pictures,
    scores,
    seen_joints,
    start_of,
)
from steadypose.benchmarks.humor.models import BRIEF, MVAE, SHIPS, VARIANTS, model_of
from steadypose.benchmarks.humor.prediction import SAMPLES, predict, stand_still
from steadypose.benchmarks.motion import MotionClips
from steadypose.benchmarks.peers.bank import bank
from steadypose.benchmarks.provenance import CLEAN
from steadypose.benchmarks.results import Table
from steadypose.prior.offline.solve import FitSettings

DEPENDS_ON = (*CLEAN, "humor weights", "offline settings")

FRAMES = 90
DELAY = 8
"""Frames: of the live answer that fits start from."""
CLIPS, PICTURES, FUTURES = 4, 2, 12
"""Clips of Table 2, of Tables 3 and 4, and of Table 1, taken evenly from all sources of the split."""

_STILL, _RAW, _TRUTH = "stands still", "as seen", "truth"
_PER_FRAME = "per-frame fit, smoothed (stage 2)"


def run(bench: Bench) -> Result:
    """All tables."""
    models = {SHIPS: model_of(bench, SHIPS)} | {name: model_of(bench, name) for name in VARIANTS}
    count = 2 if bench.quick else FUTURES
    clips = bench.clips(62, count)
    samples = 4 if bench.quick else SAMPLES
    futures = [{"method": _STILL, **stand_still(clips)}]
    for name, model in bench.progress.track(models.items(), description="futures"):
        futures.append({"method": name, **predict(model, clips, samples)})
    clips = bench.clips(FRAMES, 2 if bench.quick else CLIPS)
    noisy = _noisy(bench, clips, models, hide=False)
    hidden = _noisy(bench, clips, models, hide=True)
    clips = bench.clips(FRAMES, 1 if bench.quick else PICTURES)
    detector = _pictures(bench, clips, models, depth=False)
    depth = _pictures(bench, clips, models, depth=True)
    records = {"futures": futures, "noisy": noisy, "hidden": hidden, "detector": detector, "depth": depth}
    return Result(
        [_futures_table(futures, count), *_fit_tables(records, len(clips.offsets))],
        {"data": clips.source, "records": records},
    )


def _noisy(bench: Bench, clips: MotionClips, models: dict[str, Any], *, hide: bool) -> list[dict[str, Any]]:
    """Table 2: all joints with noise; or with ``hide``, without noise, those below `HIDDEN_BELOW` hidden."""
    rng = np.random.default_rng(0)
    truth = clips.positions
    seen = truth + (0.0 if hide else NOISE) * rng.standard_normal(truth.shape)
    unseen = hide & (truth[..., 2] < HIDDEN_BELOW)
    seen[unseen] = np.nan
    live = {
        delay: ours.run(ours.OURS["steadypose"], seen, clips.stamps_s, delay).positions[-FRAMES:]
        for delay in (4, DELAY)
    }
    count = truth.shape[1]
    answers: dict[str, list[Answer]] = {
        _TRUTH: _each(truth),
        "filter bank, offline": _each(bank(seen, clips.stamps_s, FRAMES)),
    }
    if not hide:
        answers = {_TRUTH: _each(truth), _RAW: _each(seen)} | answers
    answers |= {f"steadypose live, delay {delay}": _each(found) for delay, found in live.items()}
    starts = [start_of(live[DELAY][:, c]) for c in range(count)]
    fits = {
        _PER_FRAME: (models[SHIPS], 2),
        MVAE: (models[MVAE], 3),
        BRIEF: (models[BRIEF], 3),
        SHIPS: (models[SHIPS], 3),
    }
    for name, (model, stages) in bench.progress.track(fits.items(), description="hidden" if hide else "noisy"):
        answers[name] = [
            fitted(model, [starts[c]], seen_joints(seen[:, c]), stages, FitSettings()) for c in range(count)
        ]
    load = load_labels(clips)
    return [{"method": name, **scores(found, truth, unseen, load)} for name, found in answers.items()]


def _pictures(bench: Bench, clips: MotionClips, models: dict[str, Any], *, depth: bool) -> list[dict[str, Any]]:
    """Tables 3 and 4: key points of a simulated detector, alone or with the points of a simulated depth camera."""
    taken = [pictures(clips, c, np.random.default_rng((1, c))) for c in range(len(clips.offsets))]
    truth = np.stack([picture.truth for picture in taken], axis=1)
    unseen = np.stack([~np.isfinite(picture.key_points.pixels.numpy()).all(axis=-1) for picture in taken], axis=1)
    load = load_labels(clips)
    fits = {_PER_FRAME: (models[SHIPS], 2), MVAE: (models[MVAE], 3), SHIPS: (models[SHIPS], 3)}
    records = [{"method": _TRUTH, **scores(_each(truth), truth, unseen, load, -CAMERA_HEIGHT)}]
    for name, (model, stages) in bench.progress.track(fits.items(), description="depth" if depth else "detector"):
        found = [
            fitted(
                model, picture.starts, [picture.key_points, *([picture.points] if depth else [])], stages,
                camera_settings(),
            )
            for picture in taken
        ]  # fmt: skip
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
        name="humor-futures",
        title="Futures of 2 s (HuMoR's Table 1): 62 frames, the first two known",
        columns=["method", *keys.values()],
        rows=[[r["method"], *(_cell(r, key) for key in keys)] for r in records],
        note=f"{clips} clips. All but what ships and the body that stands still are trained alike and briefly.",
    )


def _fit_tables(records: dict[str, list[dict[str, Any]]], few: int) -> list[Table]:
    keys = {
        "all_mm": "all, mm", "seen_mm": "seen, mm", "hidden_mm": "hidden, mm", "legs_mm": "legs, mm",
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
            name=f"humor-{name}",
            title=title,
            columns=["method", *keys.values()],
            rows=[[r["method"], *(_cell(r, key) for key in keys)] for r in records[name]],
            note="Mean over all joints, without alignment; legs: knees, ankles, toes; a filter has no answer "
            "for what it never saw. Seconds are of a processor.",
        )
        for name, title in titles.items()
    ]


def _cell(record: dict[str, Any], key: str) -> str:
    value = record.get(key)
    return "–" if value is None or np.isnan(value) else f"{value:.3f}" if key == "contact_accuracy" else f"{value:.1f}"
