"""Live inference of the mixture: compiled bank, features and network, without torch.

Each body is processed separately, so its results do not depend on other bodies, bit for bit.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from steadypose.prior.arrays import Bools, Floats, Floats32
from steadypose.prior.compiled import njit
from steadypose.prior.models.matmul import multiply_packed, packed
from steadypose.prior.models.mixture.bank import (
    DENSITIES,
    EXPERTS,
    MEASUREMENT_SIGMA,
    MULTIPLE_MODEL,
    RAW,
    advance,
    forget,
    new_bank,
)
from steadypose.prior.models.mixture.features import (
    COASTING,
    CORRECTION,
    FEATURES,
    MAX_LOG_SIGMA,
    MIN_LOG_SIGMA,
    OUTPUTS,
    PARENT,
    REACH,
    SHARED,
    describe,
    write_experts,
)
from steadypose.prior.models.mixture.tracks import body_covariance
from steadypose.prior.models.mixture.whiteness import Whiteness, fallback
from steadypose.prior.models.weights import load_weights
from steadypose.prior.timing.kalman import Smoothed
from steadypose.prior.timing.rate import FPS


class MixtureSmoother:
    """Fixed-lag smoother of the joints of several bodies: `MixtureNet` over a `Bank`.

    Attributes:
        delay: look-ahead, frames.
        white: (S,) share of each body's noise that is white, estimated up to the newest frame.
        correlated: (S,) certainty that this noise is time-correlated, 0 to 1.
    """

    def __init__(self, delay: int, slots: int, weights: str = "default") -> None:
        """``weights`` is a weight set or a path, as in `load_weights`."""
        self.delay = delay
        self._slots = slots
        self._net = _network(weights)
        joints, body = (slots, *self._net.joint.shape), (slots, len(self._net.body_decay))
        shapes = (joints, joints, body, body, (slots, 22, OUTPUTS))
        self._memory = _Memory(*(np.zeros(shape, dtype=np.float32) for shape in shapes))
        self._bank = new_bank(slots, delay)
        self._whiteness = Whiteness(slots, delay)
        self.white, self.correlated = np.zeros(slots), self._whiteness.correlated
        self._covariance = body_covariance()
        self._experts = np.empty((slots, 22, EXPERTS, 3))
        self._features = np.empty((slots, 22, FEATURES), dtype=np.float32)
        self._scale, self._gap, self._between = np.empty(slots), np.empty((slots, 22)), np.empty((slots, 22))
        self._stamps: list[float] = []
        self._count = 0

    def update(self, positions: Floats, stamp_s: float, confidence: Floats | None = None) -> Smoothed | None:
        """Process a frame (S, 22, 3) metres, world-aligned with z up, NaN where unobserved, of an increasing stamp in
        seconds, and return the estimate of the frame ``delay`` earlier, or None if there is none yet. ``confidence``
        (S, 22) is 1 if omitted."""
        step = stamp_s - self._stamps[-1] if self._stamps else 1 / FPS
        certainty = np.ones((self._slots, 22)) if confidence is None else confidence
        self._note(stamp_s)
        self.white, self.correlated = self._whiteness.share(positions), self._whiteness.correlated
        advance(self._bank, self._count - 1, step, positions, certainty, DENSITIES, MEASUREMENT_SIGMA, self._covariance)
        return self._output(self.delay) if self._count > self.delay else None

    def skip(self, stamp_s: float) -> float:
        """Process a frame without bodies after ``delay`` such frames; return the stamp of the first of these."""
        self._note(stamp_s)
        return self._stamps[0]

    def _note(self, stamp_s: float) -> None:
        if self._stamps and stamp_s <= self._stamps[-1]:
            raise ValueError(f"mixture: expected a stamp after {self._stamps[-1]} s, got {stamp_s} s")
        self._count += 1
        self._stamps = [*self._stamps[-self.delay :], stamp_s] if self.delay else [stamp_s]

    def flush(self) -> list[Smoothed]:
        """Return the estimates that the delay still holds, oldest first, and forget everything."""
        held = [self._output(back) for back in reversed(range(min(self.delay, self._count)))]
        self.forget(np.ones(self._slots, dtype=bool))
        self._stamps, self._count = [], 0
        return held

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,), including the estimates that the delay still holds."""
        forget(self._bank, slot)
        self._whiteness.forget(slot)
        for values in self._memory:
            values[slot] = 0.0

    def _output(self, back: int) -> Smoothed:
        """Return the estimate of the frame ``back`` frames before the newest."""
        bank = self._bank
        described = self._experts, self._features, self._scale, self._gap, self._between
        describe(bank, self._count, back, PARENT, self.white, *described)
        share = fallback(self.white, self._scale, self.delay)
        places, sigma = np.full((self._slots, 22, 3), np.nan), np.full((self._slots, 22), np.inf)
        following = np.full_like(places, np.nan)
        slots = np.flatnonzero((self._gap >= 0).any(axis=1))
        if len(slots):
            _write_outputs(slots, self._features, self._net, self._memory)
        for slot in slots:
            outputs = self._memory.written[slot]
            frame = bank.heading[slot], self._scale[slot], self._gap[slot], self._between[slot], share[slot]
            _mixed(outputs, self._experts[slot], *frame, places[slot], sigma[slot])
            if back:
                _write_next(bank, slot, self._count, back, self.white[slot], self._experts[slot])
                _mixed(outputs, self._experts[slot], *frame, following[slot], np.empty(22))
        return Smoothed(self._stamps[-1 - back], places, sigma, following - places if back else None)


