"""HG-VAE as the live node runs it: one window at a time, forward and the gradient of its score by its latents.

A model of this size is all overhead in torch: 250 small operations and their gradients take ten times as long as their
arithmetic. Here the network is written down once as a list of a few kinds of steps on matrices, which compiled loops
run forwards and backwards. The same numbers as `HGVAE` with the means of its latents.
"""

from __future__ import annotations

import math
from copy import copy
from typing import NamedTuple

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor, nn

from prior.body_tracks import hang_unseen
from prior.hgvae import HGVAE, JOINT_NODES, LOG_VAR_RANGE, SCALE, TRACK_LOG_VAR, GraphBlock, GraphLinear

Floats = NDArray[np.float32]

# Steps: the kind, the matrix written, one or two matrices read, and where in the weights their numbers begin.
_LINEAR, _GELU, _ADD, _JOIN, _TAKE, _DENSITY = range(6)
_FIELDS = 6
_NONE = -1


class _Program:
    """A network written down: steps, the shapes of the matrices they work on, and all weights in one row."""

    def __init__(self) -> None:
        self.steps: list[list[int]] = []
        self.shapes: list[tuple[int, int]] = []
        self.weights: list[Floats] = []
        self._used = 0

    def matrix(self, nodes: int, features: int) -> int:
        """A new matrix's number."""
        self.shapes.append((nodes, features))
        return len(self.shapes) - 1

    def _store(self, values: Tensor) -> int:
        row = np.ascontiguousarray(values.detach().numpy(), dtype=np.float32).ravel()
        self.weights.append(row)
        self._used += len(row)
        return self._used - len(row)

    def _step(self, kind: int, out: int, *fields: int) -> int:
        self.steps.append([kind, out, *fields, *[_NONE] * (_FIELDS - 2 - len(fields))])
        return out

    def linear(self, of: int, weight: Tensor, bias: Tensor | None = None, adjacency: Tensor | None = None) -> int:
        """``adjacency @ of @ weight + bias``; without an adjacency, nodes stay by themselves."""
        nodes = self.shapes[of][0] if adjacency is None else len(adjacency)
        out = self.matrix(nodes, weight.shape[1])
        if bias is None:
            bias = torch.zeros(weight.shape[1])
        stored = _NONE if adjacency is None else self._store(adjacency)
        return self._step(_LINEAR, out, of, self._store(weight), self._store(bias.expand(nodes, -1)), stored)

    def layer(self, of: int, layer: nn.Module) -> int:
        """A `GraphLinear`, a linear layer of each node by itself, or nothing."""
        if isinstance(layer, GraphLinear):
            return self.linear(of, layer.weight, layer.bias, layer.adjacency)
        if isinstance(layer, nn.Linear):
            return self.linear(of, layer.weight.T, layer.bias)
        return of

    def block(self, of: int, block: GraphBlock) -> int:
        """A graph convolutional block, equation 5."""
        inner = self.gelu(self.layer(self.gelu(self.layer(of, block.first)), block.second))
        return self.add(of, inner, block.alpha)

    def gelu(self, of: int) -> int:
        return self._step(_GELU, self.matrix(*self.shapes[of]), of)

    def add(self, of: int, other: int, times: Tensor) -> int:
        """``of + times * other``."""
        return self._step(_ADD, self.matrix(*self.shapes[of]), of, other, self._store(times.reshape(1)))

    def join(self, of: int, other: int) -> int:
        """Features side by side."""
        nodes, features = self.shapes[of]
        return self._step(_JOIN, self.matrix(nodes, features + self.shapes[other][1]), of, other)

    def take(self, of: int, first: int, count: int) -> int:
        """Some of the features."""
        return self._step(_TAKE, self.matrix(self.shapes[of][0], count), of, first)

    def density(self, of: int, mean: int, log_var: int) -> int:
        """The logarithm of a normal density, entry by entry; ``log_var`` is clamped to `LOG_VAR_RANGE`."""
        return self._step(_DENSITY, self.matrix(*self.shapes[of]), of, mean, log_var)

    def constant(self, values: Tensor) -> int:
        """A matrix of weights that depends on nothing: a linear step from nothing."""
        zero = self.matrix(1, 1)
        return self.linear(zero, torch.zeros(1, values.shape[1]), values, torch.zeros(len(values), 1))


