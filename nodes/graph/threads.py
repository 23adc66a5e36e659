"""One thread for a process whose products are small."""

from __future__ import annotations

import scipy.linalg  # noqa: F401  (loads the BLAS that compiled loops use, so that it is limited too)
from threadpoolctl import threadpool_limits


def one_thread() -> None:
    """Keep the BLAS of numpy and scipy, and of torch where it is loaded, to the calling thread, from now on.

    Two threads that share the cores with other nodes wait for each other: eight bodies take a prior twice as long, and
    three times as much of the processors.
    """
    threadpool_limits(1)
