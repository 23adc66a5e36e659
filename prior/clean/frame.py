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
    """A sensor's error, as standard deviations along an axis."""

    jitter_sigma: float  # metres, the error of a fully confident joint that is independent from frame to frame
    bias_sigma: float  # metres, the constant or slowly varying error, which no filter averages out


@dataclass(frozen=True)
class Observation:
    """The input of one time step of the 30 Hz grid."""

    stamp_s: float  # seconds since the stream began
    positions: Floats  # (S, 22, 3) canonical joints; NaN where unobserved
    confidence: Floats  # (S, 22) in 0..1
    present: Bools  # (S,) which slots hold a body that was observed in this frame or within the timeout
    sensor_position: Floats  # (3,) metres, position of the sensor
    layout_sigma: Floats  # (S, 22) metres along an axis, error of the joints that a layout interpolates


@dataclass(frozen=True)
class Gated:
    """An observation after outlier rejection."""

    observation: Observation  # the input
    positions: Floats  # (S, 22, 3) metres; NaN where unobserved or rejected
    jitter: Floats  # (S,) metres along an axis, noise that is independent from frame to frame, estimated for each body
    faulty: Bools  # (S, 22) joints for which the tracker repeats its last output, or that were mirrored back


@dataclass(frozen=True)
class BodyWindows:
    """The windows of the bodies present: as observed, and as HG-VAE reconstructs them."""

    slots: NDArray[np.intp]  # (B,) of the bodies
    tracks: Tracks  # the observed windows, each in its body's frame
    size: Floats  # (B,) size of each body (`body_size`)
    reconstruction: Reconstruction  # (B, 66, T) mean and standard deviation


@dataclass(frozen=True)
class Person:
    """The bones of every body."""

    offsets: Floats  # (S, 22, 3) metres, each joint in its parent's frame
    length_variance: Floats
    """(S, 22) metres^2, the part of each bone length's variance that further measurements will reduce; 0 for a generic
    adult"""
    measured: Bools  # (S,) True for the person's own bones, False for a generic adult's

    @classmethod
    def generic(cls, slots: int) -> Person:
        """A generic adult in every slot."""
        return cls(np.tile(REST_OFFSETS, (slots, 1, 1)), np.zeros((slots, 22)), np.zeros(slots, dtype=bool))


@dataclass(frozen=True)
class Score:
    """Anomaly of the observations (`prior.clean.score`)."""

    anomaly: Floats  # (S,) of the last half second; NaN if not scored
    flag: Bools  # (S,) whether the anomaly exceeds its threshold, with hysteresis
    joint_anomaly: Floats  # (S, 22) on the same scale; NaN where unobserved

    @classmethod
    def unscored(cls, slots: int) -> Score:
        """A score of NaN and a cleared flag in every slot."""
        return cls(np.full(slots, np.nan), np.zeros(slots, dtype=bool), np.full((slots, 22), np.nan))


class Imputed(NamedTuple):
    """The last K frames of every body, completed by HG-VAE, oldest first."""

    positions: Floats  # (K, S, 22, 3) metres; NaN for a body without hidden joints
    sigma: Floats  # (K, S, 22) metres, standard deviation along an axis


@dataclass(frozen=True)
class Estimate:
    """The estimate of one time step, for every slot."""

    stamp_s: float  # seconds since the stream began
    positions: Floats  # (S, 22, 3) metres; NaN for a body without an estimate
    rotations: Floats  # (S, 22, 3, 3) local rotations that match these positions
    offsets: Floats  # (S, 22, 3) metres, the person's bones
    sigma: Floats  # (S, 22) metres, standard deviation along an axis
    state: NDArray[np.uint8]  # (S, 22) `JointState`


@dataclass(frozen=True)
class CleanFrame:
    """The output of one time step."""

    estimate: Estimate  # of the joints
    score: Score  # the anomaly of the newest frame, which is ``delay`` frames later
    observed: Floats  # (S, 22, 3) metres, the input of the time step; NaN where unobserved
    confidence: Floats  # (S, 22) confidence of the input
