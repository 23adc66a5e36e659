"""One thread for a process whose products are small."""

from __future__ import annotations

import scipy.linalg  # noqa: F401  (loads the BLAS that compiled loops use, so that it is limited too)
import torch
from threadpoolctl import threadpool_limits


def one_thread() -> None:
    """Keep torch and the BLAS of numpy and scipy to the calling thread, from now on.

    Two threads that share the cores with other nodes wait for each other: with torch a p99 of 100 ms; with numpy, eight
    bodies take a prior twice as long, and three times as much of the processors.
    """
    torch.set_num_threads(1)
    threadpool_limits(1)
