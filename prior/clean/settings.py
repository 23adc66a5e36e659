"""Settings of the prior, stage by stage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

from steadypose.prior.settings import build_settings, check_range, weights_setting

MAX_DELAY = 16  # longest delay that the mixture of smoothers is trained for, frames

RECENT_S = 0.25
"""Longest time without an observation after which `identify` matches a body by position alone, seconds. Later, bone
lengths must match as well."""


@dataclass(frozen=True)
class IdentifySettings:
    """Settings of the identify stage."""

    enabled: bool = False
    """whether to assign ids here and ignore the source's; if off, the source's ids are passed on"""
    birth: float = 0.25
    """seconds for which an unknown body must be observed before it gets an id"""
    death: float = 5.0
    """seconds without an observation after which a person is forgotten. On return, the person gets a new id"""


@dataclass(frozen=True)
class GateSettings:
    """Thresholds of the gate."""

    enabled: bool = True
    """whether to reject outliers; if off, all observed joints pass"""
    jump: float = 0.18
    """metres that a joint may be from its prediction, in addition to three standard deviations of the prediction"""
    patience: float = 0.3
    """seconds after which a joint that is rejected in every frame is accepted, and a limb that is exchanged in every
    frame, unless only so it makes a human posture"""
    min_confidence: float = 0.1
    """joints of lower confidence count as unobserved"""


@dataclass(frozen=True)
class CorrectSettings:
    """Settings of the correct stage."""

    sensor: str = weights_setting("correction", default="")
    """``kinect_v2``, or empty for a sensor whose error is not known. The error belongs to the sensor, not to its joint
    layout: another camera with the same joints has other errors"""


@dataclass(frozen=True)
class SmoothSettings:
    """Settings of the smooth stage. There are no noise parameters to tune."""

    weights: str = weights_setting("mixture")
    """weight set (``default``), or a path to a ``.safetensors`` file"""


@dataclass(frozen=True)
class ReconstructSettings:
    """Settings of the reconstruct stage (``[prior.reconstruct]``)."""

    weights: str = weights_setting("hgvae")
    """weight set (``default``, ``research``) or a path to a ``.safetensors`` file"""


@dataclass(frozen=True)
class DenoiseSettings:
    """Settings of the denoise stage."""

    enabled: bool = True
    """whether to denoise; if off, observed joints stay as smoothed"""


@dataclass(frozen=True)
class PersonSettings:
    """Settings of the person stage."""

    enabled: bool = True
    """whether to measure bones; if off, every body has a generic adult's bones"""
    samples: int = 64
    """frames sampled before the estimate is frozen"""
    every: int = 5
    """frames between two samples, so that their errors are less correlated"""


@dataclass(frozen=True)
class ScoreSettings:
    """Settings of the score stage."""

    enabled: bool = True
    """whether to score; if off, the anomaly is NaN and the flag is not set"""
    false_alarms: float = 0.001
    """share of frames of clean motion that may be flagged; 0.01 is one frame every three seconds"""
    hold: float = 0.3
    """seconds for which the anomaly must stay below `score.RELEASED` times the threshold for the flag to clear"""


@dataclass(frozen=True)
class ImputeSettings:
    """Settings of the impute stage."""

    enabled: bool = True
    """whether to impute; if off, hidden joints keep their last local rotations"""


@dataclass(frozen=True)
class RefineSettings:
    """Settings of the refine stage."""

    enabled: bool = False
    """whether to refine. If off (the default), the solved rotations pass unchanged and no model is loaded. With
    `impute` and `fuse` on, observed joints stay as smoothed and hidden joints as completed. Refinement then changes
    no result by 0.1 mm (validation people, benchmarks/NOTEBOOK.md)"""
    weights: str = weights_setting("hmvae")
    """weight set (``default``, ``research``) or a path to a ``.safetensors`` file"""


@dataclass(frozen=True)
class FuseSettings:
    """Settings of the fuse stage. Standard deviations are along one axis."""

    enabled: bool = True
    """whether to fuse; if off, the body has the decoded rotations, translated to fit the observed joints"""
    prior_sigma: float = 0.1
    """metres, standard deviation of a joint placed by the decoded rotations in a well observed body"""
    prior_drift: float = 0.25
    """m/s, growth of this deviation for an unobserved joint"""
    fade: float = 3.0
    """seconds after which a joint that is neither observed nor completed within `fuse.MAX_SIGMA` is unknown"""
    weights: str = weights_setting("occlusion")
    """weight set of the occlusion network, or a path to a ``.safetensors`` file"""


