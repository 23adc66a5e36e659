"""Live inference of graph and attention networks without torch: compiled loops over four kinds of matrix steps.

In torch, overhead dominates networks of this size: 250 small operations take ten times as long as their arithmetic.
Here, a network is recorded once as a list of steps (`Program`), and compiled loops run it (`Network`).

Each step processes one window after the other: a window's matrices of 66 nodes fit into the L1 cache, and the step's
weights are still cached for the next window. The results of a window do not depend on other windows, bit for bit.
"""

from __future__ import annotations

import math

import numpy as np

from steadypose.prior.arrays import Floats32
from steadypose.prior.compiled import njit
from steadypose.prior.models.matmul import LANES, multiply, multiply_packed, packed
from steadypose.prior.models.weights import Arrays, part

LOG_VAR_RANGE = (-10.0, 3.0)
"""Range of log-variances, in units of `prior.models.hgvae.config.SCALE`; standard deviations are 1.3 mm to 0.9 m."""

# Steps: the kind, the matrix written, the matrix read, and further fields by kind (see `_do`).
_LINEAR, _GELU, _NORM, _ATTEND = range(4)
_FIELDS = 8
_NONE = -1

_NORM_EPSILON = np.float32(1e-5)  # variance added in a layer normalisation, torch's default


class Program:
    """A network as a list of steps, with the shapes of its matrices and all weights. Steps may overwrite matrices."""

    def __init__(self) -> None:
        self.steps: list[list[int]] = []
        self.shapes: list[tuple[int, int]] = []
        self.weights: list[Floats32] = []
        self._used = 0

    def matrix(self, nodes: int, features: int) -> int:
        """Add a matrix and return its number. It is zero unless a step writes it."""
        self.shapes.append((nodes, features))
        return len(self.shapes) - 1

    def _store(self, values: Floats32) -> int:
        self.weights.append(np.ascontiguousarray(values, dtype=np.float32).ravel())
        self._used += values.size
        return self._used - values.size

    def _step(self, kind: int, out: int, *fields: int) -> int:
        self.steps.append([kind, out, *fields, *[_NONE] * (_FIELDS - 2 - len(fields))])
        return out

    def linear(
        self,
        of: int,
        weight: Floats32,
        bias: Floats32,
        adjacency: Floats32 | None = None,
        plus: int = _NONE,
        onto: int = _NONE,
        active: bool = False,
    ) -> int:
        """Add the step ``adjacency @ of @ weight + bias + plus``. Without an adjacency, nodes are not mixed.

        Args:
            of, weight, bias, adjacency: (n_in, f_in), (f_in, f_out), (f_out) or (n_out, f_out), (n_out, n_in).
            plus: matrix to add.
            onto: matrix to write; a new one if omitted.
            active: whether to apply a GELU to ``of`` first.
        """
        nodes = self.shapes[of][0] if adjacency is None else len(adjacency)
        out = self.matrix(nodes, weight.shape[1]) if onto == _NONE else onto
        stored = _NONE if adjacency is None else self._store(adjacency)
        shift = self._store(np.broadcast_to(bias, (nodes, weight.shape[1])))
        return self._step(_LINEAR, out, of, self._store(packed(weight)), shift, stored, plus, int(active))

    def layer(self, of: int, layer: Arrays, *, plus: int = _NONE, onto: int = _NONE, active: bool = False) -> int:
        """Add a `GraphLinear` with these weights. Without weights, return ``of``: equal nodes need no layer between."""
        if not layer:
            return of
        return self.linear(of, layer["weight"], layer["bias"], layer["adjacency"], plus, onto, active)

    def block(self, of: int, block: Arrays, *, onto: int) -> int:
        """Add a `GraphBlock` (equation 5) of a matrix, written to ``onto``, which may be the same."""
        inner = self.layer(self.layer(of, part(block, "first")), part(block, "second"), active=True)
        return self._step(_GELU, onto, inner, self._store(block["alpha"]), of)

    def trunk(self, of: int, weights: Arrays) -> int:
        """Add a network's ``read`` layer with its GELU, followed by its ``blocks``."""
        graph = self.gelu(self.layer(of, part(weights, "read")))
        blocks, k = part(weights, "blocks"), 0
        while block := part(blocks, str(k)):
            self.block(graph, block, onto=graph)
            k += 1
        return graph

    def attention(self, of: int, layer: Arrays, heads: int) -> int:
        """Add an `AttentionLayer` with these weights, without biases of its scores, in place."""
        read = self.normed(of, part(layer, "norm1"), part(layer, "attend"))
        joined = self._step(_ATTEND, self.matrix(*self.shapes[of]), read, heads)
        self.linear(joined, layer["join.weight"].T, layer["join.bias"], plus=of, onto=of)
        wide = self.normed(of, part(layer, "norm2"), part(layer, "widen"))
        return self.linear(wide, layer["narrow.weight"].T, layer["narrow.bias"], plus=of, onto=of, active=True)

    def normed(self, of: int, norm: Arrays, linear: Arrays) -> int:
        """Add a layer normalisation and the linear layer that follows it, which includes its scale and shift."""
        normed = self._step(_NORM, self.matrix(*self.shapes[of]), of)
        weight, shift = linear["weight"], (linear["weight"] @ norm["bias"]).astype(np.float32)
        return self.linear(normed, (weight * norm["weight"]).T, linear["bias"] + shift)

    def gelu(self, of: int) -> int:
        """Add a GELU of a matrix, written to a new matrix."""
        return self._step(_GELU, self.matrix(*self.shapes[of]), of, self._store(np.ones(1, dtype=np.float32)), _NONE)


