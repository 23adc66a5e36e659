"""What compiled loops use in place of numpy's functions does what those do."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from steadypose.prior.compiled import median


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=30))
def test_the_median_is_numpys(values: list[float]) -> None:
    given_ = np.array(values)
    before = given_.copy()
    assert median(given_) == np.median(given_)
    assert np.array_equal(given_, before)
