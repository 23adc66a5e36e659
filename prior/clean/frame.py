"""Frozen values that the stages of the pipeline pass to each other.

Each of the S slots holds one body. Coordinates are world-aligned (z up), in metres and seconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.skeleton import REST_OFFSETS
from steadypose.prior.models.hgvae.features import Tracks
from steadypose.prior.models.hgvae.inference import Reconstruction


@dataclass(frozen=True)
class SensorNoise:
    """A sensor's error, as standard deviations along an axis.

    Attributes:
        jitter_sigma: metres, the error of a fully confident joint that is independent from frame to frame.
        bias_sigma: metres, the constant or slowly varying error, which no filter averages out.
    """

    jitter_sigma: float
    bias_sigma: float


@dataclass(frozen=True)
class Observation:
    """The input of one time step of the 30 Hz grid.

    Attributes:
        stamp_s: seconds since the stream began.
        positions: (S, 22, 3) canonical joints; NaN where unobserved.
        confidence: (S, 22) in 0..1.
        present: (S,) which slots hold a body that was observed in this frame or within the timeout.
        sensor_position: (3,) metres, position of the sensor.
        layout_sigma: (S, 22) metres along an axis, error of the joints that a layout interpolates.
    """

    stamp_s: float
    positions: Floats
    confidence: Floats
    present: Bools
    sensor_position: Floats
    layout_sigma: Floats


@dataclass(frozen=True)
class Gated:
    """An observation after outlier rejection.

    Attributes:
        observation: the input.
        positions: (S, 22, 3) metres; NaN where unobserved or rejected.
        jitter: (S,) metres along an axis, noise that is independent from frame to frame, estimated for each body.
        faulty: (S, 22) joints for which the tracker repeats its last output, or that were mirrored back.
    """

    observation: Observation
    positions: Floats
    jitter: Floats
    faulty: Bools


@dataclass(frozen=True)
class BodyWindows:
    """The windows of the bodies present: as observed, and as HG-VAE reconstructs them.

    Attributes:
        slots: (B,) of the bodies.
        tracks: the observed windows, each in its body's frame.
        size: (B,) size of each body (`body_size`).
        reconstruction: (B, 66, T) mean and standard deviation.
    """

    slots: NDArray[np.intp]
    tracks: Tracks
    size: Floats
    reconstruction: Reconstruction


@dataclass(frozen=True)
class Person:
    """The bones of every body.

    Attributes:
        offsets: (S, 22, 3) metres, each joint in its parent's frame.
        length_variance: (S, 22) metres^2, the part of each bone length's variance that further measurements will
            reduce; 0 for a generic adult.
        measured: (S,) True for the person's own bones, False for a generic adult's.
    """

    offsets: Floats
    length_variance: Floats
    measured: Bools

    @classmethod
    def generic(cls, slots: int) -> Person:
        """A generic adult in every slot."""
        return cls(np.tile(REST_OFFSETS, (slots, 1, 1)), np.zeros((slots, 22)), np.zeros(slots, dtype=bool))


@dataclass(frozen=True)
class Score:
    """Anomaly of the observations (`prior.clean.score`).

    Attributes:
        anomaly: (S,) of the last half second; NaN if not scored.
        flag: (S,) whether the anomaly exceeds its threshold, with hysteresis.
        joint_anomaly: (S, 22) on the same scale; NaN where unobserved.
    """

    anomaly: Floats
    flag: Bools
    joint_anomaly: Floats

    @classmethod
    def unscored(cls, slots: int) -> Score:
        """A score of NaN and a cleared flag in every slot."""
        return cls(np.full(slots, np.nan), np.zeros(slots, dtype=bool), np.full((slots, 22), np.nan))


class Imputed(NamedTuple):
    """The last K frames of every body, completed by HG-VAE, oldest first.

    Attributes:
        positions: (K, S, 22, 3) metres; NaN for a body without hidden joints.
        sigma: (K, S, 22) metres, standard deviation along an axis.
    """

    positions: Floats
    sigma: Floats


@dataclass(frozen=True)
class Estimate:
    """The estimate of one time step, for every slot.

    Attributes:
        stamp_s: seconds since the stream began.
        positions: (S, 22, 3) metres; NaN for a body without an estimate.
        rotations: (S, 22, 3, 3) local rotations that match these positions.
        offsets: (S, 22, 3) metres, the person's bones.
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
    """The output of one time step.

    Attributes:
        estimate: of the joints.
        score: the anomaly of the newest frame, which is ``delay`` frames later.
        observed: (S, 22, 3) metres, the input of the time step; NaN where unobserved.
        confidence: (S, 22) confidence of the input.
    """

    estimate: Estimate
    score: Score
    observed: Floats
    confidence: Floats
