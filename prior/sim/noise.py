"""Error model of a depth camera's body tracker: a random process with parameters fitted to a real Kinect.

Each joint has

- an **offset**, constant for a session, and a **bias** that drifts with the *distance the joint travels*, not with
  time: a still joint keeps its error, whatever the frame rate;
- **fast** noise that grows with the joint's speed and whose scale varies over an order of magnitude (log-normally, with
  a correlation time of half a second), which makes its tails heavy;
- **jumps**: the joint is displaced for a frame or for seconds (a wrong surface, the other limb), then returns;
- **swaps** of left and right limbs for short bursts;
- a share of each error that all joints of the body have in common.

Errors are drawn in the frame of the camera's ray to the joint: along it, to its right, and up. The parameters were
fitted once to the statistics of UI-PRMD's Kinect relative to its Vicon (`training/recipes/sensor_noise.py` of commit
d5d5ec8).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.skeleton import J

KINECT_NOISE = Path(__file__).with_name("kinect_noise.json")
"""File of the parameters fitted to UI-PRMD's Kinect, with their provenance."""

SWAP_GROUPS: Mapping[str, tuple[int, ...]] = {
    group: tuple(J[f"{side}_{part}"] for side in ("left", "right") for part in parts)
    for group, parts in {"arms": ("elbow", "wrist"), "legs": ("knee", "ankle", "foot")}.items()
}
"""Groups of joints whose sides are exchanged together."""


SWAP_RATE: Mapping[str, float] = {"arms": 0.005, "legs": 0.01}
SWAP_DURATION = 0.15
"""Rate of swaps, 1/s, and their mean duration, seconds. They are assumed: UI-PRMD's people face the camera, and have
one swapped frame in 47 minutes."""

SPREAD_SPEED = 0.2
"""Speed at which the spread of the fast noise is midway between a joint at rest and one in motion, m/s."""

FASTEST = 1.0
"""Speed above which the noise does not grow, m/s; the recordings contain too little faster motion for a fit."""

LONGEST_JUMP = 1.2  # longest jump, metres; a joint farther away would not be assigned to the body


@dataclass(frozen=True)
class NoiseModel:
    """Parameters, in SI units. Axes are along the ray, to its right, up."""

    offset: Floats  # (22, 3) metres, standard deviation of the session's offset
    bias: Floats  # (22, 3) metres, standard deviation of the drifting bias (median of its log-normal spread)
    bias_length: float  # metres of travel over which the bias decays (1/e)
    bias_inertia: float  # seconds by which the bias lags, so that it does not shake a fast joint
    session_spread: float
    """standard deviation of the logarithm of a joint's error scale in a session. Offset, bias and fast noise are
    proportional to this scale, the rate of jumps to its square"""
    fast: Floats  # (22, 3) metres, standard deviation of the fast noise at 0.3 m/s (median over its spread)
    fast_memory: float  # seconds, correlation time of the fast noise
    speed_floor: float  # m/s, speed below which the fast noise is constant
    speed_exponent: Floats  # (22,) exponent; the fast noise is proportional to (speed_floor + speed) to this power
    fast_spread_still: float  # standard deviation of the logarithm of the fast noise's size for a joint at rest
    fast_spread_moving: float  # the same for speeds well above `SPREAD_SPEED`
    fast_spread_memory: float  # seconds, correlation time of that size
    shared: float  # share of the variance of bias and fast noise that all joints have in common
    jump_rate: Floats  # (22,) 1/s, rate of jumps
    jump_minimum: float  # metres, length of the shortest jumps
    jump_tail: float  # exponent of the Pareto distribution of their lengths
    jump_short: float  # seconds, mean duration of a short jump
    jump_long: float  # seconds, mean duration of a long jump
    jump_short_share: float  # share of short jumps

    @classmethod
    def load(cls, path: Path = KINECT_NOISE) -> NoiseModel:
        """Read the ``parameters`` of a JSON file such as `KINECT_NOISE`.

        Raises:
            ValueError: the file lacks a parameter or has an unknown one.
        """
        parameters = json.loads(path.read_text())["parameters"]
        names = {f.name for f in fields(cls)}
        if set(parameters) != names:
            raise ValueError(f"{path}: expected parameters {sorted(names)}, got {sorted(parameters)}")
        arrays: dict[str, Any] = {k: np.array(v) if isinstance(v, list) else v for k, v in parameters.items()}
        return cls(**arrays)