@dataclass(frozen=True)
class PostureSettings:
    """Settings of the posture stage."""

    enabled: bool = True
    """whether joints inform each other; if off, they stay as fused"""
    weights: str = weights_setting("posture")
    """weight set (``default``, ``research``) or a path to a ``.safetensors`` file"""


@dataclass(frozen=True)
class SteadySettings:
    """Settings of the steady stage."""

    enabled: bool = True
    """whether revisions take a few frames; if off, observed joints stay as they are estimated"""


@dataclass(frozen=True)
class OrientSettings:
    """Settings of the orient stage."""

    enabled: bool = True
    """whether to orient; if off, rotations are solved frame by frame from the published joints"""
    weights: str = weights_setting("posture")
    """weight set (``default``, ``research``) or a path to a ``.safetensors`` file"""


@dataclass(frozen=True)
class PriorSettings:
    """Settings of the prior: ``[prior]`` of a launch file. Each stage has its own."""

    delay: int = 4
    """frames at 30 Hz, look-ahead from a frame to its output, 0 to 16. The default is half of HM-VAE's window, which
    gives the paper's centre-frame refinement"""
    max_bodies: int = 8
    """largest number of bodies tracked at once"""
    timeout: float = 0.5
    """seconds without an observation after which a body is dropped, and seconds without a frame after which the stream
    starts anew"""
    bias_sigma: float = 0.02
    """metres along an axis, expected standard deviation of the sensor's bias. It is the prior of the bias that is
    estimated from the stream, and a fault must exceed it. Depth cameras have 2 cm or more"""
    identify: IdentifySettings = field(default_factory=IdentifySettings)
    gate: GateSettings = field(default_factory=GateSettings)
    correct: CorrectSettings = field(default_factory=CorrectSettings)
    smooth: SmoothSettings = field(default_factory=SmoothSettings)
    reconstruct: ReconstructSettings = field(default_factory=ReconstructSettings)
    denoise: DenoiseSettings = field(default_factory=DenoiseSettings)
    person: PersonSettings = field(default_factory=PersonSettings)
    score: ScoreSettings = field(default_factory=ScoreSettings)
    impute: ImputeSettings = field(default_factory=ImputeSettings)
    refine: RefineSettings = field(default_factory=RefineSettings)
    fuse: FuseSettings = field(default_factory=FuseSettings)
    posture: PostureSettings = field(default_factory=PostureSettings)
    steady: SteadySettings = field(default_factory=SteadySettings)
    orient: OrientSettings = field(default_factory=OrientSettings)

    def __post_init__(self) -> None:
        check_range("[prior] delay", self.delay, 0, MAX_DELAY)
        check_range("[prior] max_bodies", self.max_bodies, 1, 256)  # benchmarks run 256 bodies together
        check_range("[prior] timeout", self.timeout, 0.05, 60.0)
        check_range("[prior] bias_sigma", self.bias_sigma, 0.0, 1.0)
        check_range("[prior.identify] birth", self.identify.birth, 0.0, 60.0)
        # a shorter `death` would drop tracks that can still be matched by position
        check_range("[prior.identify] death", self.identify.death, RECENT_S, 60.0)
        check_range("[prior.gate] min_confidence", self.gate.min_confidence, 0.0, 1.0)
        check_range("[prior.person] samples", self.person.samples, 1, 1e6)
        check_range("[prior.person] every", self.person.every, 1, 1e6)
        for section in (f.name for f in fields(self) if is_dataclass(getattr(self, f.name))):
            stage = getattr(self, section)
            for f in fields(stage):
                if isinstance(value := getattr(stage, f.name), int | float):
                    check_range(f"[prior.{section}] {f.name}", value, 0, 1e6)

    @classmethod
    def from_dict(cls, settings: Mapping[str, Any]) -> PriorSettings:
        """Build the settings from the section of a launch file.

        Raises:
            ValueError: for an unknown key (the message names the most similar one) or a wrong type.
        """
        return build_settings(cls, settings, "prior")
