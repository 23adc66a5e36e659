"""What compiled loops use in place of numpy's functions, of which numba compiles every case for seconds."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def median(values):
    """The median of a few values (N,), N at least 1: by insertion, which leaves ``values`` as they are."""
    count = len(values)
    ordered = np.empty(count)
    for k in range(count):
        place = k
        while place > 0 and ordered[place - 1] > values[k]:
            ordered[place] = ordered[place - 1]
            place -= 1
        ordered[place] = values[k]
    return 0.5 * (ordered[(count - 1) // 2] + ordered[count // 2])
