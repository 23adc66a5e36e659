"""HG-VAE as the live node runs it: the windows of all bodies, forward, and the gradient of a window's score by its
latents.

A model of this size is all overhead in torch: 250 small operations and their gradients take ten times as long as their
arithmetic. Here the network is written down once as a list of a few kinds of steps on matrices, which compiled loops
run forwards and backwards. The same numbers as `HGVAE` with the means of its latents.

Each step is done for one body after the other: a body's matrices of 66 nodes fit into the processor's first cache,
where their products take half as long a body as those of eight bodies side by side, and a step's weights are still at
hand for the next body. So what is found for a body does not depend on the others, bit for bit.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor, nn

from prior.body_tracks import hang_unseen
from prior.hgvae import HGVAE, JOINT_NODES, LOG_VAR_RANGE, SCALE, TRACK_LOG_VAR, GraphBlock, GraphLinear

Floats = NDArray[np.float32]

# Steps: the kind, the matrix written, that read, and what else the kind needs (see `_do`).
_LINEAR, _GELU, _SUM, _DENSITY = range(4)
_FIELDS = 8
_NONE = -1

_LINE = 16
"""Numbers in a line of the cache. Matrices begin with one: products of those that do not take a seventh longer."""


class _Program:
    """A network written down: steps, the shapes of the matrices they work on, and all weights in one row.

    Steps may write over a matrix. No gradient needs what it held: only what goes into `gelu` and `density` is asked for
    again, and that is never written over.
    """

    def __init__(self) -> None:
        self.steps: list[list[int]] = []
        self.shapes: list[tuple[int, int]] = []
        self.weights: list[Floats] = []
        self._used = 0

    def matrix(self, nodes: int, features: int) -> int:
        """A new matrix's number; zero where no step writes it."""
        self.shapes.append((nodes, features))
        return len(self.shapes) - 1

    def _store(self, values: Tensor) -> int:
        row = np.ascontiguousarray(values.detach().numpy(), dtype=np.float32).ravel()
        self.weights.append(np.pad(row, (0, -len(row) % _LINE)))
        self._used += len(self.weights[-1])
        return self._used - len(self.weights[-1])

    def _step(self, kind: int, out: int, *fields: int) -> int:
        self.steps.append([kind, out, *fields, *[_NONE] * (_FIELDS - 2 - len(fields))])
        return out

    def linear(
        self,
        of: int,
        weight: Tensor,
        bias: Tensor,
        adjacency: Tensor | None = None,
        plus: int = _NONE,
        onto: int = _NONE,
        active: bool = False,
    ) -> int:
        """``adjacency @ of @ weight + bias + plus``; without an adjacency, nodes stay by themselves.

        Args:
            of, weight, bias, adjacency: (n_in, f_in), (f_in, f_out), (f_out) or (n_out, f_out), (n_out, n_in).
            plus: matrix to add.
            onto: matrix to write; a new one if left out.
            active: whether ``of`` goes through a GELU first.
        """
        nodes = self.shapes[of][0] if adjacency is None else len(adjacency)
        out = self.matrix(nodes, weight.shape[1]) if onto == _NONE else onto
        stored = _NONE if adjacency is None else self._store(adjacency)
        shift = self._store(bias.expand(nodes, -1))
        return self._step(_LINEAR, out, of, self._store(weight), shift, stored, plus, int(active))

    def layer(self, of: int, layer: nn.Module, *, plus: int = _NONE, onto: int = _NONE, active: bool = False) -> int:
        """A `GraphLinear`, or nothing."""
        if isinstance(layer, GraphLinear):
            return self.linear(of, layer.weight, layer.bias, layer.adjacency, plus, onto, active)
        return of

    def block(self, of: int, block: GraphBlock, *, onto: int) -> int:
        """A graph convolutional block, equation 5, written to ``onto``, which may be ``of`` itself."""
        inner = self.layer(self.layer(of, block.first), block.second, active=True)
        return self._step(_GELU, onto, inner, self._store(block.alpha.reshape(1)), of)

    def gelu(self, of: int) -> int:
        """Of a matrix, by itself."""
        return self._step(_GELU, self.matrix(*self.shapes[of]), of, self._store(torch.ones(1)), _NONE)

    def sum(self, of: int, other: int) -> int:
        """Of two matrices."""
        return self._step(_SUM, self.matrix(*self.shapes[of]), of, other)

    def density(self, of: int, gaussian: int) -> int:
        """The logarithm of a normal density, summed over all entries.

        ``gaussian`` (n, 2 f) holds means and then log-variances, which are clamped to `LOG_VAR_RANGE`.
        """
        return self._step(_DENSITY, self.matrix(1, 1), of, gaussian)


