"""Products of small float32 matrices, for compiled loops.

BLAS libraries are made for large matrices: with the 10 to 66 rows of the networks here, OpenBLAS reaches a third of the
speed that it has with large ones. Here, a tile of the product stays in vector registers while its terms are added one
after the other, as in the inner kernel of Goto and van de Geijn (2008). Weights are packed once, so that a tile reads
them one after the other: in rows of a large matrix, processors neither fetch them ahead nor keep their pages. The terms
of an element are added in the same order whatever the number of rows, so a row does not depend on the others, bit for
bit.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from llvmlite.binding import get_host_cpu_features
from numba.core import cgutils, types
from numba.extending import intrinsic

from steadypose.prior.arrays import Floats32
from steadypose.prior.compiled import njit

LANES = 16
"""Number of floats in a vector. Where a register holds fewer, LLVM uses several registers."""

_AVX512 = bool(get_host_cpu_features().get("avx512f"))

_ROWS, _FEWER_ROWS, _WIDE = 6, 5, 3 if _AVX512 else 1
"""Numbers of rows in a tile, and of vectors in each of its rows. Of the two numbers of rows, the one is taken whose
tiles overlap less. 18 sums, 3 vectors of weights and one of an element of ``a`` fit into 32 registers of 16 floats; 6
sums, in two registers each, fit into 16 registers of 8 floats."""

_TEN, _WIDE_OF_TEN = 10, 2
"""Number of rows in a tile of multiples of it, and of vectors in each of its rows, where registers hold 16 floats: each
weight is then read once."""


def packed(weight: Floats32) -> Floats32:
    """Pack a matrix (inner, columns) for `multiply_packed`: its columns in groups of `LANES`, (groups, inner, `LANES`).

    The last group holds the last `LANES` columns, some of which may be in the group before too, or zeros beside fewer.
    """
    inner, columns = weight.shape
    wide = np.zeros((inner, max(columns, LANES)), dtype=np.float32)
    wide[:, :columns] = weight
    starts = [min(start, wide.shape[1] - LANES) for start in range(0, columns, LANES)]
    return np.ascontiguousarray(np.stack([wide[:, start : start + LANES] for start in starts]))


def _tile(rows: int, vectors: int) -> Any:
    """Return a function for loops that writes a tile of a product, of ``rows`` rows and ``vectors`` vectors each."""
    vector, lane, size = ir.VectorType(ir.FloatType(), LANES), ir.IntType(32), ir.IntType(64)
    nothing, zeroth = ir.Constant(vector, [0.0] * LANES), ir.Constant(ir.VectorType(lane, LANES), [0] * LANES)
    tile = [(r, v) for r in range(rows) for v in range(vectors)]

    @intrinsic
    def write(
        _: Any, a: Any, weight: Any, shift: Any, product: Any, row: Any, column: Any, start: Any, below: Any, near: Any
    ) -> Any:
        """Write the tile of ``shift + a @ weight`` that begins at ``row`` and ``column``.

        Its first vector of ``weight`` (N,) is at ``start``, that of the next row ``below`` floats further, and the next
        vector of a row ``near`` floats further.
        """
        matrices = all((each.dtype, each.ndim, each.layout) == (types.float32, 2, "C") for each in (a, shift, product))
        if not matrices or (weight.dtype, weight.ndim, weight.layout) != (types.float32, 1, "C"):
            return None  # numba then raises a TypingError

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            arrays = [
                context.make_array(kind)(context, builder, value)
                for kind, value in zip((a, weight, shift, product), arguments[:4], strict=True)
            ]
            at_row, at_column, start, below, near = arguments[4:]
            inner, columns = (cgutils.unpack_tuple(builder, arrays[of].shape)[1] for of in (0, 3))

            def element(of: int, r: Any, c: Any, width: Any) -> Any:
                return builder.gep(arrays[of].data, [builder.add(builder.mul(r, width), c)])

            def place(of: int, r: Any, v: int) -> Any:
                at = element(of, r, builder.add(at_column, size(v * LANES)), columns)
                return builder.bitcast(at, vector.as_pointer())

            one_shift = builder.icmp_signed("==", cgutils.unpack_tuple(builder, arrays[2].shape)[0], size(1))
            in_rows = [builder.add(at_row, size(r)) for r in range(rows)]
            # memory for LLVM to keep in registers
            sums = {each: cgutils.alloca_once(builder, vector) for each in tile}
            for r, v in tile:
                shifted = place(2, builder.select(one_shift, size(0), in_rows[r]), v)
                builder.store(builder.load(shifted, align=4), sums[r, v])
            with cgutils.for_range(builder, inner) as loop:
                first = builder.add(start, builder.mul(loop.index, below))
                weights = []
                for v in range(vectors):
                    at = builder.gep(arrays[1].data, [builder.add(first, builder.mul(near, size(v)))])
                    weights.append(builder.load(builder.bitcast(at, vector.as_pointer()), align=4))
                for r in range(rows):
                    one = builder.load(element(0, in_rows[r], loop.index, inner))
                    alone = builder.insert_element(nothing, one, lane(0))
                    everywhere = builder.shuffle_vector(alone, nothing, zeroth)
                    for v in range(vectors):
                        term = builder.fmul(everywhere, weights[v], flags=("contract",))
                        builder.store(builder.fadd(builder.load(sums[r, v]), term, flags=("contract",)), sums[r, v])
            for r, v in tile:
                builder.store(builder.load(sums[r, v]), place(3, in_rows[r], v), align=4)
            return context.get_dummy_value()

        return types.void(a, weight, shift, product, *[types.intp] * 5), generate

    return write


_tile_wide, _tile_narrow = _tile(_ROWS, _WIDE), _tile(_ROWS, 1)
_fewer_wide, _fewer_narrow = _tile(_FEWER_ROWS, _WIDE), _tile(_FEWER_ROWS, 1)
_ten_wide, _ten_narrow = _tile(_TEN, _WIDE_OF_TEN), _tile(_TEN, 1)
_row_wide, _row_narrow = _tile(1, _WIDE), _tile(1, 1)


@njit(cache=True)
def multiply(a, weight, shift, product):
    """Write ``shift + a @ weight``, of float32 matrices in C order, to ``product``, which must not overlap them.
    ``shift`` has one row, or as many as ``product``. Matrices that do not fit raise a ValueError."""
    inner, columns = weight.shape
    _check(a, inner, columns == product.shape[1], shift, product)
    if columns >= LANES:
        _multiply(a, weight.reshape(-1), shift, product, columns, LANES)
    else:
        _multiply_narrow(a, _widened(weight).reshape(-1), shift, product)


@njit(cache=True)
def multiply_packed(a, weight, shift, product):
    """Do the same as `multiply`, bit for bit, given a `packed` matrix."""
    groups, inner, _ = weight.shape
    _check(a, inner, 0 <= groups * LANES - product.shape[1] < LANES, shift, product)
    if product.shape[1] >= LANES:
        _multiply(a, weight.reshape(-1), shift, product, LANES, inner * LANES)
    else:
        _multiply_narrow(a, weight.reshape(-1), shift, product)


@njit(cache=True)
def _check(a, inner, is_wide_enough, shift, product):
    rows, columns = product.shape
    if len(a) != rows or a.shape[1] != inner or not is_wide_enough:
        raise ValueError("multiply: expected a product of as many rows as its first matrix and columns as its second")
    if shift.shape[1] != columns or len(shift) not in (1, rows):
        raise ValueError("multiply: expected a shift of one row or of the product's, and of its columns")


@njit(cache=True)
def _multiply_narrow(a, weight, shift, product):
    """Multiply with fewer than `LANES` columns; ``weight`` has zeros beside them."""
    whole = np.empty((len(product), LANES), dtype=np.float32)
    _multiply(a, weight, _widened(shift), whole, LANES, LANES)
    for row in range(len(product)):
        for column in range(product.shape[1]):
            product[row, column] = whole[row, column]


@njit(cache=True)
def _widened(values):
    wide = np.zeros((len(values), LANES), dtype=np.float32)
    for row in range(len(values)):
        for column in range(values.shape[1]):
            wide[row, column] = values[row, column]
    return wide


@njit(cache=True)
def _multiply(a, weight, shift, product, below, near):
    """Multiply tile by tile. The last tiles may overlap the ones before, and then write the same values again."""
    rows, columns = product.shape
    is_fewer = -(-rows // _FEWER_ROWS) * _FEWER_ROWS < -(-rows // _ROWS) * _ROWS
    height = 1 if rows < _FEWER_ROWS else _FEWER_ROWS if is_fewer else _ROWS
    if _AVX512 and rows % _TEN == 0:
        height = _TEN
    groups = (columns + LANES - 1) // LANES
    vectors = _WIDE_OF_TEN if height == _TEN else _WIDE
    group = 0
    while group < groups:
        wide = (group + vectors) * LANES <= columns
        column = min(group * LANES, columns - LANES)
        start = group * near if below == LANES else column
        for first in range(0, rows, height):
            row = min(first, rows - height)
            if wide and height == _TEN:
                _ten_wide(a, weight, shift, product, row, column, start, below, near)
            elif wide and height == _ROWS:
                _tile_wide(a, weight, shift, product, row, column, start, below, near)
            elif wide and height == _FEWER_ROWS:
                _fewer_wide(a, weight, shift, product, row, column, start, below, near)
            elif wide:
                _row_wide(a, weight, shift, product, row, column, start, below, near)
            elif height == _TEN:
                _ten_narrow(a, weight, shift, product, row, column, start, below, near)
            elif height == _ROWS:
                _tile_narrow(a, weight, shift, product, row, column, start, below, near)
            elif height == _FEWER_ROWS:
                _fewer_narrow(a, weight, shift, product, row, column, start, below, near)
            else:
                _row_narrow(a, weight, shift, product, row, column, start, below, near)
        group += vectors if wide else 1