class _Network(NamedTuple):
    """A trained `MixtureNet`: float32 weights, `packed`, and biases (rows, out). Biases of the same sum are merged."""

    mean: Floats32
    per_deviation: Floats32
    read: Floats32
    joint: Floats32
    own_decay: Floats32
    gather: Floats32
    gather_bias: Floats32
    body_decay: Floats32
    remember: Floats32
    remember_bias: Floats32
    think: Floats32
    think_bias: Floats32
    tell: Floats32
    tell_bias: Floats32
    mix: Floats32
    joint_mix: Floats32
    deepen: Floats32
    deepen_bias: Floats32
    write: Floats32
    write_bias: Floats32


class _Memory(NamedTuple):
    """Recurrent state of S bodies: sums of `Memory` and their weights, and the last outputs."""

    own: Floats32  # (S, 22, own)
    own_weight: Floats32
    body: Floats32  # (S, body)
    body_weight: Floats32
    written: Floats32  # (S, 22, OUTPUTS)


@cache
def _network(name: str) -> _Network:
    arrays, _ = load_weights(name, "mixture")

    def weight(layer: str) -> Floats32:
        return packed(arrays[f"{layer}.weight"].T)

    def bias(layer: str, rows: int = 1) -> Floats32:
        return np.tile(arrays[f"{layer}.bias"], (rows, 1))

    def decay(layer: str) -> Floats32:
        return (1.0 / (1.0 + np.exp(-arrays[f"{layer}.decay"]))).astype(np.float32)

    return _Network(
        arrays["mean"], (1.0 / arrays["deviation"]).astype(np.float32),
        weight("read"), bias("read") + arrays["joint"], decay("own_memory"),
        weight("gather"), bias("gather"), decay("body_memory"),
        weight("remember"), bias("remember"), weight("think"), bias("think"),
        weight("tell"), bias("tell").reshape(22, -1),
        weight("mix"), bias("mix") + arrays["joint_mix"], weight("deepen"), bias("deepen", 22),
        weight("write"), bias("write", 22),
    )  # fmt: skip


@njit(cache=True)
def _write_outputs(slots, features, net, memory):
    """Run `MixtureNet` for a frame of the bodies in these slots: write `_Memory.written` from features (S, 22,
    FEATURES).

    Layers of the whole body, whose weights fill a cache, are run for all bodies at once; others body by body.
    """
    count, joints, zero, one = len(slots), features.shape[1], np.float32(0), np.float32(1)
    normalised = np.empty((count, joints, FEATURES), dtype=np.float32)
    own = np.empty((count, joints, len(net.own_decay)), dtype=np.float32)
    own_before = np.empty_like(own)
    for b in range(count):
        slot = slots[b]
        for j in range(joints):
            for k in range(FEATURES):
                normalised[b, j, k] = (features[slot, j, k] - net.mean[k]) * net.per_deviation[k]
        multiply_packed(normalised[b], net.read, net.joint, own[b])
        _rectify(own[b])
        _remember(own[b], net.own_decay, memory.own[slot], memory.own_weight[slot], own_before[b])
    body = np.empty((count, len(net.body_decay)), dtype=np.float32)
    remembered, summand = np.empty_like(body), np.empty_like(body)
    multiply_packed(own.reshape(count, -1), net.gather, net.gather_bias, body)
    _rectify(body)
    started = np.empty(count, dtype=np.bool_)
    for b in range(count):
        slot, row = slots[b], slice(b, b + 1)
        at = slice(slot, slot + 1)
        started[b] = memory.body_weight[slot, 0] > zero
        _remember(body[row], net.body_decay, memory.body[at], memory.body_weight[at], remembered[row])
    for of, weight, bias in ((remembered, net.remember, net.remember_bias), (body, net.think, net.think_bias)):
        multiply_packed(of, weight, bias, summand)
        _rectify(summand)
        _add(summand, body)
    context = np.empty((count, net.tell_bias.size), dtype=np.float32)
    multiply_packed(body, net.tell, net.tell_bias.reshape(1, -1), context)
    mixed, new = np.empty((joints, net.deepen_bias.shape[1]), dtype=np.float32), np.empty_like(net.write_bias)
    deeper = np.empty_like(mixed)
    for b in range(count):
        multiply_packed(
            _concatenated(normalised[b], own_before[b], context[b].reshape(joints, -1)), net.mix, net.joint_mix, mixed
        )
        _rectify(mixed)
        multiply_packed(mixed, net.deepen, net.deepen_bias, deeper)
        _rectify(deeper)
        _add(deeper, mixed)
        multiply_packed(mixed, net.write, net.write_bias, new)
        written = memory.written[slots[b]]
        for j in range(joints):
            for k in range(OUTPUTS):
                gate = OUTPUTS if k < 2 * EXPERTS else OUTPUTS + 1 if k < OUTPUTS - 1 else OUTPUTS + 2
                leaning = one / (one + np.exp(-new[j, gate])) if started[b] else zero
                written[j, k] = leaning * written[j, k] + (one - leaning) * new[j, k]


