"""Products of small matrices: as numpy has them, and each row alone as among others."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import TypingError

from steadypose.prior.models.matmul import multiply, multiply_packed, packed


def matrices(rows: int, inner: int, columns: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    shapes = (rows, inner), (inner, columns), (rows, columns)
    a, weight, shift = (rng.standard_normal(shape).astype(np.float32) for shape in shapes)
    return a, weight, shift


def product(a: np.ndarray, weight: np.ndarray, shift: np.ndarray) -> np.ndarray:
    written = np.full((len(a), weight.shape[1]), np.nan, dtype=np.float32)
    multiply(a, weight, shift, written)
    return written


@given(st.integers(1, 70), st.integers(1, 70), st.integers(1, 150), st.booleans(), st.integers(0, 99))
def test_it_is_the_product_of_numpy(rows: int, inner: int, columns: int, one_shift: bool, seed: int) -> None:
    a, weight, shift = matrices(rows, inner, columns, seed)
    shift = shift[:1] if one_shift else shift
    found, of_packed = product(a, weight, shift), np.full((rows, columns), np.nan, dtype=np.float32)
    np.testing.assert_allclose(found, shift + a.astype(float) @ weight, atol=2e-4)
    multiply_packed(a, packed(weight), shift, of_packed)
    np.testing.assert_array_equal(of_packed, found)


@pytest.mark.parametrize("rows", [2, 5, 6, 7, 10, 13, 20])
def test_a_row_does_not_depend_on_the_others(rows: int) -> None:
    a, weight, shift = matrices(rows, 300, 80, 0)
    together = product(a, weight, shift)
    for row in range(rows):
        alone = product(a[row : row + 1], weight, shift[row : row + 1])
        np.testing.assert_array_equal(alone[0], together[row])


@pytest.mark.parametrize("matrix", range(4))
@pytest.mark.parametrize("change", [lambda m: m.astype(float), np.asfortranarray, lambda m: m[None]])
def test_other_arrays_are_refused(matrix: int, change) -> None:
    """The instructions read memory as float32 row by row, whatever it holds."""
    arrays = [*matrices(20, 20, 20, 0), np.zeros((20, 20), dtype=np.float32)]
    arrays[matrix] = change(arrays[matrix])
    with pytest.raises(TypingError):
        multiply(*arrays)


@pytest.mark.parametrize("matrix", range(4))
@pytest.mark.parametrize("axis", [0, 1])
def test_matrices_that_do_not_fit_are_refused(matrix: int, axis: int) -> None:
    arrays = [*matrices(20, 20, 20, 0), np.zeros((20, 20), dtype=np.float32)]
    arrays[matrix] = np.ascontiguousarray(arrays[matrix].take(range(15), axis))
    with pytest.raises(ValueError, match="multiply: expected"):
        multiply(*arrays)
    with pytest.raises(ValueError, match="multiply: expected"):
        multiply_packed(arrays[0], packed(arrays[1]), *arrays[2:])
