"""A real Kinect's errors against a Vicon system, on UI-PRMD, those of a simulated one on the same motions, and the
statistics of errors that the noise model is fitted to.

The Kinect's joints are compared with the Vicon's joint centres after a robust rigid alignment a clip and without the
constant offset between the two definitions of a joint (in the frame of the joint's bone, the median over all clips).
What is left is the error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import median_filter

from steadypose.prior.arrays import Floats
from steadypose.prior.body.bone_lengths import estimate_offsets
from steadypose.prior.body.inverse_kinematics import solve_rotations
from steadypose.prior.body.kinematics import global_rotations
from steadypose.prior.body.layouts import KINECT22, to_canonical
from steadypose.prior.body.skeleton import JOINTS, MIRROR, PARENTS
from steadypose.prior.sim.noise import NoiseModel, draw_errors, ray_axes, travelled
from steadypose.training.data.ui_prmd import KinectPair

SEEN = np.flatnonzero(KINECT22.observable)
"""(S,) the canonical joints that this Kinect gives"""
_FAILED = ("m03", "s01")


@dataclass(frozen=True)
class Clip:
    """A clip in the Kinect's frame (z up, the camera at the origin).

    Attributes:
        fps: frames a second.
        truth: (T, 22, 3) metres, the Vicon's joint centres plus the definition's offset: where the Kinect should
            have seen each joint.
        kinect: (T, 22, 3) metres, where it saw them; NaN for joints it does not give.
    """

    fps: float
    truth: Floats
    kinect: Floats


def align(moving: Floats, fixed: Floats) -> tuple[Floats, Floats]:
    """The rotation and translation that lay ``moving`` (N, 3) on ``fixed`` (N, 3), both metres.

    Iteratively reweighted (Cauchy, 5 cm), so that a few wild joints do not turn the body. Points that are not
    finite on both sides are left out.
    """
    finite = np.isfinite(moving).all(axis=1) & np.isfinite(fixed).all(axis=1)
    a, b = moving[finite], fixed[finite]
    weight = np.ones(len(a))
    rotation, shift = np.eye(3), np.zeros(3)
    for _ in range(5):
        total = weight.sum()
        ca, cb = weight @ a / total, weight @ b / total
        u, _, vt = np.linalg.svd((weight[:, None] * (a - ca)).T @ (b - cb))
        sign = np.array([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))])
        rotation = (vt.T * sign) @ u.T
        shift = cb - rotation @ ca
        weight = 1 / (1 + (np.linalg.norm(a @ rotation.T + shift - b, axis=1) / 0.05) ** 2)
    return rotation, shift


def usable(pair: KinectPair) -> bool:
    """Whether the Kinect tracked at all: in s01's lunges (m03) it lost the legs, half a metre off, throughout."""
    return (pair.movement, pair.subject) != _FAILED


def prepare(pairs: Sequence[KinectPair]) -> list[Clip]:
    """Bring both systems' joints into the Kinect's frame, with the constant offset between the definitions learned."""
    kinect = [to_canonical(KINECT22, p.kinect)[0] for p in pairs]
    frames = _bone_frames(pairs)
    offset = np.zeros((len(JOINTS), 3))

    def placed(pair: KinectPair, bones: Floats, seen: Floats) -> tuple[Floats, Floats, Floats]:
        """Joints with the offset so far, joint centres, and bones' frames: all moved into the Kinect's frame."""
        shifted = pair.vicon + np.einsum("tjab,jb->tja", bones, offset)
        rotation, shift = align(shifted[:, SEEN].reshape(-1, 3), seen[:, SEEN].reshape(-1, 3))
        return shifted @ rotation.T + shift, pair.vicon @ rotation.T + shift, rotation @ bones

    for _ in range(3):
        local = []
        for pair, bones, seen in zip(pairs, frames, kinect, strict=True):
            _, centres, turned = placed(pair, bones, seen)
            local.append(np.einsum("tjba,tjb->tja", turned, seen - centres))
        offset[SEEN] = np.nanmedian(np.concatenate(local)[:, SEEN], axis=0)
    return [Clip(p.fps, placed(p, g, k)[0], k) for p, g, k in zip(pairs, frames, kinect, strict=True)]


def _bone_frames(pairs: Sequence[KinectPair]) -> list[Floats]:
    """(T, 22, 3, 3) world orientation of the bone that ends in each joint, from the Vicon's joint centres."""
    parents = np.maximum(PARENTS, 0)
    frames: list[Floats] = []
    bones = {
        s: estimate_offsets(np.concatenate([p.vicon for p in pairs if p.subject == s])[::10])
        for s in {p.subject for p in pairs}
    }
    for p in pairs:
        frames.append(global_rotations(solve_rotations(p.vicon, bones[p.subject]))[:, parents])
    return frames


def errors(clip: Clip) -> Floats:
    """(T, S, 3) metres: the error of the joints seen, along the camera's ray, to its right, up.

    Aligned once more, so that real and simulated clips are treated alike.
    """
    rotation, shift = align(clip.kinect[:, SEEN].reshape(-1, 3), clip.truth[:, SEEN].reshape(-1, 3))
    difference = clip.kinect[:, SEEN] @ rotation.T + shift - clip.truth[:, SEEN]
    return np.einsum("tjkx,tjx->tjk", ray_axes(clip.truth[:, SEEN]), difference)


def simulate(clips: Sequence[Clip], model: NoiseModel, rng: np.random.Generator) -> list[Clip]:
    """The same motions as a simulated Kinect would have seen them. Joints the Vicon lost stay lost."""
    out: list[Clip] = []
    for clip in clips:
        filled = np.where(np.isfinite(clip.truth), clip.truth, [0.0, 2.5, 0.0])
        dt = np.full(len(filled), 1 / clip.fps)
        drawn = draw_errors(np.minimum(travelled(filled), 0.2), dt, rng, model)
        noisy = clip.truth + np.einsum("tjk,tjkx->tjx", drawn.steady + drawn.quick, ray_axes(filled))
        out.append(replace(clip, kinect=np.where(np.isfinite(clip.kinect), noisy, np.nan)))
    return out


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
