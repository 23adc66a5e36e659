"""Several cameras in place of one: ``[input] source = "merge"``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Generator

from steadypose.msgs.keys import Keys
from steadypose.msgs.topics import POSE_RAW
from steadypose.msgs.transport import Subscriber
from steadypose.msgs.types import PoseRaw
from steadypose.nodes.graph.launch import LaunchError, MergeSettings
from steadypose.nodes.graph.runtime import TURN_S
from steadypose.nodes.sources.camera import LiveSource
from steadypose.prior.camera.multi_view import Merge


class MergeSource(LiveSource):
    """The ``pose/raw`` of several cameras, each an input node of its own with its own calibration, merged.

    Raises:
        LaunchError: fewer than two cameras are named, or one twice.
    """

    def __init__(self, settings: MergeSettings, keys: Keys | None) -> None:
        super().__init__()
        if len(set(settings.cameras)) < 2 or len(set(settings.cameras)) != len(settings.cameras):
            raise LaunchError(
                "[input.merge] cameras: expected the addresses of two input nodes or more, each once, such as "
                f"tcp://192.168.1.21:7111; got {settings.cameras}"
            )
        self._addresses, self._keys = settings.cameras, keys
        self._merge = Merge()
        self._heard: Counter[str] = Counter()
        self._lost: Counter[str] = Counter()

    def frames(self) -> Generator[PoseRaw | None, None, None]:
        with Subscriber(self._addresses, POSE_RAW, keys=self._keys, name="merge") as subscriber:
            self._lost = subscriber.dropped
            while True:
                received = subscriber.receive(TURN_S)
                if received is None or not isinstance(received[1], PoseRaw):
                    yield None
                    continue
                self._heard[received[1].source] += 1
                yield from self._merge.update(received[1]) or [None]
                self.refused = self._merge.counters + subscriber.refused

    def status(self) -> dict[str, str]:
        heard = {f"camera.{name}": f"{count} messages" for name, count in sorted(self._heard.items())}
        lost = {f"dropped.lost {topic}": str(count) for topic, count in self._lost.items()}
        return {"camera": f"{len(heard)} of {len(self._addresses)} cameras heard"} | heard | lost
