"""Fit the noise model to a real Kinect: UI-PRMD, training subjects only.

A Kinect and a Vicon system saw the same movements. The Kinect's joints are compared with the Vicon's joint centres
after a robust rigid alignment a clip and without the constant offset between the two definitions of a joint (in the
frame of the joint's bone, the median over all clips). What is left is the error. Its statistics are matched by
simulation: noise is drawn for the same motions, goes through the same alignment, and each parameter is scaled by
the ratio of its own statistic in real to that in simulated errors, until they agree.

    python -m steadypose.prior.sim.fit PATH/TO/ui_prmd.npz
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from steadypose.prior.body.bone_lengths import estimate_offsets
from steadypose.prior.body.inverse_kinematics import solve_rotations
from steadypose.prior.body.kinematics import global_rotations
from steadypose.prior.body.layouts import KINECT22, to_canonical
from steadypose.prior.body.skeleton import JOINTS, MIRROR, PARENTS, J
from steadypose.prior.motion.ui_prmd import TRAIN_SUBJECTS, KinectPair, load_pairs
from steadypose.prior.sim.noise import KINECT_NOISE, NoiseModel, draw_errors, ray_axes, travelled

Floats = NDArray[np.float64]

SEEN = np.flatnonzero(KINECT22.observable)
"""The canonical joints that this Kinect gives."""

_ITERATIONS = 20
_EVERY = 4  # clips used while iterating: repetitions of a movement resemble each other
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


# ---------------------------------------------------------------------------------------------------------------
# Statistics


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
            log_speed.append(np.log(_SPEED_FLOOR + speed[block].mean(axis=0)))
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
        steps.append((size > _JUMP).sum(axis=0))
        seconds += len(d) / clip.fps
        for t, j in zip(*np.nonzero(size > _JUMP), strict=True):
            sizes.append(size[t, j])
            ahead = np.linalg.norm(e[t + 2 : t + 5, j] - e[t, j], axis=-1)
            back.append(bool((ahead < 0.4 * size[t, j]).any()))
    speeds, y = np.stack(log_speed), np.stack(log_size)
    y = y - y.mean(axis=0)
    x = speeds - speeds.mean(axis=0)
    slope = _alike((x * y).sum(axis=0) / (x * x).sum(axis=0))
    c = np.concatenate(change)
    length = np.linalg.norm(np.concatenate(whole), axis=-1)
    common = np.concatenate(shared)
    return Statistics(
        fast=_alike(np.median(np.abs(np.concatenate(fast)), axis=0)),
        fast_slope=slope,
        fast_spread_still=float((y - slope * x)[speeds < np.log(0.1)].std()),
        fast_spread_moving=float((y - slope * x)[speeds > np.log(0.4)].std()),
        fast_lag1=float(lag1[2][0] / lag1[2][1]),
        total=_alike(np.median(np.abs(np.concatenate(whole)), axis=0)),
        bias=_alike(np.nanmedian(np.abs(c), axis=0)),
        bias_growth=float(np.median(np.abs(np.concatenate(growth[0]))) / np.median(np.abs(np.concatenate(growth[1])))),
        bias_lag1=float(lag1[1][0] / lag1[1][1]),
        total_tail=float(np.percentile(length, 95) / np.median(length)),
        shared=float((common.mean(axis=1) ** 2).mean() / (common**2).mean()),
        jump_rate=_alike(np.sum(steps, axis=0) / seconds),
        jump_tail=float(1 / np.log(np.array(sizes) / _JUMP).mean()),
        jump_back=float(np.mean(back)),
    )


def _alike(values: Floats) -> Floats:
    """Left and right (first axis: joints seen) as their mean: which side was moved says nothing of the sensor."""
    return (values + values[_OTHER_SIDE]) / 2


_OTHER_SIDE = np.array([int(np.flatnonzero(MIRROR[j] == SEEN)[0]) for j in SEEN])
_SPEED_FLOOR = 0.03  # m/s: below it the Vicon's own noise dominates a joint's speed
_JUMP = 0.08  # metres a frame


def _initial(real: Statistics) -> NoiseModel:
    n = len(JOINTS)
    return NoiseModel(
        offset=np.full((n, 3), 0.02),
        bias=np.full((n, 3), 0.015),
        bias_length=0.15,
        bias_inertia=0.15,
        session_spread=0.6,
        fast=np.full((n, 3), 0.002),
        fast_memory=0.015,
        speed_floor=_SPEED_FLOOR,
        speed_exponent=np.full(n, 0.7),
        fast_spread_still=1.2,
        fast_spread_moving=0.6,
        fast_spread_memory=0.5,
        shared=0.2,
        jump_rate=np.full(n, 0.1),
        jump_least=0.04,
        jump_tail=real.jump_tail,
        jump_short=0.05,
        jump_long=1.5,
        # A short jump crosses the threshold twice, there and back, and only the first counts as undone.
        jump_short_share=min(1.0, 2 * real.jump_back),
    )


def _improved(model: NoiseModel, real: Statistics, simulated: Statistics) -> NoiseModel:
    """Scale each parameter by how far its statistic is off, damped; joints not seen copy their neighbours."""

    def ratio(a: Floats | float, b: Floats | float) -> Floats:
        return np.clip(np.asarray(a) / np.maximum(b, 1e-9), 0.5, 2.0) ** 0.5

    def seen(values: Floats, factor: Floats) -> Floats:
        values = values.copy()
        values[SEEN] *= factor
        return _fill(values)

    # Offset and bias make up the error together; how it changes with travel says how they share it.
    both = seen(np.hypot(model.offset, model.bias), ratio(real.total, simulated.total))
    share = seen(model.bias / np.hypot(model.offset, model.bias), ratio(real.bias, simulated.bias)).clip(0.1, 0.95)
    exponent = model.speed_exponent.copy()
    exponent[SEEN] += 0.7 * (real.fast_slope - simulated.fast_slope)
    return replace(
        model,
        offset=both * np.sqrt(1 - share**2),
        bias=both * share,
        bias_length=float(model.bias_length * ratio(simulated.bias_growth, real.bias_growth)),
        bias_inertia=float(np.clip(model.bias_inertia * np.exp(2 * (real.bias_lag1 - simulated.bias_lag1)), 0.01, 0.4)),
        session_spread=float(model.session_spread * ratio(np.log(real.total_tail), np.log(simulated.total_tail))),
        fast=seen(model.fast, ratio(real.fast, simulated.fast)),
        fast_memory=float(np.clip(model.fast_memory * np.exp(2 * (real.fast_lag1 - simulated.fast_lag1)), 0.003, 0.1)),
        speed_exponent=_fill(np.clip(exponent, 0.0, 1.5)),
        fast_spread_still=float(model.fast_spread_still * ratio(real.fast_spread_still, simulated.fast_spread_still)),
        fast_spread_moving=float(
            model.fast_spread_moving * ratio(real.fast_spread_moving, simulated.fast_spread_moving)
        ),
        shared=float(np.clip(model.shared * ratio(real.shared, simulated.shared), 0.01, 0.9)),
        jump_rate=seen(model.jump_rate, ratio(real.jump_rate, simulated.jump_rate)),
    )


def _fill(values: Floats) -> Floats:
    """Give joints this Kinect lacks the mean of their neighbours in the skeleton."""
    values = values.copy()
    for joint in np.flatnonzero(~KINECT22.observable):
        values[joint] = np.mean([values[n] for n in _NEIGHBOURS[JOINTS[joint]]], axis=0)
    return values


def _discrepancy(real: Statistics, simulated: Statistics) -> float:
    """Mean |log ratio| of the positive statistics and |difference| of the autocorrelations, each statistic alike."""
    parts = []
    for f in fields(Statistics):
        a, b = np.asarray(getattr(real, f.name)), np.asarray(getattr(simulated, f.name))
        parts.append(np.abs(a - b).mean() if "lag1" in f.name else np.abs(np.log((a + 1e-9) / (b + 1e-9))).mean())
    return float(np.mean(parts))


def fit(clips: Sequence[Clip], report: Callable[[str], None]) -> NoiseModel:
    """The model whose simulated errors look most like the real ones; ``report`` is told of each iteration."""
    some = clips[::_EVERY]
    real = statistics(some)
    model = _initial(real)
    best, least = model, math.inf
    for iteration in range(_ITERATIONS):
        simulated = statistics(simulate(some, model, np.random.default_rng(iteration)))
        off = _discrepancy(real, simulated)
        report(f"iteration {iteration + 1} of {_ITERATIONS}: off by {100 * off:.1f} % a statistic")
        if off < least:
            best, least = model, off
        model = _improved(model, real, simulated)
    return best


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


def draw(real: Sequence[Clip], simulated: Sequence[Clip], path: Path) -> None:
    """Real beside simulated errors: how large, how they change from frame to frame, how long they last."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (a, b, c) = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
    for clips, label, style in ((real, "Kinect (UI-PRMD, s01-s06)", "-"), (simulated, "simulated", "--")):
        found = [e for e in map(errors, clips) if np.isfinite(e).all()]
        size = np.sort(np.concatenate([np.linalg.norm(e, axis=-1).ravel() for e in found]))
        step = np.sort(np.concatenate([np.linalg.norm(np.diff(e, axis=0), axis=-1).ravel() for e in found]))
        thin = slice(None, None, max(1, len(size) // 4000))
        a.plot(100 * size[thin], np.linspace(0, 1, len(size))[thin], style, label=label)
        above = 1 - np.arange(len(step)) / len(step)
        keep = np.unique(np.geomspace(1, len(step), 2000).astype(int)) - 1
        b.loglog(100 * step[::-1][keep], above[::-1][keep], style)
        c.plot(np.arange(31) / 30, autocorrelation(clips, 30), style)
    a.set(xlabel="error (cm)", ylabel="share of joints below", xscale="log", xlim=(0.2, 100))
    b.set(xlabel="change in one frame (cm)", ylabel="share above", xlim=(0.05, 200), ylim=(1e-5, 1))
    c.set(xlabel="lag (s)", ylabel="autocorrelation of the error", ylim=(-0.3, 1))
    for axes in (a, b, c):
        axes.grid(alpha=0.3)
    a.legend(loc="lower right")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    """Fit, write ``kinect_noise.json`` and the picture."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("archive", type=Path, help="ui_prmd.npz")
    parser.add_argument("--out", type=Path, default=KINECT_NOISE, help="where the parameters go")
    parser.add_argument("--picture", type=Path, help="a picture of real beside simulated errors")
    arguments = parser.parse_args()
    clips = prepare([p for p in load_pairs(arguments.archive, TRAIN_SUBJECTS) if usable(p)])
    model = fit(clips, report=print)
    simulated = simulate(clips, model, np.random.default_rng(1))
    table = {"kinect": summary(clips), "simulated": summary(simulated)}
    about = {
        "what": "Errors of a Kinect v2's body tracker against a Vicon system, as the parameters of prior.sim.noise",
        "data": "UI-PRMD (University of Idaho), PDDL 1.0 (public domain); no recording is contained",
        "subjects": list(TRAIN_SUBJECTS),
        "clips": len(clips),
        "left_out": "movement m03 of s01, where the Kinect lost the legs",
        "command": "python -m steadypose.prior.sim.fit ui_prmd.npz --picture docs/images/kinect-noise.png",
        "metres": {who: {k: round(v, 4) for k, v in row.items()} for who, row in table.items()},
    }
    model.save(arguments.out, about)
    for name in table["kinect"]:
        print(f"{name:28} {table['kinect'][name]:8.4f} {table['simulated'][name]:8.4f}")
    if arguments.picture:
        draw(clips, simulated, arguments.picture)


_NEIGHBOURS = {
    "spine1": (J["pelvis"], J["spine3"]),
    "spine2": (J["pelvis"], J["spine3"]),
    "left_collar": (J["neck"], J["left_shoulder"]),
    "right_collar": (J["neck"], J["right_shoulder"]),
}

if __name__ == "__main__":
    main()
