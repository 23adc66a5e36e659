"""Networks of graph layers as live nodes run them: a few kinds of steps on matrices, forwards and backwards.

Networks of this size are all overhead in torch: 250 small operations and their gradients take ten times as long as
their arithmetic. Here one is recorded once (`Program`) as a list of steps, which compiled loops run (`Network`).

Each step runs for one window after the other: a window's matrices of 66 nodes fit into the L1 cache, where products
take half as long per window as those of eight windows side by side, and a step's weights are still cached for the next
window. So a window's results do not depend on the others, bit for bit.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.compiled import njit
from steadypose.prior.models.weights import Arrays, part

Floats = NDArray[np.float32]

LOG_VAR_RANGE = (-10.0, 3.0)
"""of latents and, in units of `prior.models.hgvae.config.SCALE`, of tracks: standard deviations from 1.3 mm to 0.9 m"""

# Steps: the kind, the matrix written, that read, and what else the kind needs (see `_do`).
_LINEAR, _GELU, _SUM, _DENSITY = range(4)
_FIELDS = 8
_NONE = -1

_SMALL = 1_000_000
"""Products up to which OpenBLAS multiplies matrices as they are. Beyond, it rearranges them first, which takes three
times as long as the rest where there are but ten rows."""

_LINE = 16
"""Numbers in a line of the cache. Matrices begin with one: products of those that do not take a seventh longer."""


class Program:
    """A network as a list of steps, with the shapes of their matrices, and all weights in one array.

    Steps may overwrite a matrix: the backward pass reads only the inputs of `gelu` and `density`, which are never
    overwritten.
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

    def _store(self, values: Floats) -> int:
        row = np.ascontiguousarray(values, dtype=np.float32).ravel()
        self.weights.append(np.pad(row, (0, -len(row) % _LINE)))
        self._used += len(self.weights[-1])
        return self._used - len(self.weights[-1])

    def _step(self, kind: int, out: int, *fields: int) -> int:
        self.steps.append([kind, out, *fields, *[_NONE] * (_FIELDS - 2 - len(fields))])
        return out

    def linear(
        self,
        of: int,
        weight: Floats,
        bias: Floats,
        adjacency: Floats | None = None,
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
        shift = self._store(np.broadcast_to(bias, (nodes, weight.shape[1])))
        return self._step(_LINEAR, out, of, self._store(weight), shift, stored, plus, int(active))

    def layer(self, of: int, layer: Arrays, *, plus: int = _NONE, onto: int = _NONE, active: bool = False) -> int:
        """The weights of a `GraphLinear`; of none, ``of`` itself: the same nodes need no layer between them."""
        if not layer:
            return of
        return self.linear(of, layer["weight"], layer["bias"], layer["adjacency"], plus, onto, active)

    def block(self, of: int, block: Arrays, *, onto: int) -> int:
        """A graph convolutional block, equation 5, written to ``onto``, which may be ``of`` itself.

        Args:
            of: matrix read.
            block: weights of a `GraphBlock`.
            onto: matrix written.
        """
        inner = self.layer(self.layer(of, part(block, "first")), part(block, "second"), active=True)
        return self._step(_GELU, onto, inner, self._store(block["alpha"]), of)

    def trunk(self, of: int, weights: Arrays) -> int:
        """A network's ``read`` with its GELU, and its ``blocks`` one after the other."""
        graph = self.gelu(self.layer(of, part(weights, "read")))
        blocks, k = part(weights, "blocks"), 0
        while block := part(blocks, str(k)):
            self.block(graph, block, onto=graph)
            k += 1
        return graph

    def gelu(self, of: int) -> int:
        """GELU of a matrix, into a matrix of its own."""
        return self._step(_GELU, self.matrix(*self.shapes[of]), of, self._store(np.ones(1, dtype=np.float32)), _NONE)

    def sum(self, of: int, other: int) -> int:
        """Of two matrices."""
        return self._step(_SUM, self.matrix(*self.shapes[of]), of, other)

    def density(self, of: int, gaussian: int) -> int:
        """The logarithm of a normal density, summed over all entries.

        ``gaussian`` (n, 2 f) holds means and then log-variances, which are clamped to `LOG_VAR_RANGE`.
        """
        return self._step(_DENSITY, self.matrix(1, 1), of, gaussian)


class Network:
    """A program with room for what it computes.

    Args:
        program: a network written down; later changes to it are not seen here.
        max_batch: windows at once, each in its row.

    Attributes:
        steps: (N, fields) of the program, in order.
        places: of each matrix, in a row: where it begins and ends, and its shape.
        values: (max_batch, all matrices) of every window.
        gradients: (all matrices) of one window.
    """

    def __init__(self, program: Program, max_batch: int) -> None:
        self.steps = np.array(program.steps, dtype=np.int64)
        self._shapes = np.array(program.shapes, dtype=np.int64)
        sizes = self._shapes.prod(axis=1)
        self._starts = np.concatenate([[0], np.cumsum(-(-sizes // _LINE) * _LINE)])
        ends = (self._starts[:-1] + sizes).tolist()
        self.places = [*zip(self._starts[:-1].tolist(), ends, program.shapes, strict=True)]
        self._weights = _zeros(sum(map(len, program.weights)))
        np.concatenate(program.weights, out=self._weights)
        self.values, self.gradients = _zeros(max_batch, self._starts[-1]), _zeros(self._starts[-1])
        self._scratch = _zeros(3, -(-self._shapes.max(axis=0).prod() // _LINE) * _LINE)

    def matrix(self, number: int, rows: slice) -> Floats:
        """(B, n, f) one matrix of the windows in these rows; a view."""
        begin, end, shape = self.places[number]
        return self.values[rows, begin:end].reshape(-1, *shape)

    def gradient(self, number: int) -> Floats:
        """(n, f) the gradient by one matrix; a view."""
        begin, end, shape = self.places[number]
        return self.gradients[begin:end].reshape(shape)

    def run(self, steps: NDArray[np.int64], rows: slice) -> None:
        """Do these steps for the windows in these rows."""
        _forward(steps, self._shapes, self._starts, self._weights, self.values[rows], self._scratch)

    def run_back(self, steps: NDArray[np.int64], row: int) -> None:
        """From the gradients by some matrices of a window, to be added to, those by all that they were made of."""
        _backward(steps, self._shapes, self._starts, self._weights, self.values[row], self.gradients, self._scratch)


def _zeros(*shape: int) -> Floats:
    """Zeros in memory that begins with a line of the cache."""
    size = math.prod(shape)
    room = np.zeros(size + _LINE, dtype=np.float32)
    first = -(room.ctypes.data // room.itemsize) % _LINE
    return room[first : first + size].reshape(shape)


# ---------------------------------------------------------------------------------------------------------------
# The steps, compiled. The types of all arguments are those of Network's attributes.

# Abramowitz and Stegun 7.1.28: erf within 3e-7 without an exponential, which compilers turn into vector instructions.
_ERF = tuple(
    np.array([0.0705230784, 0.0422820123, 0.0092705272, 0.0001520143, 0.0002765672, 0.0000430638], dtype=np.float32)
)
_ROOT_HALF = np.float32(math.sqrt(0.5))
_FAR = np.float32(5)
"""erf is 1 from here on. What is left of its slope would soon be a denormal number, on which processors take 100 times
as long."""
_LOG_2PI = np.float32(math.log(2 * math.pi))
_LOG_VAR_MIN, _LOG_VAR_MAX = (np.float32(end) for end in LOG_VAR_RANGE)
_HALF, _ONE = np.float32(0.5), np.float32(1)


@njit(cache=True, fastmath=True)
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


@njit(cache=True, fastmath=True)
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
def _multiply(a, weight, product):
    """Writes ``a @ weight``, in parts small enough for those of BLAS's kernels that do not rearrange matrices first."""
    rows, inner = a.shape
    parts = -(-rows * inner * weight.shape[1] // _SMALL)
    if parts == 1:
        np.dot(a, weight, product)
        return
    width = -(-inner // parts)
    product[:] = 0
    for first in range(0, inner, width):
        part = np.dot(np.ascontiguousarray(a[:, first : first + width]), weight[first : first + width])
        _add(part.ravel(), _ONE, product.ravel())


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
            _multiply(a, weight, product)
        else:
            adjacency = weights[of_adjacency : of_adjacency + nodes * nodes_in].reshape(nodes, nodes_in)
            if _mix_first(nodes_in, features_in, nodes, features):
                mixed = scratch[1, : nodes * features_in].reshape(nodes, features_in)
                _multiply(np.dot(adjacency, a, mixed), weight, product)
            else:
                weighed = scratch[1, : nodes_in * features].reshape(nodes_in, features)
                _multiply(a, weight, weighed)
                np.dot(adjacency, weighed, product)
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
                log_var = min(max(gaussian[i, features_in + j], _LOG_VAR_MIN), _LOG_VAR_MAX)
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
                scale = math.exp(-min(max(log_var, _LOG_VAR_MIN), _LOG_VAR_MAX))
                off = a[i, j] - gaussian[i, j]
                by_a[i, j] -= by_sum * off * scale
                by_gaussian[i, j] += by_sum * off * scale
                if _LOG_VAR_MIN < log_var < _LOG_VAR_MAX:
                    by_gaussian[i, features_in + j] += by_sum * _HALF * (off * off * scale - _ONE)
