"""A live source that a test gives its frames."""

from collections.abc import Generator

from steadypose.msgs.types import PoseRaw
from steadypose.nodes.sources.source import LiveSource


class Given(LiveSource):
    """Gives these frames, then none."""

    def __init__(self, *frames: PoseRaw | None) -> None:
        super().__init__()
        self._frames = frames

    def frames(self) -> Generator[PoseRaw | None, None, None]:
        yield from self._frames
        while True:
            yield None

    def status(self) -> dict[str, str]:
        return {}
