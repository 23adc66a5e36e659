"""A fixed numpy workload. Divide times by its time before you compare machines."""

from __future__ import annotations

import time

import numpy as np

ROUNDS = 50
SIZE = 44
"""Number of states of a whole body along one axis: positions and velocities of 22 joints."""
STEPS = 30


def numpy_ms() -> float:
    """Run 30 steps of a Kalman filter of 44 states `ROUNDS` times, and return the least time.

    The workload contains no code of this product. Times are the thread's processor time, milliseconds.
    """
    rng = np.random.default_rng(0)
    transition = np.eye(SIZE) + np.eye(SIZE, k=SIZE // 2) / 30
    process = np.cov(rng.standard_normal((SIZE, 4 * SIZE)))
    seen = rng.standard_normal((STEPS, SIZE // 2))
    took = []
    for _ in range(ROUNDS):
        state, covariance = np.zeros(SIZE), np.eye(SIZE)
        began = time.thread_time()
        for measured in seen:
            state, covariance = transition @ state, transition @ covariance @ transition.T + process
            gain = np.linalg.solve(covariance[: SIZE // 2, : SIZE // 2] + np.eye(SIZE // 2), covariance[: SIZE // 2]).T
            state = state + gain @ (measured - state[: SIZE // 2])
            covariance = covariance - gain @ covariance[: SIZE // 2]
        took.append(time.thread_time() - began)
    return 1e3 * min(took)
