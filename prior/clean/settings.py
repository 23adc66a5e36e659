"""Settings of the prior, stage by stage."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

from steadypose.prior.clean.bones import PersonSettings
from steadypose.prior.clean.fuse import FuseSettings
from steadypose.prior.clean.gate import GateSettings
from steadypose.prior.clean.identify import IdentifySettings
from steadypose.prior.clean.impute import ImputeSettings
from steadypose.prior.clean.reconstruct import DenoiseSettings, ReconstructSettings
from steadypose.prior.clean.rotations import OrientSettings, RefineSettings
from steadypose.prior.clean.score import ScoreSettings
from steadypose.prior.clean.sensor_error import CorrectSettings
from steadypose.prior.settings import build_settings, check_range, current_keys

logger = logging.getLogger(__name__)

MAX_DELAY = 16
"""Longest delay that the mixture of smoothers is trained for, frames."""

UNUSED = ("steps", "rate")
"""Keys of ``[prior.impute]`` in version 0.2, ignored with a warning. Gradient ascent in the latents gained nothing."""


@dataclass(frozen=True)
class SmoothSettings:
    """Settings of the smooth stage. There are no noise parameters to tune.

    Attributes:
        weights: weight set (``default``), or a path to a ``.safetensors`` file.
    """

    weights: str = "default"


@dataclass(frozen=True)
class PriorSettings:
    """Settings of the prior: ``[prior]`` of a launch file.

    Attributes:
        delay: look-ahead in frames at 30 Hz, from a frame to its output, 0 to 16. The default of 4 is half of HM-VAE's
            window, which gives the paper's centre-frame refinement.
        max_bodies: largest number of bodies tracked at once.
        timeout: seconds without an observation after which a body is dropped, and seconds without a frame after which
            the stream starts anew.
        bias_sigma: metres along an axis, expected standard deviation of the sensor's bias. It is the prior of the bias
            that is estimated from the stream, and a fault must exceed it. Depth cameras have 2 cm or more.
        identify: settings of the identify stage, which assigns body ids instead of the source (off by default).
        gate, correct, smooth, reconstruct, denoise, person, score, impute, refine, fuse, orient: settings of the
            stages.
    """

    delay: int = 4
    max_bodies: int = 8
    timeout: float = 0.5
    bias_sigma: float = 0.02
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
    orient: OrientSettings = field(default_factory=OrientSettings)

    def __post_init__(self) -> None:
        check_range("[prior] delay", self.delay, 0, MAX_DELAY)
        check_range("[prior] max_bodies", self.max_bodies, 1, 256)  # benchmarks run 256 bodies together
        check_range("[prior] timeout", self.timeout, 0.05, 60.0)
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
        settings = current_keys("prior", settings)
        impute = settings.get("impute")
        if isinstance(impute, Mapping) and (unused := [key for key in UNUSED if key in impute]):
            logger.warning("[prior.impute] %s: no longer used, and to be refused by a later version", ", ".join(unused))
            settings = {**settings, "impute": {key: value for key, value in impute.items() if key not in unused}}
        return build_settings(cls, settings, "prior")
