"""Cameras as sources: OAK cameras, webcams with MediaPipe, and several calibrated cameras merged into one source.

A camera that is unplugged is reopened when it returns. `oak_device` needs depthai, `webcam_device` OpenCV and
MediaPipe: both are imported only when a camera is opened.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from steadypose.msgs.topics import POSE_RAW
from steadypose.msgs.transport import Subscriber
from steadypose.msgs.types import PoseRaw
from steadypose.nodes.checks.problem import Problem, check_wire, error, warning
from steadypose.nodes.graph.clock import POLL_S, Clock
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sources.source import MODEL, LiveSource, OakSettings, SourceContext, WebcamSettings

if TYPE_CHECKING:
    from steadypose.nodes.sources.webcam_device import VideoSource

logger = logging.getLogger(__name__)

PAUSES_S = (1.0, 2.0, 4.0, 8.0, 15.0)
"""Pauses before successive attempts to open the camera, seconds; the last one repeats."""
STREAMING = "streaming"


class Connection(Protocol):
    """An open camera."""

    name: str

    @property
    def counts(self) -> Counter[str]:
        """Number of frames dropped or refused since the camera was opened, by cause."""
        ...

    def frames(self) -> Iterator[PoseRaw | None]:
        """Skeletons as they arrive, or None after a while without one. Ends when the camera disconnects."""
        ...

    def status(self) -> dict[str, str]:
        """Its entries in `diagnostics`."""
        ...


class CameraSource(LiveSource):
    """The skeletons of a camera. While it is disconnected, it is retried forever at growing intervals.

    ``connect`` opens the camera; it raises RuntimeError if it cannot at present.
    """

    def __init__(self, clock: Clock, connect: Callable[[], AbstractContextManager[Connection]]) -> None:
        super().__init__()
        self._clock, self._connect = clock, connect
        self._state = "looking for a camera"
        self._connection: Connection | None = None
        self._connections = 0
        self._tried = False
        self._dropped: Counter[str] = Counter()  # of closed connections

    def frames(self) -> Generator[PoseRaw | None, None, None]:
        tries = 0
        while True:
            try:
                with self._connect() as self._connection:
                    self._connections += 1
                    self._state = "waiting for the first frame"
                    for frame in self._connection.frames():
                        if frame:
                            self._state, tries = STREAMING, 0
                        yield frame
                trouble = "camera lost"
                self.refused[trouble] += 1
            except RuntimeError as error:  # depthai and MediaPipe raise nothing more specific
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
        expected = "expected a camera that gives frames; `steadypose doctor` lists the cameras"
        return [warning("camera", f"{self._state}; {expected}")]

    def status(self) -> dict[str, str]:
        values = {"camera": self._state, "camera.connections": str(self._connections)}
        if self._state != STREAMING:
            values["state"] = self._state  # of the node: `steadypose run` shows it
        dropped = self._dropped.copy()
        if self._connection:
            values |= {"camera.name": self._connection.name} | self._connection.status()
            dropped.update(self._connection.counts)
        return values | {f"dropped.camera {cause}": str(n) for cause, n in dropped.items()}


def open_oak(settings: OakSettings, context: SourceContext) -> CameraSource:
    """Create the source for an OAK camera. Raises LaunchError if a setting cannot be used."""
    if settings.archive and not (settings.archive.endswith(".tar.xz") and Path(settings.archive).is_file()):
        got = f"{settings.archive}; Luxonis' hub has some, their modelconverter makes others"
        raise LaunchError(f"[input.oak] archive: expected an NN archive (.tar.xz), got {got}")

    def connect_oak() -> AbstractContextManager[Connection]:
        from steadypose.nodes.sources.oak_device import connect  # imports depthai

        return connect(settings, context.clock, context.image_file)  # pyright: ignore[reportArgumentType]  (found under two names)

    return CameraSource(context.clock, connect_oak)


def open_webcam(settings: WebcamSettings, context: SourceContext) -> CameraSource | VideoSource:
    """Create the source for a webcam, or for the video given in its place. Raises LaunchError for a wrong setting."""
    if settings.model and not Path(settings.model).is_file():
        got = f"got {settings.model!r}; download one, such as {MODEL}, or leave it out: MediaPipe's own finds one body"
        raise LaunchError(f"[input.webcam] model: expected a pose landmarker for MediaPipe, a .task file, {got}")
    if settings.bodies > 1 and not settings.model:
        got = f"got {settings.bodies}; for more, give a model, such as {MODEL}"
        raise LaunchError(f"[input.webcam] bodies: MediaPipe's own model finds one, {got}")

    def connect_webcam() -> AbstractContextManager[Connection]:
        from steadypose.nodes.sources.webcam_device import connect  # imports OpenCV

        return connect(settings, context.calibration, context.clock, image_file=context.image_file)  # pyright: ignore[reportArgumentType]

    if not settings.video:
        return CameraSource(context.clock, connect_webcam)
    from steadypose.nodes.sources.webcam_device import VideoSource

    return VideoSource(settings, context.calibration, image_file=context.image_file)  # pyright: ignore[reportArgumentType]


LATE_S = 1.0  # age beyond which a camera's skeletons are not merged, seconds
ENOUGH = 10  # smallest number of a camera's frames to judge by


@dataclass(frozen=True)
class MergeSettings:
    """``[input.merge]``: several calibrated cameras merged into one source."""

    cameras: list[str] = field(default_factory=list)
    """addresses of the cameras' input nodes (``tcp://192.168.1.21:7111``)"""


