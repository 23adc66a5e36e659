"""Settings of the cameras, apart from what drives them: reading a launch file must import no driver."""

from __future__ import annotations

from dataclasses import dataclass

from steadypose.nodes.graph.settings import path_setting
from steadypose.prior.settings import check_range

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
