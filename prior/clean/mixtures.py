"""Joints of the trunk that a sensor lacks and that are means of others by definition (`MIXTURES`).

Inverse kinematics places such a joint on the rest pose's bones, whose directions differ between people. The mean needs
no bones. It tells nothing about the joints that it is made of, so the stages before and orientations do not count it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.skeleton import JOINTS, MIXTURES, J
from steadypose.prior.clean.frame import Estimate

_MIXED = [J[joint] for joint in MIXTURES]
_SHARES = np.array([[mixture.get(joint, 0.0) for joint in JOINTS] for mixture in MIXTURES.values()])
_SIGMA = np.array([0.008 if joint == "spine1" else 0.003 for joint in MIXTURES])
"""(4,) metres along an axis, standard deviation of each mean of exact joints (validation: 0.009, 0.003 for spines)."""
_SPINE: Bools = np.array([joint.startswith("spine") for joint in MIXTURES])


def mix(estimate: Estimate, unseen_s: Floats) -> Estimate:
    """Return the estimate with mixtures in place of joints that were never observed; rotations stay.

    A spine between joints that were not observed either follows from the rotations better.

    Args:
        estimate: of one frame.
        unseen_s: (S, 22) seconds since each joint was last observed, inf if never.
    """
    ends = np.isfinite(unseen_s[:, J["pelvis"]] + unseen_s[:, J["spine3"]])[:, None]
    there = np.isfinite(estimate.positions[:, :1, 0])
    row, mixed = np.nonzero(np.isinf(unseen_s[:, _MIXED]) & (ends | ~_SPINE) & there)
    if not len(row):
        return estimate
    joint, shares = np.array(_MIXED)[mixed], _SHARES[mixed]
    positions, sigma = estimate.positions.copy(), estimate.sigma.copy()
    positions[row, joint] = (shares[..., None] * estimate.positions[row]).sum(axis=1)
    sigma[row, joint] = np.sqrt(_SIGMA[mixed] ** 2 + np.square(shares * estimate.sigma[row]).sum(axis=1))
    return replace(estimate, positions=positions, sigma=sigma)
