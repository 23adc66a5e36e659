"""OAK cameras as the source; what runs with depthai is in `nodes.sources.oak_device`."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

from steadypose.nodes.graph.clock import Clock
from steadypose.nodes.graph.settings import LaunchError
from steadypose.nodes.sources.camera import CameraSource, Connection
from steadypose.nodes.sources.camera_settings import OakSettings
from steadypose.nodes.sources.source import SourceContext

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