class Look(NamedTuple):
    """What the model makes of one window.

    Attributes:
        mean: (66, T) metres of a standard body, the tracks that the model would put there.
        sigma: (66, T) metres, standard deviation.
        score: nats: sum over all levels of log p(z | above), the score of section 7, and of what was observed,
            weighted, log p(x | z).
    """

    mean: NDArray[np.float64]
    sigma: NDArray[np.float64]
    score: float


class LiveHGVAE:
    """A trained `HGVAE` with the means of its latents, which may be moved.

    Args:
        model: whose weights are copied; without actions.
        sensor_sigma: metres, standard deviation of an observation.

    Attributes:
        frames: T, of a window.
        latents: how many numbers all latents together are.
    """

    def __init__(self, model: HGVAE, sensor_sigma: float) -> None:
        config, p = model.config, _Program()
        self.frames, self._mean = config.frames, model.mean.numpy().astype(np.float64)[:, None]
        self._x = p.matrix(JOINT_NODES, config.frames)
        self._observed = p.matrix(JOINT_NODES, config.frames)
        coefficients = p.linear(self._x, model.dct.T)
        graph = p.block(p.gelu(p.layer(p.join(coefficients, self._observed), model.read)), model.read_block)
        found = []
        for up, block in model.encoder_levels:
            graph = p.block(p.layer(graph, up), block)
            found.append(graph)
        encoder_steps = len(p.steps)
        stream = p.constant(model.start)
        self._moves, self._terms = [], []
        one = torch.ones(())
        for level, seen in zip(model.decoder_levels, reversed(found), strict=True):
            latent = level.level.latent
            above = p.layer(stream, level.contract)
            if level.top:
                prior = p.constant(torch.zeros(level.level.nodes, 2 * latent))
            else:
                prior = p.layer(p.block(above, level.prior_block), level.prior_head)
            joined = p.layer(p.join(above, seen), level.join)
            mean = p.take(p.layer(p.block(joined, level.posterior_block), level.posterior_head), 0, latent)
            self._moves.append(p.matrix(level.level.nodes, latent))
            z = p.add(mean, self._moves[-1], one)
            self._terms.append(p.density(z, p.take(prior, 0, latent), p.take(prior, latent, latent)))
            stream = p.block(p.add(stream, p.layer(z, level.expand), one), level.block)
        written = p.layer(p.block(stream, model.last_block), model.write)
        kept = config.coefficients
        shift = torch.full((config.frames,), TRACK_LOG_VAR)
        self._tracks = p.linear(p.take(written, 0, kept), model.dct)
        self._log_var = p.linear(p.take(written, kept, kept), model.dct, shift)
        steps = np.array(p.steps, dtype=np.int64)
        self._encoder, self._decoder = steps[:encoder_steps], steps[encoder_steps:]
        self._shapes = np.array(p.shapes, dtype=np.int64)
        sizes = self._shapes.prod(axis=1)
        self._starts = np.concatenate([[0], np.cumsum(sizes)])
        self._weights = np.concatenate(p.weights)
        self._values = np.zeros(self._starts[-1], dtype=np.float32)
        self._gradients = np.zeros_like(self._values)
        self._sensor_variance = (sensor_sigma / SCALE) ** 2
        self._trust = np.zeros((JOINT_NODES, config.frames), dtype=np.float32)
        self.latents = int(sizes[self._moves].sum())

    def another(self) -> LiveHGVAE:
        """The same model for another body: the window last looked at is each one's own."""
        other = copy(self)
        other._values, other._gradients = self._values.copy(), self._gradients.copy()
        return other

    def _matrix(self, arena: Floats, number: int) -> Floats:
        return arena[self._starts[number] : self._starts[number + 1]].reshape(self._shapes[number])

    def look(self, x: NDArray[np.float64], observed: NDArray[np.float64]) -> Look:
        """Encode and decode one window.

        Args:
            x: (66, T) metres of a standard body; see `prior.body_tracks`. NaN for a joint never seen.
            observed: (66, T) how far to believe each entry: 0 where there was none, at most 1.
        """
        deviations = (x - self._mean) / SCALE
        if np.isnan(deviations[:, 0]).any():
            hang_unseen(deviations)
        self._matrix(self._values, self._x)[:] = deviations
        self._matrix(self._values, self._observed)[:] = observed > 0
        self._trust = observed.astype(np.float32)
        _forward(self._encoder, self._shapes, self._starts, self._weights, self._values)
        return self.decode(np.zeros(self.latents))

    def decode(self, moved: NDArray[np.float64]) -> Look:
        """Decode the window last looked at, its latents (n,) moved from where the encoder puts them."""
        begin = 0
        for number in self._moves:
            matrix = self._matrix(self._values, number)
            matrix[:] = moved[begin : begin + matrix.size].reshape(matrix.shape)
            begin += matrix.size
        _forward(self._decoder, self._shapes, self._starts, self._weights, self._values)
        own = self._variance()
        variance = own + self._sensor_variance
        off = self._matrix(self._values, self._x) - self._matrix(self._values, self._tracks)
        likelihood = -0.5 * self._trust * (np.log(2 * np.pi * variance) + off**2 / variance)
        return Look(
            mean=self._matrix(self._values, self._tracks) * SCALE + self._mean,
            sigma=np.sqrt(own.astype(np.float64)) * SCALE,
            score=float(likelihood.sum()) + sum(float(self._matrix(self._values, k).sum()) for k in self._terms),
        )

    def _variance(self) -> Floats:
        """(66, T) of the tracks, in units of `SCALE`, as the model states it."""
        return np.exp(np.clip(self._matrix(self._values, self._log_var), *LOG_VAR_RANGE))

    def gradient(self) -> NDArray[np.float64]:
        """(n,) gradient of the score last decoded by how far the latents were moved."""
        self._gradients[:] = 0.0
        for number in self._terms:
            self._matrix(self._gradients, number)[:] = 1.0
        own, log_var = self._variance(), self._matrix(self._values, self._log_var)
        variance = own + self._sensor_variance
        off = (self._matrix(self._values, self._x) - self._matrix(self._values, self._tracks)) / variance
        within = (log_var > LOG_VAR_RANGE[0]) & (log_var < LOG_VAR_RANGE[1])
        self._matrix(self._gradients, self._tracks)[:] = self._trust * off
        self._matrix(self._gradients, self._log_var)[:] = 0.5 * self._trust * within * own * (off**2 - 1 / variance)
        _backward(self._decoder, self._shapes, self._starts, self._weights, self._values, self._gradients)
        return np.concatenate([self._matrix(self._gradients, k).ravel() for k in self._moves]).astype(np.float64)


