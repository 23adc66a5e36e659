"""Fit the noise model to a real Kinect: UI-PRMD, training subjects only.

Parameters are fitted by simulation: errors are drawn for the same motions and aligned in the same way, and each
parameter is scaled by the ratio of its statistic in real errors to that in simulated ones, until they agree.

    python -m steadypose.training.recipes.sensor_noise PATH/TO/ui_prmd.npz
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.body.layouts import KINECT22
from steadypose.prior.body.skeleton import JOINTS, J
from steadypose.prior.sim.noise import KINECT_NOISE, NoiseModel
from steadypose.training.data.kinect_errors import (
    SEEN,
    SPEED_FLOOR,
    Clip,
    Statistics,
    autocorrelation,
    errors,
    prepare,
    simulate,
    statistics,
    summary,
    usable,
)
from steadypose.training.data.ui_prmd import TRAIN_SUBJECTS, load_pairs

_ITERATIONS = 20
_EVERY = 4  # clips used while iterating: repetitions of a movement resemble each other
_NEIGHBOURS = {
    "spine1": (J["pelvis"], J["spine3"]),
    "spine2": (J["pelvis"], J["spine3"]),
    "left_collar": (J["neck"], J["left_shoulder"]),
    "right_collar": (J["neck"], J["right_shoulder"]),
}


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
        speed_floor=SPEED_FLOOR,
        speed_exponent=np.full(n, 0.7),
        fast_spread_still=1.2,
        fast_spread_moving=0.6,
        fast_spread_memory=0.5,
        shared=0.2,
        jump_rate=np.full(n, 0.1),
        jump_minimum=0.04,
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
    """The model whose simulated errors have statistics nearest to the real ones; ``report`` is called in each
    iteration."""
    some = clips[::_EVERY]
    real = statistics(some)
    model = _initial(real)
    best, smallest = model, math.inf
    for iteration in range(_ITERATIONS):
        simulated = statistics(simulate(some, model, np.random.default_rng(iteration)))
        off = _discrepancy(real, simulated)
        report(f"iteration {iteration + 1} of {_ITERATIONS}: off by {100 * off:.1f} % a statistic")
        if off < smallest:
            best, smallest = model, off
        model = _improved(model, real, simulated)
    return best


def draw(real: Sequence[Clip], simulated: Sequence[Clip], path: Path) -> None:
    """Plot real and simulated errors: their distribution, that of their changes, and their autocorrelation."""
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
        "command": "python -m steadypose.training.recipes.sensor_noise ui_prmd.npz "
        "--picture docs/images/kinect-noise.png",
        "metres": {who: {k: round(v, 4) for k, v in row.items()} for who, row in table.items()},
    }
    model.save(arguments.out, about)
    for name in table["kinect"]:
        print(f"{name:28} {table['kinect'][name]:8.4f} {table['simulated'][name]:8.4f}")
    if arguments.picture:
        draw(clips, simulated, arguments.picture)


if __name__ == "__main__":
    main()
