"""Joints of the trunk that the sensor lacks are means of its neighbours (`prior.body.mixtures`).

A mean tells nothing about the joints that it is made of, so the stages before do not count it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.body import mixtures
from steadypose.prior.clean.frame import Estimate


def mix(estimate: Estimate, unseen_s: Floats) -> Estimate:
    """Return a frame's estimate with means in place of joints that were never observed, by the seconds (S, 22) since
    each was (inf if never); rotations stay.
    """
    lacking = np.isinf(unseen_s) & np.isfinite(estimate.positions[:, :1, 0])
    if not (mixed := mixtures.mixed(lacking)).any():
        return estimate
    of_parts = np.einsum("jk,sk->sj", np.square(mixtures.SHARES), np.square(estimate.sigma))
    return replace(
        estimate,
        positions=mixtures.mix(estimate.positions, lacking),
        sigma=np.where(mixed, np.sqrt(np.square(mixtures.SIGMA) + of_parts), estimate.sigma),
    )
