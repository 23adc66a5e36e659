"""The posture stage: the posterior mean of each body under a Gaussian of postures; and joints of the trunk that the
sensor lacks (`mix`).

A filter over time cannot remove a constant or slowly varying error. But such an error makes a posture unlikely: it
bends a spine sideways, or moves a knee out of line with hip and foot. The posterior mean of a Gaussian of postures
(`prior.models.posture`), given all joints with their variances and bone lengths, is nearer to the truth, for people and
sensors unlike training too.

The Gaussian has the covariance of training people times `WIDE`, so that it hardly biases unusual postures, or times
`NARROW` in time-correlated noise. A joint moves by a `SHARE` of the way, or less where its deviation is small. In fast
motion the smoother may lag, and its deviations exceed the white noise by this lag, of which the posture shows nothing.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from steadypose.msgs.types import JointState
from steadypose.prior.arrays import Floats
from steadypose.prior.body import mixtures
from steadypose.prior.clean.frame import Estimate
from steadypose.prior.clean.settings import PostureSettings
from steadypose.prior.models.posture import LivePosture

WIDE, NARROW = 8.0, 2.0
"""Factors on the covariance of training people, in white and in time-correlated noise. In white noise of 2 mm,
2 costs dancers 1.6 %; in time-correlated noise of 2 and 4 cm it gains 1 and 2.6 % (validation)."""

SHARE = 0.7
"""Share of the way to the expectation. With 1, the error of fast dancers in noise of 5 mm increases."""

LITTLE = 0.003
"""Standard deviation along an axis at which the share is halved, metres: people's joints differ from the skeleton's."""

AT_MOST = 1.5  # largest standard deviation of an observed joint in white noise, relative to the noise
UNKNOWN_VARIANCE = 1e6  # upper bound of the variance of a joint along an axis in `mix`, m²


class Posture:
    """Moves joints towards their expectation given the whole body. It keeps no state."""

    def __init__(self, settings: PostureSettings) -> None:
        self._posture = LivePosture.load(settings.weights)

    def update(self, estimate: Estimate, lengths: Floats, noise: Floats, correlated: Floats) -> Estimate:
        """Return the estimate given the whole body: its positions and, in white noise, observed joints' deviations.

        Args:
            estimate: of one frame.
            lengths: (S, 22) metres, length of each joint's bone.
            noise: (S,) metres along an axis, the sensor's jitter and time-correlated error, estimated from each body.
            correlated: (S,) certainty that this noise is time-correlated, 0 to 1.
        """
        slots = np.flatnonzero(np.isfinite(estimate.positions).all(axis=(1, 2)))
        if not len(slots):
            return estimate
        positions, sigma = estimate.positions.copy(), estimate.sigma.copy()
        observed = estimate.state[slots] == JointState.REFINED
        # in noise that is white or not known yet, the noise bounds the deviations of observed joints
        square, sure = np.square(sigma[slots]), correlated[slots, None]
        limited = sure * square + (1.0 - sure) * np.minimum(square, np.square(AT_MOST * noise[slots, None]))
        variance = np.where(observed, limited, square)
        spread = WIDE * (NARROW / WIDE) ** correlated[slots]
        expected = self._posture(positions[slots], np.sqrt(variance), lengths[slots], spread)
        share = SHARE * variance / (variance + LITTLE**2)
        positions[slots] += share[..., None] * (expected.positions - positions[slots])
        # Time-correlated errors of a body's joints are correlated with each other, so its other joints are worth less
        # than the Gaussian assumes. Errors of hidden joints are not Gaussian.
        reduction = (1.0 - sure) * share * np.minimum(expected.sigma - sigma[slots], 0.0)
        sigma[slots] += np.where(observed, reduction, 0.0)
        return replace(estimate, positions=positions, sigma=sigma)


def mix(estimate: Estimate, unobserved_s: Floats) -> Estimate:
    """Return a frame's estimate with means of neighbours (`body.mixtures`) in place of joints of the trunk that were
    never observed: those for which ``unobserved_s`` (S, 22), the seconds since a joint was observed, is infinite.

    Rotations stay. A mean adds no information about its neighbours, so it is taken after all stages that use joints.
    """
    lacking = np.isinf(unobserved_s) & np.isfinite(estimate.positions[:, :1, 0])
    if not (mixed := mixtures.mixed(lacking)).any():
        return estimate
    variance = np.minimum(np.square(estimate.sigma), UNKNOWN_VARIANCE)  # 0 times infinity would be NaN
    of_parts = variance @ np.square(mixtures.SHARES).T
    return replace(
        estimate,
        positions=mixtures.mix(estimate.positions, lacking),
        sigma=np.where(mixed, np.sqrt(np.square(mixtures.SIGMA) + of_parts), estimate.sigma),
    )
