"""Several cameras in place of one: ``[input] source = "merge"``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Generator
from dataclasses import dataclass, field

from steadypose.msgs.topics import POSE_RAW
from steadypose.msgs.transport import Subscriber
from steadypose.msgs.types import PoseRaw
from steadypose.nodes.graph.clock import POLL_S
from steadypose.nodes.graph.settings import LaunchError, check_addresses
from steadypose.nodes.sources.source import LiveSource, SourceContext

LATE_S = 1.0
"""age from which a camera's skeletons are not merged any more"""


@dataclass(frozen=True)
class MergeSettings:
    """``[input.merge]``: several calibrated cameras in place of one."""

    cameras: list[str] = field(default_factory=list)
    """addresses of their input nodes (``tcp://192.168.1.21:7111``)"""

    def __post_init__(self) -> None:
        check_addresses("[input.merge] cameras", self.cameras)


class MergeSource(LiveSource):
    """The ``pose/raw`` of several cameras, each an input node of its own with its own calibration, merged.

    Raises:
        LaunchError: fewer than two cameras are named, or one twice.
    """

    def __init__(self, settings: MergeSettings, context: SourceContext) -> None:
        super().__init__()
        if len(set(settings.cameras)) < 2 or len(set(settings.cameras)) != len(settings.cameras):
            raise LaunchError(
                "[input.merge] cameras: expected the addresses of two input nodes or more, each once, such as "
                f"tcp://192.168.1.21:7111; got {settings.cameras}"
            )
        from steadypose.prior.camera.multi_view import Merge  # brings scipy: not for reading a launch file

        self._addresses, self._context = settings.cameras, context
        self._merge = Merge()
        self._received: Counter[str] = Counter()
        self._lost: Counter[str] = Counter()

    def frames(self) -> Generator[PoseRaw | None, None, None]:
        with self._subscriber() as subscriber:
            self._lost = subscriber.dropped
            while True:
                received = subscriber.receive(POLL_S)
                if received is None or not isinstance(received[1], PoseRaw):
                    yield None
                    continue
                self._received[received[1].source] += 1
                yield from self._merge.update(received[1]) or [None]
                self.refused = self._merge.counters + subscriber.refused

    def _subscriber(self) -> Subscriber:
        context = self._context
        return Subscriber(
            self._addresses, POSE_RAW, keys=context.keys, clear_text=context.clear_text, lifespan_s=LATE_S, name="merge"
        )

    def status(self) -> dict[str, str]:
        cameras = {f"camera.{name}": f"{count} messages" for name, count in sorted(self._received.items())}
        lost = {f"dropped.lost {topic}": str(count) for topic, count in self._lost.items()}
        return {"camera": f"{len(cameras)} of {len(self._addresses)} cameras heard"} | cameras | lost
