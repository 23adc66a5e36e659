"""OAK cameras as the source; what runs with depthai is in `nodes.sources.oak_device`."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

from steadypose.nodes.graph.clock import Clock
from steadypose.nodes.graph.settings import LaunchError, path_setting
from steadypose.nodes.sources.camera import CameraSource, Connection
from steadypose.nodes.sources.source import SourceContext
from steadypose.prior.settings import check_range


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


Connect = Callable[[OakSettings, Clock], AbstractContextManager[Connection]]
"""opens the camera; raises RuntimeError if it cannot be opened now"""


class OakSource(CameraSource):
    """The skeletons of an OAK camera.

    Raises:
        LaunchError: a setting cannot be used.
    """

    def __init__(self, settings: OakSettings, context: SourceContext, connect: Connect | None = None) -> None:
        super().__init__(context)
        if settings.archive and not (settings.archive.endswith(".tar.xz") and Path(settings.archive).is_file()):
            raise LaunchError(
                f"[input.oak] archive: expected a file that is an NN archive (.tar.xz), got {settings.archive}; "
                "Luxonis' hub has some, their modelconverter makes others"
            )
        self._settings, self._connect = settings, connect

    def connect(self) -> AbstractContextManager[Connection]:
        if self._connect is None:
            from steadypose.nodes.sources.oak_device import connect  # brings depthai

            self._connect = connect
        return self._connect(self._settings, self._clock)  # pyright: ignore[reportArgumentType]  (one class, found under two names)