class MergeSource(LiveSource):
    """Merges ``pose/raw`` of several cameras, each with its own input node and calibration.

    Raises LaunchError if fewer than two cameras are named, or one is named twice.
    """

    def __init__(self, settings: MergeSettings, context: SourceContext) -> None:
        super().__init__()
        if not 2 <= len(set(settings.cameras)) == len(settings.cameras):
            expected = "the addresses of two input nodes or more, each once, such as tcp://192.168.1.21:7111"
            raise LaunchError(f"[input.merge] cameras: expected {expected}; got {settings.cameras}")
        from steadypose.prior.camera.multi_view import Merge  # imported late, so that launch files load without scipy

        self._addresses, self._context = settings.cameras, context
        self._merge = Merge()
        self._received: Counter[str] = Counter()
        self._lost: Counter[str] = Counter()
        self._unread: Counter[str] = Counter()
        self._before = [Counter[str]()] * 3

    def frames(self) -> Generator[PoseRaw | None, None, None]:
        context = self._context
        with Subscriber(
            self._addresses, POSE_RAW, keys=context.keys, clear_text=context.clear_text, lifespan_s=LATE_S, name="merge"
        ) as subscriber:
            self._lost, self._unread = subscriber.dropped, subscriber.refused
            while True:
                received = subscriber.receive(POLL_S)
                if received is None or not isinstance(received[1], PoseRaw):
                    yield None
                    continue
                self._received[received[1].source] += 1
                yield from self._merge.update(received[1]) or [None]
                self.refused = self._merge.counters + subscriber.refused

    def problems(self) -> list[Problem]:
        """Problems since the last call, because of which a camera is not merged."""
        counts = [self._unread, self._merge.counters, self._received]
        unread, refused, received = (now - before for now, before in zip(counts, self._before, strict=True))
        self._before = [count.copy() for count in counts]
        found = list(check_wire({", ".join(self._addresses): unread}))
        if unplaced := [camera for camera in received if refused[f"not calibrated, {camera}"]]:
            expected = "expected [input.calibration] in its own launch file, as `steadypose calibrate pose` writes it"
            text = f"{', '.join(unplaced)}: not merged, because its place is unknown: {expected} (docs/calibrate.md)"
            found.append(error("camera_uncalibrated", text))
        late = {camera: refused[f"late or repeated, {camera}"] for camera in received}
        if behind := [camera for camera, n in late.items() if n >= ENOUGH and n > received[camera] / 2]:
            text = (
                f"{', '.join(behind)}: hardly merged, because most frames come after later ones of another camera: "
                "expected clocks that agree within milliseconds; synchronise them (NTP or PTP), or use a faster network"
            )
            found.append(error("camera_late", text))
        return found

    def status(self) -> dict[str, str]:
        cameras = {f"camera.{name}": f"{count} messages" for name, count in sorted(self._received.items())}
        lost = {f"dropped.lost {topic}": str(count) for topic, count in self._lost.items()}
        return {"camera": f"{len(cameras)} of {len(self._addresses)} cameras heard"} | cameras | lost
