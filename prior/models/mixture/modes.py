"""The covariance of joints' accelerations, by which the body's joints are smoothed together.

Joints of a body accelerate together: six of the 22 eigenvectors of that covariance hold five sixths of it. It is the
same for x, y and z, so that it does not depend on the body's heading, and is learned from training motion
(`training.recipes.moments`).
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.models.weights import load_weights


@cache
def body_covariance(name: str = "default") -> NDArray[np.float64]:
    """(22, 22) covariance of joints' accelerations along an axis, relative to their mean variance; read-only.

    Args:
        name: a weight set or a path, as of `load_weights`.
    """
    covariance = load_weights(name, "body_modes")[0]["covariance"].astype(np.float64)
    covariance.flags.writeable = False
    return covariance
