"""The prior node: ``pose/raw`` in, ``pose/clean`` out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from msgs.topics import POSE_CLEAN
from msgs.types import Message, PoseRaw
from nodes.launch import Launch, LaunchError
from nodes.runtime import FRAME_NS, Clock, Node
from prior.pipeline import PriorPipeline, PriorSettings

GATED = ("joints_refused", "limbs_exchanged")
"""counts of what the gate found in the sensor's joints: its daily work, and no fault of a message"""


def make_prior(settings: Mapping[str, Any]) -> PriorPipeline:
    """The prior as ``[prior]`` of a launch file wants it.

    Raises:
        LaunchError: an unknown setting, a value that cannot be, or weights that are not there.
    """
    try:
        return PriorPipeline(PriorSettings.from_dict(settings))
    except (ValueError, FileNotFoundError) as error:
        raise LaunchError(str(error)) from error


class PriorNode(Node):
    """Runs `PriorPipeline` over what the input node gives."""

    name = "prior"

    def __init__(self, launch: Launch, clock: Clock | None = None) -> None:
        super().__init__(launch, clock)
        # two threads that share the cores with other nodes wait for each other: a p99 of 100 ms
        torch.set_num_threads(1)
        self._pipeline = make_prior(launch.prior)
        self._bodies = 0
        self._anomalies = 0

    def handle(self, topic: str, message: Message) -> None:
        if not isinstance(message, PoseRaw):
            return
        for clean in self._pipeline.process(message):
            self._bodies = len(clean.bodies)
            self._anomalies += sum(body.anomaly_flag for body in clean.bodies)
            self.publish(POSE_CLEAN, clean, delay_ns=round(clean.delay_frames * FRAME_NS))

    def status(self) -> dict[str, str]:
        counts = {
            f"{'gate' if cause in GATED else 'refused'}.{cause}": str(n) for cause, n in self._pipeline.counters.items()
        }
        return counts | {
            "bodies": str(self._bodies),
            "anomalies": str(self._anomalies),
            "delay_frames": str(self._pipeline.delay_frames),
        }
