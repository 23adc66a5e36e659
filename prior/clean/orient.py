"""The orient stage: how each joint is turned, given where all joints are.

Two hips 18 cm apart, each with a bias, show the root's heading badly, and a straight limb does not show
its twist. Rotations are solved for where the joints are to be expected by the whole body (`prior.models.posture`), each
by its deviation; a filter keeps the twist through straight limbs (`prior.body.twist`). Positions stay as they are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from steadypose.prior.arrays import Bools
from steadypose.prior.body.inverse_kinematics import solve_rotations
from steadypose.prior.body.kinematics import global_rotations
from steadypose.prior.body.skeleton import PARENT
from steadypose.prior.body.twist import follow_twist, unknown_twist
from steadypose.prior.clean.frame import Estimate
from steadypose.prior.models.posture.inference import LivePosture


@dataclass(frozen=True)
class OrientSettings:
    """Settings of the orient stage.

    Attributes:
        enabled: off, rotations are those solved for the joints as published, frame by frame.
        weights: weight set (``default``, ``research``) or a path to a ``.safetensors`` file.
    """

    enabled: bool = True
    weights: str = "default"


class Orient:
    """Orientations of S bodies, frame by frame."""

    def __init__(self, settings: OrientSettings, slots: int) -> None:
        self._posture = LivePosture.load(settings.weights)
        self._twist = unknown_twist(slots)

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        self._twist[slot] = unknown_twist(1)

    def update(self, estimate: Estimate) -> Estimate:
        """The estimate with rotations by the whole body. Frames must come in order."""
        slots = np.flatnonzero(np.isfinite(estimate.positions).all(axis=(1, 2)))
        if not len(slots):
            return estimate
        sigma, offsets = estimate.sigma[slots], estimate.offsets[slots]
        expected = self._posture(estimate.positions[slots], sigma, offsets).positions
        turned = global_rotations(solve_rotations(expected, offsets, estimate.rotations[slots]))
        twist = self._twist[slots]
        follow_twist(turned, offsets, sigma, twist)
        self._twist[slots] = twist
        local = turned.copy()
        local[:, 1:] = turned[:, PARENT[1:]].swapaxes(-1, -2) @ turned[:, 1:]
        rotations = estimate.rotations.copy()
        rotations[slots] = local
        return replace(estimate, rotations=rotations)
