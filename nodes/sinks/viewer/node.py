"""The viewer: raw and clean poses side by side in a browser, through Rerun (extra ``view``).

It only subscribes, so it does not affect the poses. `PoseView` turns messages into drawings; `ViewerServer` keeps the
last minutes of drawings, and serves them with the page.
"""

import math
from dataclasses import dataclass

from steadypose.msgs.types import Message
from steadypose.nodes.graph.clock import POLL_S
from steadypose.nodes.graph.node import Node
from steadypose.nodes.settings import check_host_and_port
from steadypose.nodes.sinks.serving import LOCAL_NAMES
from steadypose.prior.clean.settings import PriorSettings


@dataclass(frozen=True)
class ViewerSettings:
    """``[viewer]``: the live view in the browser."""

    host: str = "127.0.0.1"
    """address to serve at. At an address of the network, anyone who listens there can see the people;
    ``ssh -L 9090:localhost:9090 robot`` is the safe way from another machine"""
    port: int = 9090
    """port of the web page and the drawings"""

    def __post_init__(self) -> None:
        check_host_and_port("viewer", self.host, self.port)


class ViewerNode(Node):
    """Draws the other nodes' messages. When it falls behind it skips frames; the pipeline never waits for it."""

    name = "viewer"

    def run(self) -> None:
        # imported late, because launch files import this module
        from steadypose.nodes.sinks.viewer.scene import PoseView
        from steadypose.nodes.sinks.viewer.server import ViewerServer
        from steadypose.nodes.sources.image import NAME, ImageReader
        from steadypose.nodes.sources.registry import InputSettings

        settings = self.launch.settings(ViewerSettings)
        asked = self.launch.settings(InputSettings).image
        self._images = ImageReader(self.launch.transport.ipc_directory / NAME) if asked else None
        with ViewerServer(settings.port, settings.host) as self._server:
            recording = self._server.connect()
            score = self.launch.settings(PriorSettings).score
            self._view = PoseView(recording, threshold=-math.log10(score.false_alarms))
            print(f"viewer: {self._server.url}", flush=True)
            if settings.host not in LOCAL_NAMES:
                print(f"viewer: anyone who listens on the network of {settings.host} can see the people", flush=True)
            try:
                super().run()
            finally:
                recording.disconnect()

    def work(self) -> None:
        while not self.stopping:
            self.take_next(POLL_S)
            if self._images and (image := self._images.next()):
                self._view.keep(image)
            self.report_if_due()
            self._server.check()

    def handle(self, topic: str, message: Message) -> None:
        self._view.log(topic, message)

    def status(self) -> dict[str, str]:
        return {"address": self._server.url.partition("?")[0]}  # without the token, because diagnostics are recorded
