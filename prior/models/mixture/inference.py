"""The mixture as the live node runs it: bank, features and network compiled, without torch.

Every body is worked on by itself, so that what is found for it does not depend on the others, bit for bit.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from steadypose.prior.models.mixture.bank import (
    DENSITIES,
    EXPERTS,
    FEATURES,
    MEASUREMENT_SIGMA,
    PARENT,
    RAW,
    advance,
    describe,
    forget,
    new_bank,
)
from steadypose.prior.models.mixture.form import COASTING, CORRECTION, LEAST_LOG_SIGMA, MOST_LOG_SIGMA, OUTPUTS, REACH
from steadypose.prior.models.weights_io import load_weights
from steadypose.prior.timing.fixed_lag import Smoothed
from steadypose.prior.timing.rate import FPS

Floats = NDArray[np.float32]


class MixtureSmoother:
    """Smooths the joints of several bodies, each frame answered ``delay`` frames later.

    Attributes:
        delay: frames.
    """

    def __init__(self, delay: int, slots: int, weights: str = "default") -> None:
        """``weights``: a name, as of `load_weights`."""
        if delay < 0:
            raise ValueError(f"mixture: expected a delay of 0 frames or more, got {delay}")
        self.delay = delay
        self._slots = slots
        self._net = _network(weights)
        joints, body = (slots, *self._net.joint.shape), (slots, len(self._net.body_decay))
        shapes = (joints, joints, body, body, (slots, 22, OUTPUTS))
        self._memory = _Memory(*(np.zeros(shape, dtype=np.float32) for shape in shapes))
        self._bank = new_bank(slots, delay)
        self._experts = np.empty((slots, 22, EXPERTS, 3))
        self._features = np.empty((slots, 22, FEATURES), dtype=np.float32)
        self._scale = np.empty(slots)
        self._stamps: list[float] = []
        self._count = 0

    def update(
        self, positions: NDArray[np.float64], stamp_s: float, confidence: NDArray[np.float64] | None = None
    ) -> Smoothed | None:
        """Take a frame; give the estimate of the frame ``delay`` before it, or None while there is none.

        Args:
            positions: (S, 22, 3) metres, world-aligned with z up, NaN where unseen.
            stamp_s: seconds of capture, increasing.
            confidence: (S, 22) 0 to 1; 1 if left out.
        """
        if self._stamps and stamp_s <= self._stamps[-1]:
            raise ValueError(f"mixture: expected a stamp after {self._stamps[-1]} s, got {stamp_s} s")
        step = stamp_s - self._stamps[-1] if self._stamps else 1 / FPS
        trust = np.ones((self._slots, 22)) if confidence is None else confidence
        advance(self._bank, self._count, step, positions, trust, DENSITIES, MEASUREMENT_SIGMA)
        self._count += 1
        self._stamps = [*self._stamps[-self.delay :], stamp_s] if self.delay else [stamp_s]
        return self._answer(self.delay) if self._count > self.delay else None

    def flush(self) -> list[Smoothed]:
        """Give the estimates still held, oldest first, and start afresh."""
        held = [self._answer(back) for back in reversed(range(min(self.delay, self._count)))]
        self.forget(np.ones(self._slots, dtype=bool))
        self._stamps, self._count = [], 0
        return held

    def forget(self, slot: NDArray[np.bool_]) -> None:
        """Start these slots (S,) afresh; estimates still held of them are lost."""
        forget(self._bank, slot)
        for values in self._memory:
            values[slot] = 0.0

    def _answer(self, back: int) -> Smoothed:
        """The estimate of the frame ``back`` before the newest."""
        bank = self._bank
        describe(bank, self._count, back, PARENT, self._experts, self._features, self._scale)
        places, sigma = np.full((self._slots, 22, 3), np.nan), np.full((self._slots, 22), np.inf)
        unseen = bank.unseen[:, :, (self._count - 1 - back) % (self.delay + 1)]
        for slot in np.flatnonzero((unseen >= 0).any(axis=1)):
            outputs = _outputs(self._features[slot], self._net, self._memory, slot)
            heading, scale = bank.heading[slot], self._scale[slot]
            _mixed(outputs, self._experts[slot], heading, scale, unseen[slot], places[slot], sigma[slot])
        return Smoothed(self._stamps[-1 - back], places, sigma)


class _Network(NamedTuple):
    """A trained `MixtureNet`: weights (in, out) and biases, float32; those that are added to the
    same are added up."""

    mean: Floats
    per_deviation: Floats
    read: Floats
    joint: Floats
    own_decay: Floats
    gather: Floats
    gather_bias: Floats
    body_decay: Floats
    remember: Floats
    remember_bias: Floats
    think: Floats
    think_bias: Floats
    tell: Floats
    tell_bias: Floats
    mix: Floats
    joint_mix: Floats
    deepen: Floats
    deepen_bias: Floats
    write: Floats
    write_bias: Floats


class _Memory(NamedTuple):
    """What the network remembers of S bodies: sums with fading weights, and the weights' sums, of joints' features
    (S, 22, own) and of bodies' (S, body); and what it wrote last (S, 22, OUTPUTS)."""

    own: Floats
    own_weight: Floats
    body: Floats
    body_weight: Floats
    written: Floats