@dataclass(frozen=True)
class Errors:
    """A sample of the process."""

    steady: Floats  # (..., T, 22, 3) metres along the ray, to its right, up: offset and bias
    quick: Floats  # (..., T, 22, 3) metres, fast noise and jumps, which grow with the distance from the camera
    scale: Floats
    """(..., T, 22) metres, the error that a tracker could estimate: the fast noise's scale, half of a jump, and a tenth
    of the steady error"""


def draw_errors(travel: Floats, dt: Floats, rng: np.random.Generator, model: NoiseModel) -> Errors:
    """Sample the errors of a tracker, except for swaps, from the stationary distribution, by the metres (..., T, 22)
    that each joint moved in the last ``dt`` (T,) seconds; the first ``dt`` is only used for the joints' speed."""
    joint = (*travel.shape, 1)
    vector = (*travel.shape, 3)
    time = dt[:, None, None]
    once = (*travel.shape[:-2], 1, travel.shape[-1], 1)

    # all errors are larger in some sessions, and for some joints in them
    size = np.exp(model.session_spread * _bounded(_with_shared(rng, once, 0.5)))
    offset = size * model.offset * _with_shared(rng, (*once[:-1], 3), model.shared)
    wander = _recursion(np.exp(-travel[..., None] / model.bias_length), _with_shared(rng, vector, model.shared))
    follow = np.exp(-time / model.bias_inertia)
    bias = size * model.bias * _recursion(follow, wander, 1 - follow)

    speed = np.minimum(travel[..., None] / time, FASTEST)
    ease = ((model.speed_floor + speed) / (model.speed_floor + 0.3)) ** model.speed_exponent[:, None]
    swing = _recursion(np.exp(-time / model.fast_spread_memory), _with_shared(rng, joint, 0.5))
    moving = speed / (speed + SPREAD_SPEED)
    spread = model.fast_spread_still + (model.fast_spread_moving - model.fast_spread_still) * moving
    level = size * ease * np.exp(spread * _bounded(swing))
    white = _with_shared(rng, vector, model.shared)
    fast = level * model.fast * _recursion(np.exp(-time / model.fast_memory), white)

    often = size[..., 0, :, 0] ** 2
    jump = _jumps(vector, dt, model.jump_rate * often / np.exp(2 * model.session_spread**2), rng, model)
    steady = offset + bias
    knowable = np.hypot(0.5 * np.linalg.norm(jump, axis=-1), 0.1 * np.linalg.norm(steady, axis=-1))
    return Errors(steady, fast + jump, np.hypot(np.linalg.norm(level * model.fast, axis=-1), knowable))


def _bounded(normal: Floats) -> Floats:
    """Clip at two standard deviations, because the data do not show the log-normals' far tails."""
    return np.clip(normal, -2.0, 2.0)


def _with_shared(rng: np.random.Generator, shape: tuple[int, ...], share: float) -> Floats:
    """Standard normal (..., 22, C); all joints have a ``share`` of the variance in common."""
    common = rng.standard_normal((*shape[:-2], 1, shape[-1]))
    return np.sqrt(share) * common + np.sqrt(1 - share) * rng.standard_normal(shape)


def _recursion(decay: Floats, source: Floats, gain: Floats | None = None) -> Floats:
    """x[t] = a x[t-1] + g s[t] along axis -3, from x[0] = s[0].

    The default gain is sqrt(1 - a²), so that white noise of unit variance gives a stationary process of unit variance.
    """
    steps = np.moveaxis(np.broadcast_to(decay, source.shape), -3, 0)
    gains = np.sqrt(1 - steps**2) if gain is None else np.moveaxis(np.broadcast_to(gain, source.shape), -3, 0)
    driven = np.moveaxis(source, -3, 0)
    out = np.empty_like(driven)
    out[0] = driven[0]
    for t in range(1, len(driven)):
        out[t] = steps[t] * out[t - 1] + gains[t] * driven[t]
    return np.moveaxis(out, 0, -3)


def time_correlated(noise: Floats, memory: Floats | float, axis: int = 0) -> Floats:
    """Convert white noise, with frames along ``axis``, to a stationary AR(1) process of the same variance, in place.
    ``memory`` is the correlation from one frame to the next; broadcasts against a frame."""
    frames = np.moveaxis(noise, axis, 0)
    for t in range(1, len(frames)):
        frames[t] = memory * frames[t - 1] + np.sqrt(1.0 - memory**2) * frames[t]
    return noise