class Network:
    """A program with memory for its matrices, for ``max_batch`` windows, each in its row. Later changes to the program
    have no effect."""

    def __init__(self, program: Program, max_batch: int) -> None:
        self._steps = np.array(program.steps, dtype=np.int64)
        self._shapes = np.array(program.shapes, dtype=np.int64)
        self._starts = np.concatenate([[0], np.cumsum(self._shapes.prod(axis=1))])
        self._weights = np.concatenate(program.weights)
        self._values = np.zeros((max_batch, self._starts[-1]), dtype=np.float32)
        nodes, features = self._shapes.max(axis=0)
        self._scratch = np.empty((3, nodes * features), dtype=np.float32)
        self._nothing = np.zeros(features, dtype=np.float32)

    def matrix(self, number: int, rows: slice) -> Floats32:
        """(B, n, f) view of one matrix of the windows in these rows."""
        values = self._values[rows, self._starts[number] : self._starts[number + 1]]
        return values.reshape(-1, *self._shapes[number])

    def run(self, rows: slice) -> None:
        """Run all steps for the windows in these rows."""
        _forward(
            self._steps, self._shapes, self._starts, self._weights, self._values[rows], self._scratch, self._nothing
        )


# ---------------------------------------------------------------------------------------------------------------
# Compiled steps. All arguments have the types of Network's attributes.

# Abramowitz and Stegun 7.1.28: erf within 3e-7. It needs no exponential, so compilers vectorise it.
_ERF = tuple(
    np.array([0.0705230784, 0.0422820123, 0.0092705272, 0.0001520143, 0.0002765672, 0.0000430638], dtype=np.float32)
)
_ROOT_HALF = np.float32(math.sqrt(0.5))
_ONE = np.float32(1)


@njit(cache=True, fastmath=True)
def _gelu(values, out):
    """Write ``x * Phi(x)`` of a row, with Phi the normal distribution function."""
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
def _add(values, factor, out):
    for k in range(len(values)):
        out[k] += factor * values[k]


@njit(cache=True, fastmath=True)
def _copy(values, out):
    """Do ``out[:] = values`` in a tenth of the time."""
    for k in range(len(values)):
        out[k] = values[k]


@njit(cache=True, fastmath=True)
def _norm(values, out):
    """Write each row less its mean, over its standard deviation."""
    width = values.shape[1]
    for row in range(len(values)):
        mean = square = np.float32(0)
        for k in range(width):
            mean += values[row, k]
        mean /= np.float32(width)
        for k in range(width):
            square += (values[row, k] - mean) ** 2
        scale = _ONE / np.sqrt(square / np.float32(width) + _NORM_EPSILON)
        for k in range(width):
            out[row, k] = scale * (values[row, k] - mean)


