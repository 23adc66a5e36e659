"""The trajectory node: ``pose/clean`` in, ``pose/world`` out."""

from collections.abc import Mapping
from typing import Any

from steadypose.msgs.topics import POSE_CLEAN, POSE_WORLD
from steadypose.msgs.types import Message, PoseClean
from steadypose.nodes.checks.problem import Problem, error
from steadypose.nodes.graph.clock import FRAME_NS, Clock
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.node import Node
from steadypose.nodes.graph.threads import one_thread
from steadypose.nodes.settings import launch_errors
from steadypose.prior.world.pipeline import TrajectoryPipeline
from steadypose.prior.world.settings import TrajectorySettings

PATIENCE_NS = 2_000_000_000
"""Longest time until the first message of a prior that this launch does not start, nanoseconds."""


def make_trajectory(settings: Mapping[str, Any]) -> TrajectoryPipeline:
    """Create the pipeline from ``[trajectory]`` of a launch file. Raises LaunchError for wrong settings or weights."""
    with launch_errors():
        return TrajectoryPipeline(TrajectorySettings.from_dict(settings))


class TrajectoryNode(Node):
    """Runs `TrajectoryPipeline` on the prior node's stream."""

    name = "trajectory"

    def __init__(self, launch: Launch, clock: Clock | None = None) -> None:
        super().__init__(launch, clock)
        one_thread()
        self._settings = launch.settings(TrajectorySettings)
        with launch_errors():
            self._pipeline = TrajectoryPipeline(self._settings)
        self._client_pipelines: dict[str, TrajectoryPipeline] = {}
        self._delay_frames = 0
        self._bodies = 0
        self._seen = False
        self._started_ns = self.clock.monotonic_ns()

    def handle(self, topic: str, message: Message) -> None:
        if not isinstance(message, PoseClean):
            return
        self._seen = True
        self._delay_frames = message.delay_frames
        for world in self._pipeline_of(message.source).process(message):
            self._bodies = len(world.bodies)
            self.publish(POSE_WORLD, world, delay_ns=round(message.delay_frames * FRAME_NS))

    def _pipeline_of(self, source: str) -> TrajectoryPipeline:
        """The pipeline of a stream. Each client has its own, identified by the message's source."""
        clients = len(self.launch.server.clients)
        if not clients:
            return self._pipeline
        pipeline = self._client_pipelines.pop(source, None) or TrajectoryPipeline(self._settings)
        self._client_pipelines[source] = pipeline
        if len(self._client_pipelines) > clients:  # a client reconnected under another name
            forgotten = self._client_pipelines.pop(next(iter(self._client_pipelines)))
            self._pipeline.counters.update(forgotten.counters)
        return pipeline

    def problems(self) -> list[Problem]:
        since_ns = self.clock.monotonic_ns() - self._started_ns
        # a prior of this launch reports itself that nothing comes
        if self._seen or "prior" in self.launch.nodes or since_ns < PATIENCE_NS:
            return []
        expected = f"expected a prior that publishes at {', '.join(self.launch.addresses('prior'))}"
        since = f"since the start {since_ns / 1e9:.0f} s ago"
        remedy = "add 'prior' to nodes, or start it where it runs"
        return [error("no_source", f"no {POSE_CLEAN} {since}: {expected}; {remedy}")]

    def status(self) -> dict[str, str]:
        counters = sum((p.counters for p in self._client_pipelines.values()), self._pipeline.counters)
        return {"bodies": str(self._bodies), "delay_frames": str(self._delay_frames)} | {
            f"refused.{cause}": str(n) for cause, n in counters.items()
        }
