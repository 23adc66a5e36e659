"""Products of small float32 matrices, for compiled loops.

BLAS libraries are made for large matrices: with the 10 to 66 rows of the networks here, OpenBLAS reaches a third of the
speed that it has with large ones. Here, a tile of the product stays in vector registers while its terms are added one
after the other, as in the inner kernel of Goto and van de Geijn (2008), but without packing. The terms of an element
are added in the same order whatever the number of rows, so a row does not depend on the others, bit for bit.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from llvmlite.binding import get_host_cpu_features
from numba.core import cgutils, types
from numba.extending import intrinsic

from steadypose.prior.compiled import njit

LANES = 16
"""Number of floats in a vector. Where a register holds fewer, LLVM uses several registers."""

_ROWS = 6
_FEWER_ROWS = 5
"""Numbers of rows in a tile. Of the two, the one is taken whose tiles overlap less: 10 rows are two tiles of 5."""

_WIDE = 3 if get_host_cpu_features().get("avx512f") else 1
"""Number of vectors in a row of a wide tile. Its 18 sums, 3 vectors of weights and one of an element of ``a`` fit into
32 registers of 16 floats; 6 sums, in two registers each, fit into 16 registers of 8 floats."""


def _tile(rows: int, vectors: int) -> Any:
    """Return a function for loops that writes a tile of a product, of ``rows`` rows and ``vectors`` vectors each."""
    vector, lane, size = ir.VectorType(ir.FloatType(), LANES), ir.IntType(32), ir.IntType(64)
    nothing, zeroth = ir.Constant(vector, [0.0] * LANES), ir.Constant(ir.VectorType(lane, LANES), [0] * LANES)
    tile = [(r, v) for r in range(rows) for v in range(vectors)]

    @intrinsic
    def write(_: Any, a: Any, weight: Any, shift: Any, product: Any, row: Any, column: Any) -> Any:
        """Write the tile of ``shift + a @ weight`` that begins at ``row`` and ``column``."""
        if any((each.dtype, each.ndim, each.layout) != (types.float32, 2, "C") for each in (a, weight, shift, product)):
            return None  # numba then raises a TypingError

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            arrays = [
                context.make_array(kind)(context, builder, value)
                for kind, value in zip((a, weight, shift, product), arguments[:4], strict=True)
            ]
            inner, columns = (cgutils.unpack_tuple(builder, array.shape)[1] for array in arrays[:2])

            def element(of: int, r: Any, c: Any, width: Any) -> Any:
                return builder.gep(arrays[of].data, [builder.add(builder.mul(r, width), c)])

            def place(of: int, r: Any, v: int) -> Any:
                at = element(of, r, builder.add(arguments[5], size(v * LANES)), columns)
                return builder.bitcast(at, vector.as_pointer())

            one_shift = builder.icmp_signed("==", cgutils.unpack_tuple(builder, arrays[2].shape)[0], size(1))
            in_rows = [builder.add(arguments[4], size(r)) for r in range(rows)]
            # memory for LLVM to keep in registers
            sums = {each: cgutils.alloca_once(builder, vector) for each in tile}
            for r, v in tile:
                shifted = place(2, builder.select(one_shift, size(0), in_rows[r]), v)
                builder.store(builder.load(shifted, align=4), sums[r, v])
            with cgutils.for_range(builder, inner) as loop:
                weights = [builder.load(place(1, loop.index, v), align=4) for v in range(vectors)]
                for r in range(rows):
                    one = builder.load(element(0, in_rows[r], loop.index, inner))
                    first = builder.insert_element(nothing, one, lane(0))
                    everywhere = builder.shuffle_vector(first, nothing, zeroth)
                    for v in range(vectors):
                        term = builder.fmul(everywhere, weights[v], flags=("contract",))
                        builder.store(builder.fadd(builder.load(sums[r, v]), term, flags=("contract",)), sums[r, v])
            for r, v in tile:
                builder.store(builder.load(sums[r, v]), place(3, in_rows[r], v), align=4)
            return context.get_dummy_value()

        return types.void(a, weight, shift, product, types.intp, types.intp), generate

    return write


_tile_wide, _tile_narrow = _tile(_ROWS, _WIDE), _tile(_ROWS, 1)
_fewer_wide, _fewer_narrow = _tile(_FEWER_ROWS, _WIDE), _tile(_FEWER_ROWS, 1)
_row_wide, _row_narrow = _tile(1, _WIDE), _tile(1, 1)


@njit(cache=True)
def multiply(a, weight, shift, product):
    """Write ``shift + a @ weight``, of float32 matrices in C order, to ``product``, which must not overlap them.
    ``shift`` has one row, or as many as ``product``. Matrices that do not fit raise a ValueError.
    """
    rows, columns = product.shape
    if (len(a), weight.shape[1]) != (rows, columns) or a.shape[1] != len(weight):
        raise ValueError("multiply: expected a product of as many rows as its first matrix and columns as its second")
    if shift.shape[1] != columns or len(shift) not in (1, rows):
        raise ValueError("multiply: expected a shift of one row or of the product's, and of its columns")
    if columns >= LANES:
        _multiply_wide(a, weight, shift, product)
        return
    whole = np.empty((rows, LANES), dtype=np.float32)
    _multiply_wide(a, _widened(weight), _widened(shift), whole)
    for row in range(rows):
        for column in range(columns):
            product[row, column] = whole[row, column]


@njit(cache=True)
def _widened(values):
    wide = np.zeros((len(values), LANES), dtype=np.float32)
    for row in range(len(values)):
        for column in range(values.shape[1]):
            wide[row, column] = values[row, column]
    return wide


@njit(cache=True)
def _multiply_wide(a, weight, shift, product):
    """Multiply tile by tile. The last tiles may overlap the ones before, and then write the same values again."""
    rows, columns = product.shape
    is_fewer = -(-rows // _FEWER_ROWS) * _FEWER_ROWS < -(-rows // _ROWS) * _ROWS
    height = 1 if rows < _FEWER_ROWS else _FEWER_ROWS if is_fewer else _ROWS
    column = 0
    while column < columns:
        wide = column + _WIDE * LANES <= columns
        at = column if wide else min(column, columns - LANES)
        for first in range(0, rows, height):
            row = min(first, rows - height)
            if wide and height == _ROWS:
                _tile_wide(a, weight, shift, product, row, at)
            elif wide and height == _FEWER_ROWS:
                _fewer_wide(a, weight, shift, product, row, at)
            elif wide:
                _row_wide(a, weight, shift, product, row, at)
            elif height == _ROWS:
                _tile_narrow(a, weight, shift, product, row, at)
            elif height == _FEWER_ROWS:
                _fewer_narrow(a, weight, shift, product, row, at)
            else:
                _row_narrow(a, weight, shift, product, row, at)
        column += _WIDE * LANES if wide else LANES
