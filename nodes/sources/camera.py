"""Cameras as sources, opened again when they are unplugged."""

from __future__ import annotations

import logging
from abc import abstractmethod
from collections import Counter
from collections.abc import Generator, Iterator
from contextlib import AbstractContextManager
from typing import Protocol

from steadypose.msgs.types import PoseRaw
from steadypose.nodes.checks.problem import Problem, warning
from steadypose.nodes.graph.clock import POLL_S
from steadypose.nodes.sources.source import LiveSource, SourceContext

logger = logging.getLogger(__name__)

PAUSES_S = (1.0, 2.0, 4.0, 8.0, 15.0)
"""pauses before successive attempts to open the camera; the last one repeats"""

STREAMING = "streaming"


class CameraError(RuntimeError):
    """A camera that cannot be used at present. The text says what is wrong."""


class Connection(Protocol):
    """A camera that is open."""

    name: str

    @property
    def counts(self) -> Counter[str]:
        """Frames dropped or refused since it was opened, by cause."""
        ...

    def frames(self) -> Iterator[PoseRaw | None]:
        """Skeletons as they come, None where none came for a while; ends when the camera does."""
        ...

    def status(self) -> dict[str, str]:
        """What there is to say of it in `diagnostics`."""
        ...


def count_failure(counts: Counter[str], camera: str, error: Exception) -> None:
    """Count a frame of a camera that could not be worked on, and log the first of its kind."""
    cause = f"frame: {type(error).__name__}"
    if cause not in counts:
        logger.error("%s: a frame failed; more are only counted", camera, exc_info=error)
    counts[cause] += 1


class CameraSource(LiveSource):
    """The skeletons of a camera. While it is disconnected, it is tried again at growing intervals, indefinitely."""

    def __init__(self, context: SourceContext) -> None:
        super().__init__()
        self._clock = context.clock
        self._state = "looking for a camera"
        self._connection: Connection | None = None
        self._connections = 0
        self._tried = False
        self._dropped: Counter[str] = Counter()  # by connections that are closed

    @abstractmethod
    def connect(self) -> AbstractContextManager[Connection]:
        """Open the camera.

        Raises:
            RuntimeError: it cannot be opened now.
        """

    def frames(self) -> Generator[PoseRaw | None, None, None]:
        tries = 0
        while True:
            try:
                with self.connect() as self._connection:
                    self._connections += 1
                    self._state = "waiting for the first frame"
                    for frame in self._connection.frames():
                        if frame:
                            self._state, tries = STREAMING, 0
                        yield frame
                trouble = "camera lost"
                self.refused[trouble] += 1
            except RuntimeError as error:  # depthai and MediaPipe have no narrower ones
                trouble = str(error)
            if self._connection:
                self._dropped.update(self._connection.counts)
            self._connection, self._tried = None, True
            pause_s = PAUSES_S[min(tries, len(PAUSES_S) - 1)]
            tries += 1
            self._state = f"waiting for a camera: {trouble}; next try in {pause_s:g} s"
            again_ns = self._clock.monotonic_ns() + round(pause_s * 1e9)
            while self._clock.monotonic_ns() < again_ns:
                yield None
                self._clock.sleep(round(POLL_S * 1e9))

    def problems(self) -> list[Problem]:
        if self._state == STREAMING or not self._tried:
            return []
        return [
            warning(
                "camera", f"{self._state}; expected a camera that gives frames: `steadypose doctor` names those here"
            )
        ]

    def status(self) -> dict[str, str]:
        values = {"camera": self._state, "camera.connections": str(self._connections)}
        if self._state != STREAMING:
            values["state"] = self._state  # of the node: `steadypose run` shows it
        dropped = self._dropped.copy()
        if self._connection:
            values |= {"camera.name": self._connection.name} | self._connection.status()
            dropped.update(self._connection.counts)
        return values | {f"dropped.camera {cause}": str(n) for cause, n in dropped.items()}
