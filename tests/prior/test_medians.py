import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from steadypose.prior.arrays import medians
from steadypose.prior.compiled import median


@pytest.mark.filterwarnings("ignore:All-NaN slice")
@pytest.mark.parametrize("count", [1, 2, 7, 22])
def test_medians_are_numpys_without_what_is_missing(count: int) -> None:
    rng = np.random.default_rng(count)
    values = rng.normal(size=(count, 40))
    values[rng.random(values.shape) < rng.random(40)] = np.nan
    for axis in (0, 1):
        assert np.array_equal(medians(values, axis), np.nanmedian(values, axis=axis), equal_nan=True)


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=30))
def test_the_median_of_loops_is_numpys(values: list[float]) -> None:
    given_ = np.array(values)
    before = given_.copy()
    assert median(given_) == np.median(given_)
    assert np.array_equal(given_, before)