class Look(NamedTuple):
    """What the model makes of windows.

    Attributes:
        mean: (..., 66, T) metres of a standard body, the tracks that the model would put there.
        sigma: (..., 66, T) metres, standard deviation.
    """

    mean: NDArray[np.float64]
    sigma: NDArray[np.float64]


class LiveHGVAE:
    """A trained `HGVAE` with the means of its latents, which may be moved.

    Args:
        model: whose weights are copied; without actions.
        sensor_sigma: metres, standard deviation of an observation.
        most: windows that can be looked at, at once.

    Attributes:
        frames: T, of a window.
        latents: how many numbers all latents of a window are.
        elsewhere: the row in which `decode` leaves the window that it decoded last.
    """

    def __init__(self, model: HGVAE, sensor_sigma: float, most: int) -> None:
        config, p = model.config, _Program()
        self.frames, self._mean = config.frames, model.mean.numpy().astype(np.float64)[:, None]
        self._x = p.matrix(JOINT_NODES, 2 * config.frames)  # the tracks, and beside them what was observed
        kept = config.coefficients
        weight = torch.cat([model.dct.T @ model.read.weight[:kept], model.read.weight[kept:]])
        graph = p.gelu(p.linear(self._x, weight, model.read.bias, model.read.adjacency))
        p.block(graph, model.read_block, onto=graph)
        # Of a level's joined features, what the encoder has to say: the stream's half of the product comes later.
        features, seen = config.features, []
        for (up, block), level in zip(model.encoder_levels, reversed(model.decoder_levels), strict=True):
            graph = p.layer(graph, up)
            p.block(graph, block, onto=graph)
            seen.append(p.linear(graph, level.join.weight.T[features:], level.join.bias))
        encoder_steps, encoder_matrices = len(p.steps), len(p.shapes)
        stream = p.linear(p.matrix(1, 1), torch.zeros(1, features), model.start, torch.zeros(JOINT_NODES, 1))
        self._moves, self._terms = [], []
        nothing = torch.zeros(1)
        for level, found in zip(model.decoder_levels, reversed(seen), strict=True):
            nodes, latent = level.level
            above = p.layer(stream, level.contract)
            joined = p.linear(above, level.join.weight.T[:features], nothing.expand(features), plus=found)
            p.block(joined, level.posterior_block, onto=joined)
            head = level.posterior_head
            mean = p.linear(joined, head.weight.T[:, :latent], head.bias[:latent])
            if level.top:
                prior = p.matrix(nodes, 2 * latent)
            else:
                before = p.block(above, level.prior_block, onto=p.matrix(nodes, features))
                prior = p.linear(before, level.prior_head.weight.T, level.prior_head.bias)
            self._moves.append(p.matrix(nodes, latent))
            z = p.sum(mean, self._moves[-1])
            self._terms.append(p.density(z, prior))
            p.layer(z, level.expand, plus=stream, onto=stream)
            p.block(stream, level.block, onto=stream)
        p.block(stream, model.last_block, onto=stream)
        # the inverse cosine transform of tracks and log-variances, within the last layer
        weight = torch.cat([part @ model.dct for part in model.write.weight.split(kept, dim=1)], dim=1)
        shift = torch.tensor([0.0, TRACK_LOG_VAR]).repeat_interleave(config.frames)
        bias = torch.cat([part @ model.dct for part in model.write.bias.split(kept, dim=1)], dim=1) + shift
        self._written = p.linear(stream, weight, bias, model.write.adjacency)  # tracks, and their log-variances
        steps = np.array(p.steps, dtype=np.int64)
        self._encoder, self._decoder = steps[:encoder_steps], steps[encoder_steps:]
        self._shapes = np.array(p.shapes, dtype=np.int64)
        sizes = self._shapes.prod(axis=1)
        self._starts = np.concatenate([[0], np.cumsum(-(-sizes // _LINE) * _LINE)])
        ends = self._starts[:-1] + sizes
        self._places = [
            (int(begin), int(end), tuple(shape))
            for begin, end, shape in zip(self._starts, ends, p.shapes, strict=False)
        ]
        self._term_places = self._starts[self._terms]
        self._weights = _zeros(sum(map(len, p.weights)))
        np.concatenate(p.weights, out=self._weights)
        self.elsewhere, self._encoded = most, self._starts[encoder_matrices]
        self._values, self._gradients = _zeros(most + 1, self._starts[-1]), _zeros(self._starts[-1])
        self._scratch = _zeros(3, -(-self._shapes.max(axis=0).prod() // _LINE) * _LINE)
        self._sensor_variance = np.float32((sensor_sigma / SCALE) ** 2)
        self._trust = np.zeros((most + 1, JOINT_NODES, config.frames), dtype=np.float32)
        self.latents = int(sizes[self._moves].sum())

    def look(self, x: NDArray[np.float64], observed: NDArray[np.float64]) -> Look:
        """Encode and decode windows. The model stands at them until it looks again; a window's row is its place here.

        Args:
            x: (B, 66, T) metres of a standard body; see `prior.body_tracks`. NaN for a joint never seen.
            observed: (B, 66, T) how far to believe each entry: 0 where there was none, at most 1.
        """
        rows = slice(0, len(x))
        deviations = (x - self._mean) / SCALE
        hang_unseen(deviations)
        seen = self._matrix(self._x, rows)
        seen[..., : self.frames], seen[..., self.frames :] = deviations, observed > 0
        self._trust[rows] = observed
        for number in self._moves:
            self._matrix(number, rows)[:] = 0.0
        self._run(self._encoder, rows)
        return self._decode(rows)

    def decode(self, row: int, moved: NDArray[np.float64]) -> Look:
        """Decode a window anew in the row `elsewhere`, its latents (n,) moved from where the encoder puts them."""
        rows, begin = slice(self.elsewhere, self.elsewhere + 1), 0
        self._values[rows, : self._encoded] = self._values[row, : self._encoded]
        self._trust[rows] = self._trust[row]
        for number in self._moves:
            matrix = self._matrix(number, rows)
            matrix[:] = moved[begin : begin + matrix.size].reshape(matrix.shape)
            begin += matrix.size
        return Look(*(part[0] for part in self._decode(rows)))

    def score(self, row: int) -> float:
        """Nats, of a window as last decoded: sum over all levels of log p(z | above), the score of section 7, and of
        what was observed, weighted, log p(x | z)."""
        off, log_var = self._off_and_log_var(row)
        variance = np.exp(np.clip(log_var, *LOG_VAR_RANGE)) + self._sensor_variance
        likelihood = -0.5 * self._trust[row] * (np.log(2 * np.pi * variance) + off * off / variance)
        return float(likelihood.sum(dtype=np.float64)) + sum(float(self._values[row, k]) for k in self._term_places)

    def gradient(self, row: int) -> NDArray[np.float64]:
        """(n,) gradient of the score of a window, as last decoded, by how far the latents were moved."""
        self._gradients[:] = 0.0
        self._gradients[self._term_places] = 1.0
        off, log_var = self._off_and_log_var(row)
        own = np.exp(np.clip(log_var, *LOG_VAR_RANGE))
        variance = own + self._sensor_variance
        off /= variance
        inside = (log_var > LOG_VAR_RANGE[0]) & (log_var < LOG_VAR_RANGE[1])
        begin, end, shape = self._places[self._written]
        by_written = self._gradients[begin:end].reshape(shape)
        by_written[:, : self.frames] = self._trust[row] * off
        by_written[:, self.frames :] = 0.5 * self._trust[row] * inside * own * (off * off - 1 / variance)
        _backward(
            self._decoder, self._shapes, self._starts, self._weights, self._values[row], self._gradients, self._scratch
        )
        return np.concatenate([self._gradients[slice(*self._places[k][:2])] for k in self._moves]).astype(np.float64)

    def _run(self, steps: NDArray[np.int64], rows: slice) -> None:
        _forward(steps, self._shapes, self._starts, self._weights, self._values[rows], self._scratch)

    def _matrix(self, number: int, rows: slice) -> Floats:
        """(B, n, f) one matrix of the windows in these rows; a view."""
        begin, end, shape = self._places[number]
        return self._values[rows, begin:end].reshape(-1, *shape)

    def _off_and_log_var(self, row: int) -> tuple[Floats, Floats]:
        """How far the tracks of a window are from where the model puts them, (66, T) in units of `SCALE`, and the
        log-variance that it states, not clamped."""
        rows = slice(row, row + 1)
        written = self._matrix(self._written, rows)[0]
        return self._matrix(self._x, rows)[0, :, : self.frames] - written[:, : self.frames], written[:, self.frames :]

    def _decode(self, rows: slice) -> Look:
        self._run(self._decoder, rows)
        written = self._matrix(self._written, rows)
        half_log_var = 0.5 * np.clip(written[..., self.frames :], *LOG_VAR_RANGE)
        return Look(
            mean=written[..., : self.frames] * np.float64(SCALE) + self._mean,
            sigma=np.exp(half_log_var) * np.float64(SCALE),
        )


def _zeros(*shape: int) -> Floats:
    """Zeros in memory that begins with a line of the cache."""
    size = math.prod(shape)
    room = np.zeros(size + _LINE, dtype=np.float32)
    first = -(room.ctypes.data // room.itemsize) % _LINE
    return room[first : first + size].reshape(shape)


# ---------------------------------------------------------------------------------------------------------------
# The steps, compiled. The types of all arguments are those of LiveHGVAE's attributes.

# Abramowitz and Stegun 7.1.28: erf within 3e-7 without an exponential, which compilers turn into vector instructions.
_ERF = tuple(
    np.array([0.0705230784, 0.0422820123, 0.0092705272, 0.0001520143, 0.0002765672, 0.0000430638], dtype=np.float32)
)
_ROOT_HALF = np.float32(math.sqrt(0.5))
_FAR = np.float32(5)
"""erf is 1 from here on. What is left of its slope would soon be a denormal number, on which processors take 100 times
as long."""
_LOG_2PI = np.float32(math.log(2 * math.pi))
_LEAST, _MOST = (np.float32(end) for end in LOG_VAR_RANGE)
_HALF, _ONE = np.float32(0.5), np.float32(1)


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
def _by_gelu(values, factor, by_out, by_values):
    """Add ``factor`` times the gradient by the row that went into `_gelu`: that of the same approximation."""
    zero, half, one, eight = np.float32(0), np.float32(0.5), np.float32(1), np.float32(8)
    two, three, four, five, six = np.float32(2), np.float32(3), np.float32(4), np.float32(5), np.float32(6)
    a, b, c, d, e, f = _ERF
    for k in range(len(values)):
        x = values[k]
        u = min(abs(x) * _ROOT_HALF, _FAR)
        p = one + u * (a + u * (b + u * (c + u * (d + u * (e + u * f)))))
        slope = a + u * (two * b + u * (three * c + u * (four * d + u * (five * e + u * six * f))))
        q = one / (p * p)
        q = q * q
        q = q * q
        q = q * q
        sign = np.float32(x > zero) - np.float32(x < zero)
        cdf = half * (one + sign * (one - q))
        by_values[k] += factor * by_out[k] * (cdf + eight * _ROOT_HALF * x * slope * q / p)


@njit(cache=True, fastmath=True)
def _add(values, factor, out):
    for k in range(len(values)):
        out[k] += factor * values[k]


@njit(cache=True, fastmath=True)
def _copy(values, out):
    """What ``out[:] = values`` does, in a tenth of the time."""
    for k in range(len(values)):
        out[k] = values[k]


@njit(cache=True)
def _view(arena, shapes, starts, number):
    nodes, features = shapes[number]
    return arena[starts[number] : starts[number] + nodes * features].reshape(nodes, features)


@njit(cache=True)
def _mix_first(nodes_in, features_in, nodes, features):
    """Whether ``(S a) W`` costs less than ``S (a W)``."""
    return nodes * features_in * (nodes_in + features) < nodes_in * features * (features_in + nodes)


@njit(cache=True)
def _forward(steps, shapes, starts, weights, windows, scratch):
    """Do the steps for windows (B, all matrices)."""
    for k in range(len(steps)):
        for row in range(len(windows)):
            _do(steps[k], shapes, starts, weights, windows[row], scratch)


@njit(cache=True)
def _do(step, shapes, starts, weights, values, scratch):
    out, a = _view(values, shapes, starts, step[1]), _view(values, shapes, starts, step[2])
    nodes, features = out.shape
    nodes_in, features_in = a.shape
    if step[0] == _LINEAR:
        _, _, _, of_weight, of_bias, of_adjacency, plus, active = step
        if active:
            activated = scratch[0, : a.size].reshape(a.shape)
            _gelu(a.ravel(), activated.ravel())
            a = activated
        weight = weights[of_weight : of_weight + features_in * features].reshape(features_in, features)
        product = scratch[2, : out.size].reshape(out.shape)
        if of_adjacency == _NONE:
            np.dot(a, weight, product)
        else:
            adjacency = weights[of_adjacency : of_adjacency + nodes * nodes_in].reshape(nodes, nodes_in)
            if _mix_first(nodes_in, features_in, nodes, features):
                mixed = scratch[1, : nodes * features_in].reshape(nodes, features_in)
                np.dot(np.dot(adjacency, a, mixed), weight, product)
            else:
                weighed = scratch[1, : nodes_in * features].reshape(nodes_in, features)
                np.dot(adjacency, np.dot(a, weight, weighed), product)
        _add(weights[of_bias : of_bias + out.size], _ONE, product.ravel())
        if plus != _NONE:
            _add(_view(values, shapes, starts, plus).ravel(), _ONE, product.ravel())
        _copy(product.ravel(), out.ravel())
    elif step[0] == _GELU:
        _, _, _, factor, plus = step[:5]
        activated = scratch[0, : a.size]
        _gelu(a.ravel(), activated)
        if plus == _NONE:
            _copy(activated, out.ravel())
        elif plus != step[1]:
            _copy(_view(values, shapes, starts, plus).ravel(), out.ravel())
        if plus != _NONE:
            _add(activated, weights[factor], out.ravel())
    elif step[0] == _SUM:
        _copy(a.ravel(), out.ravel())
        _add(_view(values, shapes, starts, step[3]).ravel(), _ONE, out.ravel())
    else:
        gaussian = _view(values, shapes, starts, step[3])
        total = 0.0
        for i in range(nodes_in):
            for j in range(features_in):
                log_var = min(max(gaussian[i, features_in + j], _LEAST), _MOST)
                off = a[i, j] - gaussian[i, j]
                total -= _HALF * (log_var + _LOG_2PI + off * off * math.exp(-log_var))
        out[0, 0] = total


@njit(cache=True)
def _backward(steps, shapes, starts, weights, values, gradients, scratch):
    """From the gradients of some matrices, those of all that they were made of, of one window."""
    for k in range(len(steps) - 1, -1, -1):
        _undo(steps[k], shapes, starts, weights, values, gradients, scratch)


@njit(cache=True)
def _undo(step, shapes, starts, weights, values, gradients, scratch):
    by_out, by_a = _view(gradients, shapes, starts, step[1]), _view(gradients, shapes, starts, step[2])
    nodes, features = by_out.shape
    nodes_in, features_in = by_a.shape
    if step[0] == _LINEAR:
        _, _, _, of_weight, _, of_adjacency, plus, active = step
        weight = weights[of_weight : of_weight + features_in * features].reshape(features_in, features)
        by_input = scratch[2, : by_a.size].reshape(by_a.shape)
        if of_adjacency == _NONE:
            np.dot(by_out, weight.T, by_input)
        else:
            adjacency = weights[of_adjacency : of_adjacency + nodes * nodes_in].reshape(nodes, nodes_in)
            if _mix_first(nodes_in, features_in, nodes, features):
                by_mixed = scratch[1, : nodes * features_in].reshape(nodes, features_in)
                np.dot(adjacency.T, np.dot(by_out, weight.T, by_mixed), by_input)
            else:
                by_weighed = scratch[1, : nodes_in * features].reshape(nodes_in, features)
                np.dot(np.dot(adjacency.T, by_out, by_weighed), weight.T, by_input)
        if plus != _NONE and plus != step[1]:
            _add(by_out.ravel(), _ONE, _view(gradients, shapes, starts, plus).ravel())
        if active:
            _by_gelu(_view(values, shapes, starts, step[2]).ravel(), _ONE, by_input.ravel(), by_a.ravel())
        else:
            _add(by_input.ravel(), _ONE, by_a.ravel())
    elif step[0] == _GELU:
        _, _, _, factor, plus = step[:5]
        _by_gelu(_view(values, shapes, starts, step[2]).ravel(), weights[factor], by_out.ravel(), by_a.ravel())
        if plus != step[1]:
            _add(by_out.ravel(), _ONE, _view(gradients, shapes, starts, plus).ravel())
    elif step[0] == _SUM:
        _add(by_out.ravel(), _ONE, by_a.ravel())
        _add(by_out.ravel(), _ONE, _view(gradients, shapes, starts, step[3]).ravel())
    else:
        a, by_sum = _view(values, shapes, starts, step[2]), by_out[0, 0]
        gaussian, by_gaussian = _view(values, shapes, starts, step[3]), _view(gradients, shapes, starts, step[3])
        for i in range(nodes_in):
            for j in range(features_in):
                log_var = gaussian[i, features_in + j]
                scale = math.exp(-min(max(log_var, _LEAST), _MOST))
                off = a[i, j] - gaussian[i, j]
                by_a[i, j] -= by_sum * off * scale
                by_gaussian[i, j] += by_sum * off * scale
                if _LEAST < log_var < _MOST:
                    by_gaussian[i, features_in + j] += by_sum * _HALF * (off * off * scale - _ONE)
