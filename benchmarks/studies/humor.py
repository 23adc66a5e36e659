"""HuMoR's tables on our data: futures, noisy and hidden joints, a simulated detector, simulated depth; and figure 8.

The figures are not comparable with the paper's, whose data are AMASS and whose body is SMPL; the order of the methods
is. Ablations are trained alike and briefly, so the model that ships has a copy trained as briefly beside it. Contact is
load, of eight joints; the paper's ninth, the hips, never bears any.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from steadypose.benchmarks import figures, ours
from steadypose.benchmarks.baselines.bank import bank
from steadypose.benchmarks.bench import Bench, Result
from steadypose.benchmarks.motion import MotionClips
from steadypose.benchmarks.provenance import CLEAN
from steadypose.benchmarks.results import Table
from steadypose.benchmarks.studies.humor_credit import credit, credit_table, spoiled
from steadypose.benchmarks.studies.humor_fits import (
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
from steadypose.benchmarks.studies.humor_models import MVAE, SHIPS, VARIANTS, model_of
from steadypose.benchmarks.studies.humor_prediction import SAMPLES, predict, stand_still
from steadypose.prior.arrays import Floats
from steadypose.prior.fit.solve import FitSettings

if TYPE_CHECKING:
    from matplotlib.figure import Figure


DEPENDS_ON = (*CLEAN, "humor weights", "offline settings")

FRAMES = 90
DELAY = 8
"""Frames: of the live answer that fits start from."""
CLIPS, PICTURES, FUTURES, LEVELS, CREDIT = 4, 8, 12, 2, 16
"""Clips of Table 2, of Tables 3 and 4, of Table 1, of figure 8, and of
`humor_credit`, taken evenly from all sources of the split."""

HEIGHTS = (0.0, 0.3, 0.6, 0.9, 1.2)
"""Metres below which joints are hidden, of figure 8."""
NOISES = (0.0, 0.02, 0.04, 0.06, 0.08)
"""Metres, of figure 8."""

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
    clips = bench.clips(FRAMES, 1 if bench.quick else LEVELS)
    levels, drawn = _levels(bench, clips, models), len(clips.offsets)
    clips = bench.clips(FRAMES, 1 if bench.quick else PICTURES)
    detector = _pictures(bench, clips, models, depth=False)
    depth = _pictures(bench, clips, models, depth=True)
    few = len(clips.offsets)
    clips = bench.clips(FRAMES, 2 if bench.quick else CREDIT)
    owed = credit(bench, models[SHIPS], clips)
    records = {
        "credit": owed,
        "futures": futures,
        "noisy": noisy,
        "hidden": hidden,
        "detector": detector,
        "depth": depth,
    }
    return Result(
        [_futures_table(futures, count), credit_table(owed, len(clips.offsets)), *_fit_tables(records, few)],
        {"data": clips.source, "records": records | {"levels": levels}},
        _figure_8(levels, drawn),
    )


def _noisy(bench: Bench, clips: MotionClips, models: dict[str, Any], *, hide: bool) -> list[dict[str, Any]]:
    """Table 2: all joints with noise; or with ``hide``, without noise, those below `HIDDEN_BELOW` hidden."""
    truth = clips.positions
    seen = spoiled(truth, *((0.0, HIDDEN_BELOW) if hide else (NOISE, 0.0)), seed=0)
    live = {delay: _live(clips, seen, delay) for delay in (4, DELAY)}
    answers: dict[str, list[Answer]] = {
        _TRUTH: _each(truth),
        "filter bank, offline": _each(bank(seen, clips.stamps_s, FRAMES)),
    }
    if not hide:
        answers = {_TRUTH: _each(truth), _RAW: _each(seen)} | answers
    answers |= {f"steadypose live, delay {delay}": _each(found) for delay, found in live.items()}
    names = (_PER_FRAME, *reversed([*VARIANTS]), SHIPS)
    for name in bench.progress.track(names, description="hidden" if hide else "noisy"):
        answers[name] = _fits(models, name, live[DELAY], seen)
    load, unseen = load_labels(clips), np.isnan(seen[..., 0])
    return [{"method": name, **scores(found, truth, unseen, load)} for name, found in answers.items()]


def _levels(bench: Bench, clips: MotionClips, models: dict[str, Any]) -> list[dict[str, Any]]:
    """Figure 8: more and more of the body hidden, and more and more noise."""
    truth, load = clips.positions, load_labels(clips)
    levels = [(0.0, below) for below in HEIGHTS] + [(noise, 0.0) for noise in NOISES if noise]
    records = []
    for noise, below in bench.progress.track(levels[4:6] if bench.quick else levels, description="figure 8"):
        seen = spoiled(truth, noise, below, seed=0)
        live = _live(clips, seen, DELAY)
        answers = {name: _fits(models, name, live, seen) for name in (_PER_FRAME, MVAE, SHIPS)}
        answers = {_TRUTH: _each(truth), f"steadypose live, delay {DELAY}": _each(live)} | answers
        for name, found in answers.items():
            told = scores(found, truth, np.isnan(seen[..., 0]), load)
            records.append({"method": name, "noise_cm": 100 * noise, "below_m": below, **told})
    return records


def _live(clips: MotionClips, seen: Floats, delay: int) -> Floats:
    """What `clean` says of clips (T, C, 22, 3) as they come in."""
    return ours.run(ours.OURS["steadypose"], seen, clips.stamps_s, delay).positions[-FRAMES:]


def _fits(models: dict[str, Any], name: str, start: Floats, seen: Floats) -> list[Answer]:
    """By one model or without one, of each of C clips, ``start`` and ``seen`` (T, C, 22, 3)."""
    model, stages = (models[SHIPS], 2) if name == _PER_FRAME else (models[name], 3)
    return [
        fitted(model, [start_of(start[:, c])], seen_joints(seen[:, c]), stages, FitSettings())
        for c in range(seen.shape[1])
    ]


def _pictures(bench: Bench, clips: MotionClips, models: dict[str, Any], *, depth: bool) -> list[dict[str, Any]]:
    """Tables 3 and 4: key points of a simulated detector, alone or with the points of a simulated depth camera."""
    taken = [pictures(clips, c, np.random.default_rng((1, c))) for c in range(len(clips.offsets))]
    truth = np.stack([picture.truth for picture in taken], axis=1)
    unseen = np.stack([~picture.seen for picture in taken], axis=1)
    load = load_labels(clips)
    fits = {_PER_FRAME: (models[SHIPS], 2), MVAE: (models[MVAE], 3), SHIPS: (models[SHIPS], 3)}
    records = [{"method": _TRUTH, **scores(_each(truth), truth, unseen, load, -CAMERA_HEIGHT)}]
    for name, (model, stages) in bench.progress.track(fits.items(), description="depth" if depth else "detector"):
        found = [
            fitted(model, track.starts, track.observed, stages, camera_settings())
            for track in (picture.deep if depth else picture.flat for picture in taken)
        ]
        records.append({"method": name, **scores(found, truth, unseen, load, -CAMERA_HEIGHT)})
    return records


def _each(positions: np.ndarray) -> list[Answer]:
    return [Answer(positions[:, c]) for c in range(positions.shape[1])]


def _figure_8(levels: Sequence[dict[str, Any]], clips: int) -> dict[str, Figure]:
    """Errors by what is hidden, and acceleration and errors by noise; without levels at which a body is lost."""
    lost = {r["below_m"] for r in levels if not np.isfinite(r["acceleration_m_s2"])}
    hidden = [r for r in levels if not r["noise_cm"] and r["below_m"] not in lost and r["method"] != _TRUTH]
    # truth is drawn last, so that methods have the same colours in both; its error is none
    noisy = [r for r in levels if not r["below_m"] and r["method"] != _TRUTH]
    noisy += [r | {"all_mm": None} for r in levels if not r["below_m"] and r["method"] == _TRUTH]
    what = f"{clips} clips of 3 s (HuMoR's figure 8)"
    return {
        "humor_hidden": figures.curves(
            hidden, "below_m", {"all_mm": "all joints, mm", "hidden_mm": "hidden joints, mm"},
            "hidden below, m", f"Hidden joints: {what}",
        ),
        "humor_noise": figures.curves(
            noisy, "noise_cm", {"acceleration_m_s2": "acceleration, m/s²", "all_mm": "all joints, mm"},
            "noise, cm", f"Noise: {what}",
        ),
    }  # fmt: skip


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
