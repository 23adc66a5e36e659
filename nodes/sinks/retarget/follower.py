"""Whom the robot follows: one person at a time, until they are gone."""

from __future__ import annotations

from steadypose.msgs.types import PoseWorld, Tracking
from steadypose.nodes.sinks.retarget.retargeter import Retargeter, RobotPose

GONE_NS = 1_000_000_000
"""after which another is followed"""


class Follower:
    """The robot's poses for a stream of ``pose/world``.

    Args:
        retargeter: of the robot.
        body: the id of the one to follow; None: the first who is there, then the next.
    """

    def __init__(self, retargeter: Retargeter, body: int | None = None) -> None:
        self._retargeter, self._only, self._body = retargeter, body, body
        self._seen_ns = 0

    def process(self, world: PoseWorld) -> RobotPose | None:
        """The pose at a message's moment; None before there was anybody."""
        bodies = {body.id: body for body in world.bodies if body.tracking != Tracking.LOST}
        if self._body not in bodies and self._only is None and abs(world.stamp_ns - self._seen_ns) > GONE_NS and bodies:
            self._body = min(bodies)
            self._retargeter.reset()
        if self._body is None or self._body not in bodies:
            return self._retargeter.coast(world.stamp_ns)
        self._seen_ns = world.stamp_ns
        return self._retargeter.follow(world.stamp_ns, bodies[self._body]) or self._retargeter.coast(world.stamp_ns)