@njit(cache=True, fastmath=True)
def _attend(read, heads, out):
    """Write the attention of rows (n, f), given their queries, keys and values (n, 3 f), which ``heads`` share."""
    nodes, width = out.shape
    size = width // heads
    scale = _ONE / np.sqrt(np.float32(size))
    wide = max(nodes, LANES)  # columns that fill a vector; those beyond the nodes stay 0
    query, keys = np.empty((nodes, size), dtype=np.float32), np.zeros((size, wide), dtype=np.float32)
    shares, value = np.empty((nodes, wide), dtype=np.float32), np.zeros((wide, size), dtype=np.float32)
    joined = np.empty((nodes, size), dtype=np.float32)
    no_share, no_value = np.zeros((1, wide), dtype=np.float32), np.zeros((1, size), dtype=np.float32)
    for first in range(0, width, size):
        for row in range(nodes):
            for k in range(size):
                query[row, k] = scale * read[row, first + k]
                keys[k, row] = read[row, width + first + k]
                value[row, k] = read[row, 2 * width + first + k]
        multiply(query, keys, no_share, shares)
        for row in range(nodes):
            most, total = np.float32(-np.inf), np.float32(0)
            for other in range(nodes):
                most = max(most, shares[row, other])
            for other in range(nodes):
                shares[row, other] = np.exp(shares[row, other] - most)
                total += shares[row, other]
            for other in range(nodes):
                shares[row, other] /= total
        multiply(shares, value, no_value, joined)
        for row in range(nodes):
            for k in range(size):
                out[row, first + k] = joined[row, k]


@njit(cache=True)
def _view(arena, shapes, starts, number):
    nodes, features = shapes[number]
    return arena[starts[number] : starts[number] + nodes * features].reshape(nodes, features)


@njit(cache=True)
def _mix_first(nodes_in, features_in, nodes, features):
    """Whether ``(S a) W`` takes fewer operations than ``S (a W)``."""
    return nodes * features_in * (nodes_in + features) < nodes_in * features * (features_in + nodes)


@njit(cache=True)
def _forward(steps, shapes, starts, weights, windows, scratch, nothing):
    """Run the steps for windows (B, all matrices)."""
    for k in range(len(steps)):
        for row in range(len(windows)):
            _do(steps[k], shapes, starts, weights, windows[row], scratch, nothing)


@njit(cache=True)
def _do(step, shapes, starts, weights, values, scratch, nothing):
    out, a = _view(values, shapes, starts, step[1]), _view(values, shapes, starts, step[2])
    nodes, features = out.shape
    nodes_in, features_in = a.shape
    if step[0] == _LINEAR:
        _, _, _, of_weight, of_bias, of_adjacency, plus, active = step
        if active:
            activated = scratch[0, : a.size].reshape(a.shape)
            _gelu(a.ravel(), activated.ravel())
            a = activated
        groups = (features + LANES - 1) // LANES
        weight = weights[of_weight : of_weight + groups * features_in * LANES].reshape(groups, features_in, LANES)
        shift = weights[of_bias : of_bias + out.size].reshape(out.shape)
        product = scratch[2, : out.size].reshape(out.shape)
        if of_adjacency == _NONE:
            multiply_packed(a, weight, shift, product)
        else:
            adjacency = weights[of_adjacency : of_adjacency + nodes * nodes_in].reshape(nodes, nodes_in)
            if _mix_first(nodes_in, features_in, nodes, features):
                mixed = scratch[1, : nodes * features_in].reshape(nodes, features_in)
                multiply(adjacency, a, nothing[:features_in].reshape(1, -1), mixed)
                multiply_packed(mixed, weight, shift, product)
            else:
                weighed = scratch[1, : nodes_in * features].reshape(nodes_in, features)
                multiply_packed(a, weight, nothing[:features].reshape(1, -1), weighed)
                multiply(adjacency, weighed, shift, product)
        if plus != _NONE:
            _add(_view(values, shapes, starts, plus).ravel(), _ONE, product.ravel())
        _copy(product.ravel(), out.ravel())
    elif step[0] == _NORM:
        _norm(a, out)
    elif step[0] == _ATTEND:
        _attend(a, step[3], out)
    else:
        _, _, _, factor, plus = step[:5]
        activated = scratch[0, : a.size]
        _gelu(a.ravel(), activated)
        if plus == _NONE:
            _copy(activated, out.ravel())
        elif plus != step[1]:
            _copy(_view(values, shapes, starts, plus).ravel(), out.ravel())
        if plus != _NONE:
            _add(activated, weights[factor], out.ravel())
