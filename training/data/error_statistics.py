"""The statistics of a tracker's errors that the noise model is fitted to, and those it is reported by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import MIRROR
from steadypose.prior.sim.noise import travelled
from steadypose.training.data.kinect_errors import SEEN, Clip, errors

SPEED_FLOOR = 0.03
"""m/s: below it the Vicon's own noise dominates a joint's speed (UI-PRMD, training subjects)"""
JUMP = 0.08
"""metres a frame: a change of the error that counts as a jump"""


@dataclass(frozen=True)
class Statistics:
    """What is matched, each belonging to one parameter; S joints seen."""

    fast: Floats  # (S, 3) median |second difference|
    fast_slope: Floats  # (S,) of log fast error on log speed
    fast_spread_still: float  # standard deviation of log fast error about that line, below 0.1 m/s
    fast_spread_moving: float  # the same above 0.4 m/s
    fast_lag1: float  # autocorrelation of the clipped second difference
    total: Floats  # (S, 3) median |error|
    bias: Floats  # (S, 3) median |change of the error over 8 to 40 cm of travel|
    bias_growth: float  # that change over 1.5 to 5 cm of travel, relative to 15 to 50 cm
    bias_lag1: float  # autocorrelation of the clipped first difference
    total_tail: float  # 95th percentile of the error's length over its median
    shared: float  # share of the variance of the change that all joints have in common
    jump_rate: Floats  # (S,) changes above 8 cm a frame, a second
    jump_tail: float  # exponent of the Pareto law of their sizes (Hill's estimate)
    jump_back: float  # share of them undone within 3 frames


def statistics(clips: Sequence[Clip]) -> Statistics:
    """Measure the errors of clips, real or simulated."""
    fast, log_size, log_speed, whole, change, shared = [], [], [], [], [], []
    lag1 = {1: np.zeros(2), 2: np.zeros(2)}
    growth: tuple[list[Floats], list[Floats]] = ([], [])
    steps, sizes, back, seconds = [], [], [], 0.0
    for clip in clips:
        e = errors(clip)
        if not np.isfinite(e).all():
            continue
        walked = travelled(clip.truth)[:, SEEN]
        speed = walked * clip.fps
        h = np.diff(e, 2, axis=0)
        fast.append(h)
        for start in range(0, len(h) - 9, 10):
            block = slice(start, start + 10)
            log_size.append(np.log(2e-4 + np.abs(h[block]).max(axis=-1).mean(axis=0)))
            log_speed.append(np.log(SPEED_FLOOR + speed[block].mean(axis=0)))
        for order, sums in lag1.items():
            d = np.clip(np.diff(e, order, axis=0), -0.01, 0.01)
            sums += (d[1:] * d[:-1]).sum(), (d**2).sum()
        whole.append(e)
        smooth = median_filter(e, size=(5, 1, 1), mode="nearest")
        path = np.cumsum(walked, axis=0)
        for lag in (5, 10, 20):
            if len(e) > lag:
                length = (path[lag:] - path[:-lag])[::3]
                by = (smooth[lag:] - smooth[:-lag])[::3]
                change.append(np.where(((length > 0.08) & (length < 0.4))[..., None], by, np.nan))
                growth[0].append(by[(length > 0.015) & (length < 0.05)].ravel())
                growth[1].append(by[(length > 0.15) & (length < 0.5)].ravel())
                shared.append(np.clip(by, -0.05, 0.05))
        d = np.diff(e, axis=0)
        size = np.linalg.norm(d, axis=-1)
        steps.append((size > JUMP).sum(axis=0))
        seconds += len(d) / clip.fps
        for t, j in zip(*np.nonzero(size > JUMP), strict=True):
            sizes.append(size[t, j])
            ahead = np.linalg.norm(e[t + 2 : t + 5, j] - e[t, j], axis=-1)
            back.append(bool((ahead < 0.4 * size[t, j]).any()))
    speeds, y = np.stack(log_speed), np.stack(log_size)
    y = y - y.mean(axis=0)
    x = speeds - speeds.mean(axis=0)
    slope = _sides_averaged((x * y).sum(axis=0) / (x * x).sum(axis=0))
    c = np.concatenate(change)
    length = np.linalg.norm(np.concatenate(whole), axis=-1)
    common = np.concatenate(shared)
    return Statistics(
        fast=_sides_averaged(np.median(np.abs(np.concatenate(fast)), axis=0)),
        fast_slope=slope,
        fast_spread_still=float((y - slope * x)[speeds < np.log(0.1)].std()),
        fast_spread_moving=float((y - slope * x)[speeds > np.log(0.4)].std()),
        fast_lag1=float(lag1[2][0] / lag1[2][1]),
        total=_sides_averaged(np.median(np.abs(np.concatenate(whole)), axis=0)),
        bias=_sides_averaged(np.nanmedian(np.abs(c), axis=0)),
        bias_growth=float(np.median(np.abs(np.concatenate(growth[0]))) / np.median(np.abs(np.concatenate(growth[1])))),
        bias_lag1=float(lag1[1][0] / lag1[1][1]),
        total_tail=float(np.percentile(length, 95) / np.median(length)),
        shared=float((common.mean(axis=1) ** 2).mean() / (common**2).mean()),
        jump_rate=_sides_averaged(np.sum(steps, axis=0) / seconds),
        jump_tail=float(1 / np.log(np.array(sizes) / JUMP).mean()),
        jump_back=float(np.mean(back)),
    )


def _sides_averaged(values: Floats) -> Floats:
    """Left and right (first axis: joints seen) as their mean: which side was moved says nothing of the sensor."""
    return (values + values[_OTHER_SIDE]) / 2


_OTHER_SIDE = np.array([int(np.flatnonzero(MIRROR[j] == SEEN)[0]) for j in SEEN])


def summary(clips: Sequence[Clip]) -> dict[str, float]:
    """The figures by which real and simulated errors are compared, in metres."""
    found = [e for e in map(errors, clips) if np.isfinite(e).all()]
    size = np.concatenate([np.linalg.norm(e, axis=-1).ravel() for e in found])
    bend = np.concatenate([np.linalg.norm(np.diff(e, 2, axis=0), axis=-1).ravel() for e in found])
    worst = [np.linalg.norm(np.diff(e, axis=0), axis=-1).max() for e in found]
    jumps = np.percentile(worst, [50, 90, 99])
    return {
        "median": float(np.median(size)),
        "p95": float(np.percentile(size, 95)),
        "second_difference_mean": float(bend.mean()),
        "second_difference_median": float(np.median(bend)),
        "worst_jump_p50": float(jumps[0]),
        "worst_jump_p90": float(jumps[1]),
        "worst_jump_p99": float(jumps[2]),
        "autocorrelation_lag1": float(autocorrelation(clips, 1)[1]),
    }


def autocorrelation(clips: Sequence[Clip], lags: int) -> Floats:
    """(lags + 1,) of the error about its mean over a clip, clipped at 10 cm, over all joints and axes."""
    products, squares = np.zeros(lags + 1), np.zeros(lags + 1)
    for e in map(errors, clips):
        if np.isfinite(e).all() and len(e) > lags:
            c = np.clip(e - e.mean(axis=0), -0.1, 0.1)
            for lag in range(lags + 1):
                a, b = c[lag:], c[: len(c) - lag]
                products[lag] += (a * b).sum()
                squares[lag] += ((a**2).sum() + (b**2).sum()) / 2
    return products / squares
