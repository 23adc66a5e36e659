"""Cameras as sources: frames when they come, and what to do when the camera goes away."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Generator, Iterator
from contextlib import AbstractContextManager
from typing import Protocol

from msgs.types import PoseRaw
from nodes.runtime import TURN_S, Clock

PAUSES_S = (1.0, 2.0, 4.0, 8.0, 15.0)
"""before each try in a row to find the camera again; the last goes on"""

STREAMING = "streaming"


class CameraError(RuntimeError):
    """A camera that cannot be used now; it may be, later. The text says what is wrong."""


class Connection(Protocol):
    """A camera that is open."""

    name: str

    @property
    def counts(self) -> Counter[str]:
        """Frames dropped or refused, by cause."""
        ...

    def frames(self) -> Iterator[PoseRaw | None]:
        """Skeletons as they come, None where none came for a while; ends when the camera does."""
        ...

    def status(self) -> dict[str, str]:
        """What there is to say of it in `diagnostics`."""
        ...


class LiveSource(ABC):
    """Skeletons that come when they come, stamped with the wall time of their capture."""

    def __init__(self) -> None:
        self.refused: Counter[str] = Counter()
        """what went wrong, by cause"""

    @abstractmethod
    def frames(self) -> Generator[PoseRaw | None, None, None]:
        """Skeletons without end; None where a moment passed without one, so that the caller can look up."""

    @abstractmethod
    def status(self) -> dict[str, str]:
        """What `diagnostics` should say of it."""


class CameraSource(LiveSource):
    """The skeletons of a camera. When it is gone, or not there yet, it is looked for at growing intervals, for ever."""

    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self._clock = clock
        self._state = "looking for a camera"
        self._connection: Connection | None = None
        self._connections = 0

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
            except RuntimeError as error:  # depthai and OpenCV have no narrower ones
                trouble = str(error)
            if self._connection:  # keep what it counted
                self.refused.update({f"camera {cause}": n for cause, n in self._connection.counts.items()})
            self._connection = None
            pause_s = PAUSES_S[min(tries, len(PAUSES_S) - 1)]
            tries += 1
            self._state = f"waiting for a camera: {trouble}; next try in {pause_s:g} s"
            again_ns = self._clock.now_ns() + round(pause_s * 1e9)
            while self._clock.now_ns() < again_ns:
                yield None
                self._clock.sleep(round(TURN_S * 1e9))

    def status(self) -> dict[str, str]:
        values = {"camera": self._state, "camera.connections": str(self._connections)}
        if self._state != STREAMING:
            values["state"] = self._state  # of the node: `steadypose run` shows it
        if self._connection:
            values |= {"camera.name": self._connection.name} | self._connection.status()
            values |= {f"dropped.camera {cause}": str(n) for cause, n in self._connection.counts.items()}
        return values