# Loops instead of array expressions, because numba takes a second or two to compile each broadcast expression.


@njit(cache=True)
def _rectify(values):
    """Replace negative values (N, F) by 0."""
    for i in range(len(values)):
        for k in range(values.shape[1]):
            values[i, k] = max(values[i, k], np.float32(0))


@njit(cache=True)
def _add(values, out):
    for i in range(len(out)):
        for k in range(out.shape[1]):
            out[i, k] += values[i, k]


@njit(cache=True)
def _remember(values, decay, total, weight, mean):
    """Run one step of `Memory`: update the sums (N, F) of values and of their weights, and write the mean."""
    one = np.float32(1)
    for i in range(len(values)):
        for k in range(values.shape[1]):
            total[i, k] = decay[k] * total[i, k] + (one - decay[k]) * values[i, k]
            weight[i, k] = decay[k] * weight[i, k] + (one - decay[k])
            mean[i, k] = total[i, k] / weight[i, k]


@njit(cache=True)
def _concatenated(a, b, c):
    """Concatenate (N, A), (N, B) and (N, C) to (N, A + B + C)."""
    out = np.empty((len(a), a.shape[1] + b.shape[1] + c.shape[1]), dtype=np.float32)
    for i in range(len(a)):
        for k in range(a.shape[1]):
            out[i, k] = a[i, k]
        for k in range(b.shape[1]):
            out[i, a.shape[1] + k] = b[i, k]
        for k in range(c.shape[1]):
            out[i, a.shape[1] + b.shape[1] + k] = c[i, k]
    return out


@njit(cache=True)
def _write_next(bank, s, count, back, whiteness, experts):
    """Write a body's experts (J, EXPERTS, 3) in the frame after the one ``back`` frames before the newest."""
    slot, joints = (count - back) % bank.position.shape[3], len(experts)
    write_experts(
        bank.position[s, :, :, slot], bank.modes[s], bank.squared_innovations[s], bank.log_variances[s],
        bank.observations[s], bank.raw[s, :, slot], bank.since[s, :, slot], SHARED * whiteness, experts,
        np.empty((joints, len(DENSITIES))), np.empty(joints),
    )  # fmt: skip


@njit(cache=True)
def _mixed(outputs, experts, heading, scale, gap, between, fallback, places, sigma):
    """Compute `training.networks.mixture.estimate` for one body. Joints that were never observed are not written."""
    cos, sin = heading
    weights, reach = np.empty(EXPERTS), np.empty(EXPERTS)
    for j in range(len(outputs)):
        if gap[j] < 0:
            continue
        if between[j] > 0.0:
            for axis in range(3):
                places[j, axis] = experts[j, MULTIPLE_MODEL, axis]
            sigma[j] = between[j]
            continue
        out = outputs[j]
        most = out[0]
        for m in range(1, EXPERTS):
            most = max(most, out[m])
        total = mean = 0.0
        for m in range(EXPERTS):
            weights[m] = np.exp(np.float64(out[m]) - np.float64(most))
            total += weights[m]
            reach[m] = REACH * np.tanh(np.float64(out[EXPERTS + m]))
            mean += reach[m]
        free = 1.0 - weights[RAW] / total
        for m in range(EXPERTS):
            weights[m] = weights[m] / total + free * (reach[m] - mean / EXPERTS)
        moved = free * scale
        x, y, z = (
            CORRECTION * np.tanh(np.float64(out[2 * EXPERTS]) / CORRECTION) * moved,
            CORRECTION * np.tanh(np.float64(out[2 * EXPERTS + 1]) / CORRECTION) * moved,
            CORRECTION * np.tanh(np.float64(out[2 * EXPERTS + 2]) / CORRECTION) * moved,
        )
        places[j, 0] = cos * x - sin * y
        places[j, 1] = sin * x + cos * y
        places[j, 2] = z
        for axis in range(3):
            came = experts[j, RAW, axis]
            for m in range(RAW):
                places[j, axis] += weights[m] * (experts[j, m, axis] - came)
            places[j, axis] += came
            places[j, axis] += fallback * free * (experts[j, MULTIPLE_MODEL, axis] - places[j, axis])
        log_sigma = min(max(np.float64(out[2 * EXPERTS + 3]), MIN_LOG_SIGMA), MAX_LOG_SIGMA)
        coasted = COASTING / FPS * gap[j]
        sigma[j] = np.sqrt((1e-3 * np.exp(log_sigma)) ** 2 + coasted**2)
