"""What all sources of skeletons share: the interfaces of recorded and live ones, and the settings of cameras."""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from steadypose.msgs.security import Keys
from steadypose.msgs.types import Message, Pose, PoseRaw
from steadypose.nodes.checks.problem import Problem
from steadypose.nodes.graph.clock import Clock
from steadypose.nodes.settings import LaunchError, path_setting
from steadypose.prior.settings import check_range

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class CalibrationSettings:
    """``[input.calibration]``: the camera's lens and place, as ``steadypose calibrate`` writes them."""

    size: list[int] = field(default_factory=list)
    """pixels, width and height of the images that the lens was calibrated with"""
    focal: list[float] = field(default_factory=list)
    """fx, fy in pixels"""
    centre: list[float] = field(default_factory=list)
    """cx, cy in pixels"""
    distortion: list[float] = field(default_factory=list)
    """k1, k2, p1, p2, k3, as OpenCV has them"""
    position: list[float] = field(default_factory=list)
    """metres, world"""
    orientation: list[float] = field(default_factory=list)
    """xyzw, from the camera's optical frame to the world"""

    def __post_init__(self) -> None:
        lengths = {"size": (2,), "focal": (2,), "centre": (2,), "position": (3,), "orientation": (4,)}
        for name, allowed in (lengths | {"distortion": (4, 5)}).items():
            values = getattr(self, name)
            numbers = all(isinstance(v, int | float) and math.isfinite(v) for v in values)
            if values and not (numbers and len(values) in allowed):
                raise LaunchError(
                    f"[input.calibration] {name}: expected {' or '.join(map(str, allowed))} numbers, got {values}"
                )
        if bool(self.position) != bool(self.orientation):
            raise LaunchError("[input.calibration] expected position and orientation, or neither")
        if self.orientation and abs(math.hypot(*self.orientation) - 1.0) > 0.01:
            raise LaunchError(f"[input.calibration] orientation: expected a unit quaternion, got {self.orientation}")
        if bool(self.size) != bool(self.focal) or bool(self.size) != bool(self.centre):
            raise LaunchError("[input.calibration] expected size, focal and centre of a lens, or none of them")
        if any(value <= 0 for value in (*self.size, *self.focal)):
            raise LaunchError(f"[input.calibration] expected a size and focal above 0, got {self.size}, {self.focal}")

    @property
    def pose(self) -> Pose | None:
        """Of the camera in the world, if it is calibrated."""
        return Pose(np.array(self.position), np.array(self.orientation)) if self.position else None


MODEL = (
    "https://storage.googleapis.com/mediapipe-models/pose_landmarker/pose_landmarker_full/float16/latest/"
    "pose_landmarker_full.task"
)


@dataclass(frozen=True)
class OakSettings:
    """``[input.oak]``: an OAK camera."""

    device: str = ""
    """its id or, of one on the network, its address; empty: the first that is found"""
    model: str = ""
    """pose network of Luxonis' model zoo, COCO-17 key points; empty: the YOLO pose that suits the camera"""
    archive: str = path_setting()
    """a pose network in a file (NN archive, .tar.xz) instead of the zoo's; a relative path starts at the launch file"""
    fps: float = 0.0
    """frames a second; 0: what the camera's own network does"""
    confidence: float = 0.5
    """of a person, below which it is none"""

    def __post_init__(self) -> None:
        check_range("[input.oak] fps", self.fps, 0, 1000)
        check_range("[input.oak] confidence", self.confidence, 0, 1)


@dataclass(frozen=True)
class WebcamSettings:
    """``[input.webcam]``: any camera that the system knows, and MediaPipe."""

    camera: int = 0
    """its number: 0 is /dev/video0"""
    video: str = path_setting()
    """a video to read instead; a relative path starts at the launch file"""
    model: str = path_setting()
    """a pose landmarker for MediaPipe, a .task file, in place of its own, which finds one body; a relative path starts
    at the launch file"""
    bodies: int = 1
    """maximum number of bodies to detect; more than one with a model alone"""
    field_of_view: float = 1.05
    """radians, of the image's width, where the lens is not calibrated: scales how far away bodies seem"""

    def __post_init__(self) -> None:
        check_range("[input.webcam] camera", self.camera, 0, 1000)
        check_range("[input.webcam] bodies", self.bodies, 1, 64)
        check_range("[input.webcam] field_of_view", self.field_of_view, 0.1, 3.0)


class RecordedSource(Protocol):
    """Skeletons in order, each with its topic: ``pose/raw``, and ``pose/truth`` if the recording has it."""

    refused: Counter[str]
    """messages that could not be read, by cause"""

    def __len__(self) -> int:
        """The number of frames, those that cannot be read among them."""
        ...

    def __iter__(self) -> Iterator[tuple[str, Message]]: ...


class LiveSource(ABC):
    """Skeletons in real time, stamped with the wall time of their capture."""

    def __init__(self) -> None:
        self.refused: Counter[str] = Counter()
        """frames dropped or refused, by cause"""

    @abstractmethod
    def frames(self) -> Generator[PoseRaw | None, None, None]:
        """Skeletons, endlessly; None after a short time without one, so that the caller can check whether to stop."""

    @abstractmethod
    def status(self) -> dict[str, str]:
        """Values for `diagnostics`."""

    def problems(self) -> list[Problem]:
        """Present problems with the source."""
        return []


@dataclass(frozen=True)
class SourceContext:
    """What a source is given in addition to its own settings."""

    clock: Clock
    """of the input node"""
    calibration: CalibrationSettings
    """of the camera"""
    keys: Keys | None = None
    """for publishers on other machines"""
    clear_text: bool = False
    """whether to listen to other machines without keys"""
    image_file: Path | None = None
    """file that the newest image is kept in, for the viewer"""


class CameraError(RuntimeError):
    """A camera that cannot be used at present. The text says what is wrong."""


def count_failure(counts: Counter[str], camera: str, error: Exception) -> None:
    """Count a frame of a camera that could not be worked on, and log the first of its kind."""
    cause = f"frame: {type(error).__name__}"
    if cause not in counts:
        logger.error("%s: a frame failed; more are only counted", camera, exc_info=error)
    counts[cause] += 1
