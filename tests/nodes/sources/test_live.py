"""What a camera counted is kept when it is opened again."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import nullcontext

from conftest import VirtualClock, raw, walking

from steadypose.msgs.types import PoseRaw
from steadypose.nodes.sources.camera import CameraSource


class Flickering:
    """A camera that gives a frame, drops another, and goes."""

    name = "flickering"

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()

    def frames(self) -> Iterator[PoseRaw | None]:
        yield raw(0, walking(0))
        self.counts["late"] += 1
        yield raw(1, walking(1))

    def status(self) -> dict[str, str]:
        return {}


def test_what_was_dropped_is_counted_over_all_connections(clock: VirtualClock) -> None:
    source, dropped = CameraSource(clock, lambda: nullcontext(Flickering())), []
    for frame in source.frames():
        if frame:
            dropped.append(source.status().get("dropped.camera late"))
        if len(dropped) == 6:
            break
    assert dropped == [None, "1", "1", "2", "2", "3"]
    assert source.refused == {"camera lost": 2}
    assert source.status()["camera.connections"] == "3"
