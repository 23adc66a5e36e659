"""Medians without what is missing."""

import numpy as np
import pytest

from steadypose.prior.arrays import medians


@pytest.mark.filterwarnings("ignore:All-NaN slice")
@pytest.mark.parametrize("count", [1, 2, 7, 22])
def test_medians_are_numpys_without_what_is_missing(count: int) -> None:
    rng = np.random.default_rng(count)
    values = rng.normal(size=(count, 40))
    values[rng.random(values.shape) < rng.random(40)] = np.nan
    for axis in (0, 1):
        assert np.array_equal(medians(values, axis), np.nanmedian(values, axis=axis), equal_nan=True)