@cache
def _network(name: str) -> _Network:
    arrays, _ = load_weights(name, "mixture")

    def weight(layer: str) -> Floats:
        return np.ascontiguousarray(arrays[f"{layer}.weight"].T)

    def bias(layer: str) -> Floats:
        return arrays[f"{layer}.bias"]

    def decay(layer: str) -> Floats:
        return (1.0 / (1.0 + np.exp(-arrays[f"{layer}.decay"]))).astype(np.float32)

    return _Network(
        arrays["mean"], (1.0 / arrays["deviation"]).astype(np.float32),
        weight("read"), bias("read") + arrays["joint"], decay("own_memory"),
        weight("gather"), bias("gather"), decay("body_memory"),
        weight("remember"), bias("remember"), weight("think"), bias("think"), weight("tell"), bias("tell"),
        weight("mix"), bias("mix") + arrays["joint_mix"], weight("deepen"), bias("deepen"),
        weight("write"), bias("write"),
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def _outputs(features, net, memory, slot):
    """(22, OUTPUTS) of one body's features (22, FEATURES), as `prior.models.mixture.network.MixtureNet` has them."""
    zero, one = np.float32(0), np.float32(1)
    told = (features - net.mean) * net.per_deviation
    own = np.maximum(np.dot(told, net.read) + net.joint, zero)
    started = memory.body_weight[slot, 0] > zero
    kept, weight = memory.own[slot], memory.own_weight[slot]
    kept[:] = net.own_decay * kept + (one - net.own_decay) * own
    weight[:] = net.own_decay * weight + (one - net.own_decay)
    before = kept / weight
    body = np.maximum(np.dot(own.ravel(), net.gather) + net.gather_bias, zero)
    lasting, weighed = memory.body[slot], memory.body_weight[slot]
    lasting[:] = net.body_decay * lasting + (one - net.body_decay) * body
    weighed[:] = net.body_decay * weighed + (one - net.body_decay)
    body = body + np.maximum(np.dot(lasting / weighed, net.remember) + net.remember_bias, zero)
    body = body + np.maximum(np.dot(body, net.think) + net.think_bias, zero)
    context = (np.dot(body, net.tell) + net.tell_bias).reshape(len(own), -1)
    mixed = np.maximum(np.dot(np.concatenate((told, before, context), axis=1), net.mix) + net.joint_mix, zero)
    mixed = mixed + np.maximum(np.dot(mixed, net.deepen) + net.deepen_bias, zero)
    new, written = np.dot(mixed, net.write) + net.write_bias, memory.written[slot]
    for j in range(len(written)):
        for k in range(OUTPUTS):
            gate = OUTPUTS if k < 2 * EXPERTS else OUTPUTS + 1 if k < OUTPUTS - 1 else OUTPUTS + 2
            leaning = one / (one + np.exp(-new[j, gate])) if started else zero
            written[j, k] = leaning * written[j, k] + (one - leaning) * new[j, k]
    return written


@njit(cache=True, error_model="numpy")
def _mixed(outputs, experts, heading, scale, unseen, places, sigma):
    """As `prior.models.mixture.network.answer`, of one body; of joints never seen, nothing is written."""
    cos, sin = heading
    weights, reach = np.empty(EXPERTS), np.empty(EXPERTS)
    for j in range(len(outputs)):
        if unseen[j] < 0:
            continue
        out = outputs[j].astype(np.float64)
        weights[:] = np.exp(out[:EXPERTS] - out[:EXPERTS].max())
        weights /= weights.sum()
        free = 1.0 - weights[RAW]
        reach[:] = REACH * np.tanh(out[EXPERTS : 2 * EXPERTS])
        weights += free * (reach - reach.mean())
        moved = CORRECTION * np.tanh(out[2 * EXPERTS : 2 * EXPERTS + 3] / CORRECTION) * free * scale
        places[j, 0] = cos * moved[0] - sin * moved[1]
        places[j, 1] = sin * moved[0] + cos * moved[1]
        places[j, 2] = moved[2]
        for axis in range(3):
            came = experts[j, RAW, axis]
            for m in range(RAW):
                places[j, axis] += weights[m] * (experts[j, m, axis] - came)
            places[j, axis] += came
        log_sigma = min(max(out[2 * EXPERTS + 3], LEAST_LOG_SIGMA), MOST_LOG_SIGMA)
        coasted = COASTING / FPS * unseen[j]
        sigma[j] = np.sqrt((1e-3 * np.exp(log_sigma)) ** 2 + coasted**2)
