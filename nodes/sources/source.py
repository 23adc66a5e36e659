"""Shared by all sources of skeletons: the interfaces of recorded and live sources, and the settings of cameras."""

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
    """``[input.calibration]``: the camera's lens and pose, as ``steadypose calibrate`` writes them."""

    size: list[int] = field(default_factory=list)
    """width and height in pixels of the images that the lens was calibrated with"""
    focal: list[float] = field(default_factory=list)
    """fx, fy in pixels"""
    centre: list[float] = field(default_factory=list)
    """cx, cy in pixels"""
    distortion: list[float] = field(default_factory=list)
    """k1, k2, p1, p2, k3, as in OpenCV"""
    position: list[float] = field(default_factory=list)
    """position of the camera in the world, metres"""
    orientation: list[float] = field(default_factory=list)
    """quaternion xyzw, rotates from the camera's optical frame to the world"""

    def __post_init__(self) -> None:
        lengths = {"size": (2,), "focal": (2,), "centre": (2,), "position": (3,), "orientation": (4,)}
        for name, allowed in (lengths | {"distortion": (4, 5)}).items():
            values = getattr(self, name)
            numbers = all(isinstance(v, int | float) and math.isfinite(v) for v in values)
            if values and not (numbers and len(values) in allowed):
                expected = " or ".join(map(str, allowed))
                raise LaunchError(f"[input.calibration] {name}: expected {expected} numbers, got {values}")
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
        """Pose of the camera in the world; None if it is not calibrated."""
        return Pose(np.array(self.position), np.array(self.orientation)) if self.position else None


_SITE = "https://storage.googleapis.com/mediapipe-models"
MODEL = f"{_SITE}/pose_landmarker/pose_landmarker_full/float16/latest/pose_landmarker_full.task"


@dataclass(frozen=True)
class OakSettings:
    """``[input.oak]``: an OAK camera."""

    device: str = ""
    """id of the camera, or its address on the network; empty: the first camera found"""
    model: str = ""
    """pose network of Luxonis' model zoo with COCO-17 key points; empty: the YOLO pose network for the camera's
    platform"""
    archive: str = path_setting()
    """pose network in a file (NN archive, .tar.xz) instead of the zoo's; relative to the launch file"""
    fps: float = 0.0
    """frame rate, Hz; 0: the usual rate of the default network"""
    confidence: float = 0.5
    """smallest confidence of a detected person, 0 to 1"""

    def __post_init__(self) -> None:
        check_range("[input.oak] fps", self.fps, 0, 1000)
        check_range("[input.oak] confidence", self.confidence, 0, 1)


@dataclass(frozen=True)
class WebcamSettings:
    """``[input.webcam]``: any camera of the system, with MediaPipe."""

    camera: int = 0
    """number of the camera: 0 is /dev/video0"""
    video: str = path_setting()
    """video to read instead of a camera; relative to the launch file"""
    model: str = path_setting()
    """pose landmarker for MediaPipe (.task file) instead of the built-in one, which detects one body; relative to the
    launch file"""
    bodies: int = 1
    """largest number of bodies to detect; more than one only with ``model``"""
    field_of_view: float = 1.05
    """horizontal field of view of an uncalibrated lens, radians; it scales the distance of bodies"""
    name: str = ""
    """source name in messages; empty for webcam- and its number. Cameras that are merged or share a server need
    different names"""

    def __post_init__(self) -> None:
        check_range("[input.webcam] camera", self.camera, 0, 1000)
        check_range("[input.webcam] bodies", self.bodies, 1, 64)
        check_range("[input.webcam] field_of_view, in radians", self.field_of_view, 0.1, 3.0)


class RecordedSource(Protocol):
    """Recorded messages in order, each with its topic: ``pose/raw``, and ``pose/truth`` if the recording has it."""

    path: Path
    """the file, or a name in errors"""
    refused: Counter[str]
    """number of messages that could not be read, by cause"""

    def __len__(self) -> int:
        """Number of frames, including unreadable ones."""
        ...

    def __iter__(self) -> Iterator[tuple[str, Message]]: ...


class LiveSource(ABC):
    """Skeletons in real time, stamped with the wall time of their capture."""

    def __init__(self) -> None:
        self.refused: Counter[str] = Counter()
        """number of frames dropped or refused, by cause"""

    @abstractmethod
    def frames(self) -> Generator[PoseRaw | None, None, None]:
        """Skeletons without end; None after a short time without one, so that the caller can check whether to stop."""

    @abstractmethod
    def status(self) -> dict[str, str]:
        """The source's entries in `diagnostics`."""

    def problems(self) -> list[Problem]:
        """Current problems of the source."""
        return []


@dataclass(frozen=True)
class SourceContext:
    """What a source receives besides its own settings."""

    clock: Clock
    """the input node's clock"""
    calibration: CalibrationSettings
    """the camera's calibration"""
    keys: Keys | None = None
    """keys for publishers on other machines"""
    clear_text: bool = False
    """whether to subscribe to other machines without keys"""
    image_file: Path | None = None
    """file for the newest image, for the viewer"""


class CameraError(RuntimeError):
    """A camera that cannot be used at present. The text says why."""


def count_failure(counts: Counter[str], camera: str, error: Exception) -> None:
    """Count a camera's frame that could not be processed, and log the first of its kind."""
    cause = f"frame: {type(error).__name__}"
    if cause not in counts:
        logger.error("%s: a frame failed; any more are only counted", camera, exc_info=error)
    counts[cause] += 1