# ---------------------------------------------------------------------------------------------------------------
# The steps, compiled. The types of all five arguments are those of LiveHGVAE's attributes.

# Abramowitz and Stegun 7.1.28: erf within 3e-7 without an exponential, which compilers turn into vector instructions.
_ERF = tuple(
    np.array([0.0705230784, 0.0422820123, 0.0092705272, 0.0001520143, 0.0002765672, 0.0000430638], dtype=np.float32)
)
_ROOT_HALF = np.float32(math.sqrt(0.5))
_LOG_2PI = math.log(2 * math.pi)
_LEAST, _MOST = LOG_VAR_RANGE


@njit(cache=True, fastmath=True, error_model="numpy")
def _gelu(values, out):
    """``x * Phi(x)`` of a row, Phi being the normal distribution's."""
    half, one = np.float32(0.5), np.float32(1)
    a, b, c, d, e, f = _ERF
    for k in range(len(values)):
        x = values[k]
        u = abs(x) * _ROOT_HALF
        p = one + u * (a + u * (b + u * (c + u * (d + u * (e + u * f)))))
        q = one / (p * p)
        q = q * q
        q = q * q
        out[k] = half * (x + abs(x) * (one - q * q))


@njit(cache=True, fastmath=True, error_model="numpy")
def _by_gelu(values, by_out, by_values):
    """Add the gradient by the row that went into `_gelu`: that of the same approximation."""
    zero, half, one, eight = np.float32(0), np.float32(0.5), np.float32(1), np.float32(8)
    two, three, four, five, six = np.float32(2), np.float32(3), np.float32(4), np.float32(5), np.float32(6)
    a, b, c, d, e, f = _ERF
    for k in range(len(values)):
        x = values[k]
        u = abs(x) * _ROOT_HALF
        p = one + u * (a + u * (b + u * (c + u * (d + u * (e + u * f)))))
        slope = a + u * (two * b + u * (three * c + u * (four * d + u * (five * e + u * six * f))))
        q = one / (p * p)
        q = q * q
        q = q * q
        q = q * q
        sign = np.float32(x > zero) - np.float32(x < zero)
        cdf = half * (one + sign * (one - q))
        by_values[k] += by_out[k] * (cdf + eight * _ROOT_HALF * x * slope * q / p)


