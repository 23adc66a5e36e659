"""Cameras of other rates than the grid's 30 Hz, and a tracker of 15 Hz whose frames are given twice.

Peers run at the camera's own rate, with the same delay in seconds, and are tuned there. All are scored at the times of
the grid.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from steadypose.benchmarks.baselines.filters import FILTERS, OFFLINE, Peer, missing
from steadypose.benchmarks.bench import Bench, Methods, Result, answers, tune, tuning_log
from steadypose.benchmarks.corruption import gaussian
from steadypose.benchmarks.ours import OURS
from steadypose.benchmarks.provenance import CLEAN
from steadypose.benchmarks.scores import figures, pivot, score
from steadypose.prior.arrays import Floats
from steadypose.prior.timing.rate import FPS

DEPENDS_ON = CLEAN

NOISE = 0.01
"""Metres along an axis."""
DELAYS = (0, 4)
"""Frames at 30 Hz."""
CAMERAS = {"15 Hz, given twice": 1, "30 Hz": 1, "60 Hz": 2, "120 Hz": 4}
"""Multiple of the grid's rate at which frames come."""
TWICE = "15 Hz, given twice"


class Seen(NamedTuple):
    """Frames of a camera."""

    stamps_s: Floats  # (T,)
    positions: Floats  # (T, C, 22, 3) metres


def observe(camera: str, truth_at: CubicSpline, seed: int) -> Seen:
    """What a camera sees of clips over the spline's range."""
    end = truth_at.x[-1]
    stamps = np.arange(round(end * FPS * CAMERAS[camera]) + 1) / (FPS * CAMERAS[camera])
    positions = gaussian(truth_at(stamps), NOISE, np.random.default_rng(seed))
    if camera == TWICE:
        positions = positions[np.arange(len(positions)) // 2 * 2]
    return Seen(stamps, positions)


def run(bench: Bench) -> Result:
    """Every method with every camera."""
    clips = bench.clips(most=24)
    truth_at = CubicSpline(clips.stamps_s, clips.positions)
    peers = [peer for peer in FILTERS if peer.delays != (OFFLINE,)]
    cameras = [TWICE, "60 Hz"] if bench.quick else list(CAMERAS)
    records, tuning = [], {}
    for camera in cameras:
        seen, other = (observe(camera, truth_at, seed) for seed in (0, 1))
        other = Seen(other.stamps_s, other.positions[:, ::3])
        methods = Methods(
            [_at_rate(peer, CAMERAS[camera]) for peer in peers], {"steadypose": OURS["steadypose"]}, DELAYS, False
        )

        def evaluate(peer: Peer, delay: int, parameters: Mapping[str, float], other: Seen = other) -> dict[str, float]:
            positions = peer.run(other.positions, other.stamps_s, delay, **parameters)
            return _errors(other.stamps_s, positions, clips.stamps_s, clips.positions[:, ::3])

        tuned = tune(bench, evaluate, camera, methods.peers, DELAYS)
        tuning[camera] = tuning_log(tuned)
        for answer in answers(bench, seen.positions, seen.stamps_s, tuned, camera, methods):
            found = _errors(answer.stamps_s, answer.positions, clips.stamps_s, clips.positions)
            both = f"{found['position_mm']:.1f} / {found['acceleration_mm']:.2f}"
            records.append({"camera": camera, "method": answer.method, "delay": answer.delay, **found, "both": both})
    note = (
        f"{clips.positions.shape[1]} clips of {len(clips.positions)} frames at 30 Hz, interpolated by cubic splines; "
        f"{NOISE * 100:.0f} cm of independent noise. Delay in frames at 30 Hz. Peers run at the camera's rate, tuned "
        "on every third of these clips with other noise. Of the fast cameras, steadypose waits for one frame more, but "
        "not of 60 Hz if no delay is asked for."
    )
    title = "Cameras of other rates: MPJPE, mm / acceleration error, mm/frame² at 30 Hz"
    data: dict[str, Any] = {"data": clips.source, "records": records, "tuning": tuning}
    return Result([pivot(records, "camera", "both", "camera_rates", title, note)], data)


def _at_rate(peer: Peer, factor: int) -> Peer:
    """The peer with its delay given in frames at 30 Hz."""

    def run_at_rate(seen: Floats, stamps_s: Floats, delay: int, **parameters: float) -> Floats:
        return peer.run(seen, stamps_s, delay * factor, **parameters)

    return replace(peer, run=run_at_rate)


def _errors(stamps_s: Floats, positions: Floats, grid_s: Floats, truth: Floats) -> dict[str, float]:
    """Errors at the grid's times, mm and mm/frame², of answers that have these among their stamps."""
    ours, wanted = np.nonzero(np.abs(stamps_s[:, None] - grid_s) < 1e-4)
    at_grid = positions[ours]
    found = figures(score(at_grid, truth[wanted], missing(at_grid), align=False))
    return {key: found[key] for key in ("position_mm", "acceleration_mm")}
