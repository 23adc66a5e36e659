"""The posture stage: joints inform each other; and joints of the trunk that the sensor lacks (`mix`).

A filter over time cannot remove an error that lasts. Such an error contradicts the rest of the body, though: it bends a
spine sideways, or sets a knee where no knee is under that hip. The posterior mean of a Gaussian of postures
(`prior.models.posture`), given all joints with their variances and bone lengths, lies nearer to the truth, for people
and sensors unlike training too.

The Gaussian's covariance is that of training people times `SPREAD`, so that a dancer's posture is not drawn to theirs,
and a joint moves by a `SHARE` of the way, or less where its deviation is small. In fast motion, the smoother's
deviations exceed white noise, because it may lag; the posture knows nothing of a lag.
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

SPREAD = 8.0
"""Factor on the covariance of training people; 4 and 16 differ by 1 % (validation)."""

SHARE = 0.7
"""Share of the way to the expectation; with 1, joints of fast dancers in noise of 5 mm are further off than before."""

LITTLE = 0.003
"""Standard deviation along an axis at which the share is halved, metres: people's joints differ from the skeleton's."""

AT_MOST = 1.5  # largest standard deviation of an observed joint in white noise, relative to the noise
UNKNOWN_VARIANCE = 1e6  # largest variance of a joint along an axis that a mean's counts, m²


class Posture:
    """Moves joints towards their expectation given the whole body. It keeps no state."""

    def __init__(self, settings: PostureSettings) -> None:
        self._posture = LivePosture.load(settings.weights, SPREAD)

    def update(self, estimate: Estimate, lengths: Floats, noise: Floats, lasting: Floats) -> Estimate:
        """Return the estimate with joints, and in white noise deviations of observed ones, given the whole body.

        Args:
            estimate: of one frame; its deviations may leave out what no joint of the body shows.
            lengths: (S, 22) metres, length of each joint's bone.
            noise: (S,) metres along an axis, the sensor's jitter and lasting error, estimated from each body.
            lasting: (S,) certainty that this noise lasts, from 0 to 1.
        """
        slots = np.flatnonzero(np.isfinite(estimate.positions).all(axis=(1, 2)))
        if not len(slots):
            return estimate
        positions, sigma = estimate.positions.copy(), estimate.sigma.copy()
        observed = estimate.state[slots] == JointState.REFINED
        # where noise is white, or nothing is known of it yet, deviations are taken for at most the noise
        stated, sure = np.square(sigma[slots]), lasting[slots, None]
        limited = sure * stated + (1.0 - sure) * np.minimum(stated, np.square(AT_MOST * noise[slots, None]))
        variance = np.where(observed, limited, stated)
        expected = self._posture(positions[slots], np.sqrt(variance), lengths[slots])
        share = SHARE * variance / (variance + LITTLE**2)
        positions[slots] += share[..., None] * (expected.positions - positions[slots])
        # joints of a sensor whose errors last share many of them, so the others tell less than the Gaussian assumes
        surer = (1.0 - sure) * share * np.minimum(expected.sigma - sigma[slots], 0.0)
        sigma[slots] += np.where(observed, surer, 0.0)  # errors of a hidden joint are less like the Gaussian's
        return replace(estimate, positions=positions, sigma=sigma)


def mix(estimate: Estimate, unseen_s: Floats) -> Estimate:
    """Return a frame's estimate with means in place of joints of the trunk that were never observed, by the seconds
    (S, 22) since each was (inf if never); rotations stay. A mean tells nothing about the joints that it is made of, so
    the stages before do not count it.
    """
    lacking = np.isinf(unseen_s) & np.isfinite(estimate.positions[:, :1, 0])
    if not (mixed := mixtures.mixed(lacking)).any():
        return estimate
    variance = np.minimum(np.square(estimate.sigma), UNKNOWN_VARIANCE)  # 0 times infinity would be NaN
    of_parts = variance @ np.square(mixtures.SHARES).T
    return replace(
        estimate,
        positions=mixtures.mix(estimate.positions, lacking),
        sigma=np.where(mixed, np.sqrt(np.square(mixtures.SIGMA) + of_parts), estimate.sigma),
    )
