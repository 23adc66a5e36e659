"""The values that the steps of the pipeline hand to each other: frozen, made once, and read by whoever comes later.

S bodies stand in as many slots, in world-aligned coordinates (z up), metres and seconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.body.skeleton import REST_OFFSETS
from steadypose.prior.models.hgvae.features import Tracks
from steadypose.prior.models.hgvae.inference import LiveHGVAE, Reconstruction

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class SensorNoise:
    """What a sensor's joints are off by, standard deviations along an axis.

    Attributes:
        jitter_sigma: metres, from frame to frame, of a joint seen with full confidence.
        bias_sigma: metres, slowly: what no filter averages out.
    """

    jitter_sigma: float
    bias_sigma: float

    @property
    def total_sigma(self) -> float:
        """Metres, of both."""
        return float(np.hypot(self.bias_sigma, self.jitter_sigma))


@dataclass(frozen=True)
class Observation:
    """What came of one moment of the grid.

    Attributes:
        stamp_s: the moment, seconds since the stream began.
        positions: (S, 22, 3) canonical joints; NaN where unobserved.
        confidence: (S, 22) in 0..1.
        present: (S,) which slots hold a body, seen in this frame or a while ago.
        sensor_position: (3,) where the sensor stands.
    """

    stamp_s: float
    positions: Floats
    confidence: Floats
    present: Bools
    sensor_position: Floats


@dataclass(frozen=True)
class Gated:
    """An observation without what cannot be.

    Attributes:
        observation: of which this is left.
        positions: (S, 22, 3) metres; NaN where unobserved or refused.
        jitter: (S,) metres along an axis, how much each body's joints are found to jump about from frame to frame.
        frozen: (S, 22) joints of which the sensor repeats its last answer.
    """

    observation: Observation
    positions: Floats
    jitter: Floats
    frozen: Bools


@dataclass(frozen=True)
class BodyWindows:
    """The windows of the bodies present, seen and as HG-VAE would have them.

    Attributes:
        slots: (B,) whose windows these are.
        tracks: what was seen, each in its body's frame.
        confidence: (B, 66, T) of each entry; 0 where it was not seen.
        size: (B,) of the bodies, as `body_size` gives it.
        reconstruction: (B, 66, T) mean and standard deviation, what the model makes of them.
        model: which still stands at these windows.
    """

    slots: NDArray[np.intp]
    tracks: Tracks
    confidence: Floats
    size: Floats
    reconstruction: Reconstruction
    model: LiveHGVAE


@dataclass(frozen=True)
class Person:
    """Every body's bones.

    Attributes:
        offsets: (S, 22, 3) metres, each joint in its parent's frame.
        length_variance: (S, 22) metres^2, of each bone, still to be learned away; 0 of a generic adult's.
        measured: (S,) whether these are the person's own, not yet those of a generic adult.
    """

    offsets: Floats
    length_variance: Floats
    measured: Bools

    @classmethod
    def generic(cls, slots: int) -> Person:
        """A generic adult's."""
        return cls(np.tile(REST_OFFSETS, (slots, 1, 1)), np.zeros((slots, 22)), np.zeros(slots, dtype=bool))


@dataclass(frozen=True)
class Score:
    """Whether what was seen can be trusted.

    Attributes:
        anomaly: (S,) how unlike human motion the last half second is (`prior.clean.score`); NaN if not scored.
        flag: (S,) whether it is too much so.
        joint_anomaly: (S, 22) the same joint by joint; NaN where not seen.
    """

    anomaly: Floats
    flag: Bools
    joint_anomaly: Floats

    @classmethod
    def unscored(cls, slots: int) -> Score:
        """Of those of whom nothing is known."""
        return cls(np.full(slots, np.nan), np.zeros(slots, dtype=bool), np.full((slots, 22), np.nan))


class Imputed(NamedTuple):
    """The last frames of every body as HG-VAE completes them, the newest last.

    Attributes:
        positions: (K, S, 22, 3) metres; NaN for a body of which nothing is hidden.
        sigma: (K, S, 22) metres, standard deviation along an axis.
    """

    positions: Floats
    sigma: Floats


@dataclass(frozen=True)
class Estimate:
    """The prior's answer for one moment and every slot.

    Attributes:
        stamp_s: the moment, seconds.
        positions: (S, 22, 3) metres; NaN for a body of which nothing is known.
        rotations: (S, 22, 3, 3) local.
        offsets: (S, 22, 3) metres, the bones on which these rotations have these positions.
        sigma: (S, 22) metres, standard deviation along an axis.
        state: (S, 22) `JointState`.
    """

    stamp_s: float
    positions: Floats
    rotations: Floats
    offsets: Floats
    sigma: Floats
    state: NDArray[np.uint8]


@dataclass(frozen=True)
class CleanFrame:
    """All that is said of one moment.

    Attributes:
        estimate: where the joints are.
        score: as of the newest frame.
        observed: (S, 22, 3) metres, the joints that came in of that moment; NaN where unobserved.
        confidence: (S, 22) of those.
    """

    estimate: Estimate
    score: Score
    observed: Floats
    confidence: Floats