@njit(cache=True, fastmath=True, error_model="numpy")
def _add(values, factor, out):
    for k in range(len(values)):
        out[k] += factor * values[k]


@njit(cache=True)
def _view(arena, shapes, starts, number):
    return arena[starts[number] : starts[number + 1]].reshape(shapes[number, 0], shapes[number, 1])


@njit(cache=True)
def _forward(steps, shapes, starts, weights, values):
    for kind, number, first, second, third, fourth in steps:
        out = _view(values, shapes, starts, number)
        a = _view(values, shapes, starts, first)
        nodes, features = out.shape
        if kind == _LINEAR:
            weight = weights[second : second + a.shape[1] * features].reshape(a.shape[1], features)
            bias = weights[third : third + nodes * features].reshape(nodes, features)
            if fourth < 0:
                np.dot(a, weight, out)
            else:
                adjacency = weights[fourth : fourth + nodes * len(a)].reshape(nodes, len(a))
                if nodes < len(a):
                    np.dot(np.dot(adjacency, a), weight, out)
                else:
                    np.dot(adjacency, np.dot(a, weight), out)
            out += bias
        elif kind == _GELU:
            _gelu(a.ravel(), out.ravel())
        elif kind == _ADD:
            out[:] = a
            _add(_view(values, shapes, starts, second).ravel(), weights[third], out.ravel())
        elif kind == _JOIN:
            b = _view(values, shapes, starts, second)
            out[:, : a.shape[1]] = a
            out[:, a.shape[1] :] = b
        elif kind == _TAKE:
            out[:] = a[:, second : second + features]
        else:
            mean = _view(values, shapes, starts, second)
            log_var = _view(values, shapes, starts, third)
            for i in range(nodes):
                for j in range(features):
                    clamped = min(max(log_var[i, j], _LEAST), _MOST)
                    off = a[i, j] - mean[i, j]
                    out[i, j] = -0.5 * (clamped + _LOG_2PI + off * off * math.exp(-clamped))


@njit(cache=True)
def _backward(steps, shapes, starts, weights, values, gradients):
    for k in range(len(steps) - 1, -1, -1):
        kind, number, first, second, third, fourth = steps[k]
        by_out = _view(gradients, shapes, starts, number)
        a, by_a = _view(values, shapes, starts, first), _view(gradients, shapes, starts, first)
        nodes, features = by_out.shape
        if kind == _LINEAR:
            weight = weights[second : second + a.shape[1] * features].reshape(a.shape[1], features)
            if fourth < 0:
                by_a += np.dot(by_out, weight.T)
            else:
                adjacency = weights[fourth : fourth + nodes * len(a)].reshape(nodes, len(a))
                if nodes < len(a):
                    by_a += np.dot(adjacency.T, np.dot(by_out, weight.T))
                else:
                    by_a += np.dot(np.dot(adjacency.T, by_out), weight.T)
        elif kind == _GELU:
            _by_gelu(a.ravel(), by_out.ravel(), by_a.ravel())
        elif kind == _ADD:
            _add(by_out.ravel(), np.float32(1), by_a.ravel())
            _add(by_out.ravel(), weights[third], _view(gradients, shapes, starts, second).ravel())
        elif kind == _JOIN:
            by_b = _view(gradients, shapes, starts, second)
            by_a += by_out[:, : a.shape[1]]
            by_b += by_out[:, a.shape[1] :]
        elif kind == _TAKE:
            by_a[:, second : second + features] += by_out
        else:
            mean, by_mean = _view(values, shapes, starts, second), _view(gradients, shapes, starts, second)
            log_var, by_log_var = _view(values, shapes, starts, third), _view(gradients, shapes, starts, third)
            for i in range(nodes):
                for j in range(features):
                    clamped = min(max(log_var[i, j], _LEAST), _MOST)
                    off = (a[i, j] - mean[i, j]) * math.exp(-clamped)
                    by_a[i, j] -= by_out[i, j] * off
                    by_mean[i, j] += by_out[i, j] * off
                    if _LEAST < log_var[i, j] < _MOST:
                        by_log_var[i, j] += by_out[i, j] * 0.5 * (off * (a[i, j] - mean[i, j]) - 1.0)
