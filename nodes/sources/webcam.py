"""Any camera of the system, with MediaPipe's pose landmarker: without depth, distances follow from the body's size.

MediaPipe is an optional extra; it brings a model that finds one body, others are files of their own (docs/sources.md
says where from). What runs with OpenCV and MediaPipe is in `nodes.sources.webcam_device`.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING

from steadypose.nodes.graph.clock import Clock
from steadypose.nodes.graph.settings import LaunchError
from steadypose.nodes.sources.calibration import CalibrationSettings
from steadypose.nodes.sources.camera import CameraSource, Connection
from steadypose.nodes.sources.camera_settings import MODEL, WebcamSettings
from steadypose.nodes.sources.source import SourceContext

if TYPE_CHECKING:
    from steadypose.nodes.sources.webcam_video import VideoSource


def open_webcam(settings: WebcamSettings, context: SourceContext) -> WebcamSource | VideoSource:
    """The camera, or the film in its place.

    Raises:
        LaunchError: the model is missing, or a setting cannot be used.
    """
    if settings.model and not Path(settings.model).is_file():
        raise LaunchError(
            f"[input.webcam] model: expected a pose landmarker for MediaPipe, a .task file, got {settings.model!r}; "
            f"download one, such as {MODEL}, or leave it out: MediaPipe's own finds one body"
        )
    if settings.bodies > 1 and not settings.model:
        raise LaunchError(
            f"[input.webcam] bodies: MediaPipe's own model finds one, got {settings.bodies}; for more, give a model, "
            f"such as {MODEL}"
        )
    if not settings.video:
        return WebcamSource(settings, context)
    from steadypose.nodes.sources.webcam_video import VideoSource  # brings OpenCV

    return VideoSource(settings, context.calibration)  # pyright: ignore[reportArgumentType]  (one class, found under two names)


Connect = Callable[[WebcamSettings, CalibrationSettings, Clock], AbstractContextManager[Connection]]
"""opens the camera; raises RuntimeError if it cannot be opened now"""


class WebcamSource(CameraSource):
    """The skeletons that MediaPipe sees in a webcam's pictures."""

    def __init__(self, settings: WebcamSettings, context: SourceContext, connect: Connect | None = None) -> None:
        super().__init__(context)
        self._settings, self._calibration, self._connect = settings, context.calibration, connect

    def connect(self) -> AbstractContextManager[Connection]:
        if self._connect is None:
            from steadypose.nodes.sources.webcam_device import connect  # brings OpenCV

            self._connect = connect
        return self._connect(self._settings, self._calibration, self._clock)  # pyright: ignore[reportArgumentType]