def stationary(dt: Floats, memory: float, shape: tuple[int, int], rng: np.random.Generator) -> Floats:
    """Standard normal (T, *shape) with a correlation time of ``memory`` seconds."""
    return _recursion(np.exp(-dt / memory)[:, None, None], rng.standard_normal((len(dt), *shape)))


def _jumps(shape: tuple[int, ...], dt: Floats, rate: Floats, rng: np.random.Generator, model: NoiseModel) -> Floats:
    """Return displacements (..., T, 22, 3) metres by jumps with the rate ``rate`` (..., 22) 1/s; 0 between them."""
    frames = shape[-3]
    state = (*shape[:-3], shape[-2])
    mean_duration = model.jump_short_share * model.jump_short + (1 - model.jump_short_share) * model.jump_long
    busy = rate * mean_duration / (1 + rate * mean_duration)
    displaced, stay = np.zeros((*state, 3)), np.ones(state)
    out = np.empty((frames, *state, 3))
    for t in range(frames):
        # the first frame lies in a jump as often as any frame; long jumps take up more of the time
        chance = busy if t == 0 else 1 - np.exp(-rate * dt[t])
        short = model.jump_short_share * (model.jump_short / mean_duration if t == 0 else 1.0)
        displaced[rng.random(state) > stay ** dt[t]] = 0.0
        begin = rng.random(state) < chance
        new = int(begin.sum())
        if new:
            direction = rng.standard_normal((new, 3))
            direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
            length = np.minimum(model.jump_minimum * (1 - rng.random((new, 1))) ** (-1 / model.jump_tail), LONGEST_JUMP)
            displaced[begin] = direction * length
            mean = np.where(rng.random(new) < short, model.jump_short, model.jump_long)
            stay[begin] = np.exp(-1.0 / mean)
        out[t] = displaced
    return np.moveaxis(out, 0, -3)


def ray_axes(rays: Floats) -> Floats:
    """(..., 3, 3) orthonormal axes of rays (..., 3), world z up. Rows point along the ray, to its right, and up."""
    along = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    right = np.cross(along, [0.0, 0.0, 1.0])
    right /= np.maximum(np.linalg.norm(right, axis=-1, keepdims=True), 1e-9)
    return np.stack([along, right, np.cross(right, along)], axis=-2)


def travelled(positions: Floats) -> Floats:
    """(..., T, 22) metres moved since the last frame; the first frame has the second's value."""
    step = np.linalg.norm(np.diff(positions, axis=-3), axis=-1)
    return np.concatenate([step[..., :1, :], step], axis=-2) if step.shape[-2] else np.zeros(positions.shape[:-1])


def swapped(dt: Floats, rng: np.random.Generator, rate_factor: Floats | float) -> dict[str, Bools]:
    """Return when left and right are exchanged, (T,) for each of `SWAP_GROUPS`.

    ``rate_factor`` (T,) multiplies `SWAP_RATE`, for a body seen from its side.
    """
    result: dict[str, Bools] = {}
    for group in SWAP_GROUPS:
        rate = np.broadcast_to(SWAP_RATE[group] * np.asarray(rate_factor), dt.shape)
        active = np.empty(dt.shape, dtype=bool)
        on = rng.random() < rate[0] * SWAP_DURATION
        for t in range(len(dt)):
            ends = rng.random() < 1 - np.exp(-dt[t] / SWAP_DURATION)
            begins = rng.random() < 1 - np.exp(-rate[t] * dt[t])
            if t:
                on = not ends if on else begins
            active[t] = on
        result[group] = active
    return result


def confidence_of(scale: Floats, rng: np.random.Generator) -> Floats:
    """Return a tracker's confidence. It decreases with ``scale`` (see `Errors`), is 0.5 at 4 cm, and is noisy.

    UI-PRMD has no confidences, so this is assumed and not fitted: it is informative, and sometimes wrong.
    """
    logit = 1.6 * np.log(0.04 / np.maximum(scale, 1e-4)) + 0.8 * rng.standard_normal(scale.shape)
    return 1.0 / (1.0 + np.exp(-logit))
