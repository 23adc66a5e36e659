"""The prior node: ``pose/raw`` in, ``pose/clean`` out."""

from collections.abc import Mapping
from typing import Any

from steadypose.msgs.topics import POSE_CLEAN, POSE_RAW
from steadypose.msgs.types import Message, PoseRaw
from steadypose.nodes.checks.problem import Problem, error, warning
from steadypose.nodes.checks.stream import OutputCheck, StreamChecks
from steadypose.nodes.graph.clock import FRAME_NS, Clock
from steadypose.nodes.graph.inbox import BodyLimit
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.node import Node
from steadypose.nodes.graph.threads import one_thread
from steadypose.nodes.graph.topology import NODES, load
from steadypose.nodes.settings import launch_errors
from steadypose.prior.clean.batch import StreamBatch
from steadypose.prior.clean.pipeline import PriorPipeline, load_loops
from steadypose.prior.clean.settings import PriorSettings

GATED = ("joints_refused", "limbs_exchanged", "joints_mirrored", "joints_stuck")
"""Counters of the gate's outlier rejection. They are normal operation, not refused messages."""
OWN_SOURCE_NS, FOREIGN_SOURCE_NS = 10_000_000_000, 2_000_000_000
"""Longest time until a source's first message, nanoseconds: of a source that this launch starts, and of one that should
be running already."""


def make_prior(settings: Mapping[str, Any]) -> PriorPipeline:
    """Create the prior of one stream from ``[prior]`` of a launch file. Raises LaunchError for wrong settings or
    weights.
    """
    with launch_errors():
        return PriorPipeline(PriorSettings.from_dict(settings))


class PriorNode(Node):
    """Runs `PriorPipeline` on the input node's stream."""

    name = "prior"

    def __init__(self, launch: Launch, clock: Clock | None = None) -> None:
        super().__init__(launch, clock)
        one_thread()
        settings, clients = launch.settings(PriorSettings), len(launch.server.clients)
        with launch_errors():
            load_loops(settings)  # first, so that the pipeline reuses the memory it frees
            self._pipeline = StreamBatch(settings, clients) if clients else PriorPipeline(settings)
        self._bodies = 0
        self._anomalies = 0
        self._overrun_before = 0
        self._output_check = OutputCheck(self._pipeline.counters, identified=settings.identify.enabled)
        self._checks = StreamChecks(settings, clients or 1)
        # such a replay has no timeline
        self._unpaced = "pose_input" in launch.nodes and not launch.settings(load(NODES["pose_input"].settings)).rate
        self._started_ns = self.clock.monotonic_ns()
        self._limit = BodyLimit(settings.max_bodies, self.clock)
        self._optional = [stage for stage in ("score", "impute") if getattr(settings, stage).enabled]

    def handle(self, topic: str, message: Message) -> None:
        if not isinstance(message, PoseRaw):
            return
        self._checks.see(message, self.clock.now_ns())
        self._output_check.add_input(message)
        started_ns, gap = self.clock.monotonic_ns(), self.inbox.dropped_of(message)
        if isinstance(self._pipeline, StreamBatch):
            cleaned = self._pipeline.process_at(message, started_ns, hurry=self.behind, gap=gap)
        else:
            cleaned = self._pipeline.process(message, gap=gap)
        if self.queue_limit is not None:
            spent_ns = self.clock.monotonic_ns() - started_ns
            self._limit.note(self._pipeline.bodies, spent_ns, self.inbox.overrun)
            self._pipeline.most_bodies = self._limit.bodies
        for clean in cleaned:
            self._bodies = len(clean.bodies)
            self._anomalies += sum(body.anomaly_flag for body in clean.bodies)
            self._output_check.add_output(clean)
            self.publish(POSE_CLEAN, clean, delay_ns=round(clean.delay_frames * FRAME_NS))

    def problems(self) -> list[Problem]:
        now_ns = self.clock.now_ns()
        for source in self.inbox.sources:
            self._checks.heard(source, now_ns)
            if isinstance(self._pipeline, StreamBatch):
                self._pipeline.heard(source, self.clock.monotonic_ns())
        live = not self._unpaced and (self.timeline is None or self.timeline.is_now)
        found = self._checks.problems(now_ns, live=live)
        own = "pose_input" in self.launch.nodes
        patience_ns = OWN_SOURCE_NS if own else FOREIGN_SOURCE_NS
        since_ns = self.clock.monotonic_ns() - self._started_ns
        if not self._checks.seen and since_ns > patience_ns:
            expected = f"expected a publisher at {', '.join(self.launch.addresses('pose_input'))}"
            remedy = "see what pose_input reports" if own else "start the tracker, or let it bind that address"
            since = f"since the start {since_ns / 1e9:.0f} s ago"
            return [error("no_source", f"no {POSE_RAW} {since}: {expected}; {remedy}")]
        of_output = self._output_check.problems()
        late, self._overrun_before = self.inbox.overrun > self._overrun_before, self.inbox.overrun
        if late and (slow := [problem for problem in found if problem.cause.endswith("slow")]):
            # it is this node that skips frames, not the source
            found = [problem for problem in found if problem not in slow]
            found.append(self._overload("few of the frames: only the newest are processed"))
        if (bodies := self._limit.bodies) < (offered := self._pipeline.offered):
            too_much = f"{bodies} of {offered} bodies: those farthest from the sensor are left out"
            return [*(found or of_output), self._overload(too_much)]
        return found or of_output

    def _overload(self, too_much: str) -> Problem:
        stages = " and ".join(f"[prior.{stage}]" for stage in self._optional)
        remedy = f"{f'switch off {stages}, or ' if stages else ''}use a faster machine"
        return warning("overload", f"this machine has time for {too_much}; {remedy}")

    def status(self) -> dict[str, str]:
        counters = self._pipeline.counters.items()
        counts = {f"{'gate' if cause in GATED else 'refused'}.{cause}": str(n) for cause, n in counters}
        if isinstance(self._pipeline, StreamBatch):
            counts["streams"] = str(self._pipeline.streams)
        if noise := self._pipeline.sensor_noise:
            counts["sensor.jitter_mm"] = f"{1e3 * noise.jitter_sigma:.1f}"
            counts["sensor.slow_error_mm"] = f"{1e3 * noise.bias_sigma:.1f}"
        return counts | {
            "bodies": str(self._bodies),
            "anomalies": str(self._anomalies),
            "delay_frames": str(self._pipeline.delay_frames),
        }
