"""From clean poses in the sensor's frame to poses in the world: root velocity, contacts, floor and their fusion.

A body's place comes from three sources that fail at different times: the observed root, where there is one; the root
velocity that the network predicts from the body's own motion (HM-VAE, section 3.3); and the feet at rest, which stay
where they are. A Kalman filter weighs them, and its covariance grows while the root is unobserved.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from steadypose.msgs.topics import broken
from steadypose.msgs.types import CleanBody, PoseClean, PoseWorld, WorldBody
from steadypose.prior.world.compose import compose
from steadypose.prior.world.core import BodyEstimate, Scene, WorldCore
from steadypose.prior.world.observe import observe, unit_quaternion
from steadypose.prior.world.settings import TrajectorySettings

WORLD = "world"
"""Frame of everything published here."""

MAX_SOURCES = 64
"""Number of sources whose floor and bodies are kept; beyond it the one not heard of for longest is forgotten."""


class TrajectoryPipeline:
    """Turns ``pose/clean`` into ``pose/world``, message by message; the same messages give the same output.

    Attributes:
        counters: messages and bodies refused, and sources forgotten, by cause.
    """

    def __init__(self, settings: TrajectorySettings) -> None:
        self.counters: Counter[str] = Counter()
        self._core, self._lost_sigma = WorldCore(settings), settings.lost_sigma
        self._timeout_ns = round(settings.timeout_s * 1e9)
        self._scenes: dict[str, Scene] = {}  # the one heard of last, last

    def process(self, clean: PoseClean) -> list[PoseWorld]:
        """The world at the message's moment: one message, or none if it was refused (see `counters`)."""
        if clean.end_of_stream:
            return [_message(clean, self._scenes.pop(clean.source, None) or Scene(clean.calibrated), [])]
        orientation, position = unit_quaternion(clean.sensor_pose.orientation), clean.sensor_pose.position
        if orientation is None or not np.isfinite(position).all():
            self.counters["sensor_pose_invalid"] += 1
            return []
        scene = self._scene(clean)
        if scene is None:
            return []
        observations = observe(self._named(clean.bodies), clean.stamp_ns, orientation, position, scene.last)
        estimates = self._core.step(scene, observations)
        if len(estimates) < len(observations):
            self.counters["body_without_root"] += len(observations) - len(estimates)
        return [_message(clean, scene, self._composed(scene, estimates))]

    def scene(self, source: str) -> Scene | None:
        """What is known of a source; None of one not heard of, ended or forgotten."""
        return self._scenes.get(source)

    def _named(self, bodies: Sequence[CleanBody]) -> list[CleanBody]:
        """The first body of each id."""
        named: dict[int, CleanBody] = {}
        for body in bodies:
            if body.id in named:
                self.counters["body_id_repeated"] += 1
            named.setdefault(body.id, body)
        return [*named.values()]

    def _composed(self, scene: Scene, estimates: Sequence[BodyEstimate]) -> list[WorldBody]:
        """The bodies that keep their promises; whatever made another break them is in its state, which is dropped."""
        bodies = []
        for estimate in estimates:
            body = compose(estimate, self._lost_sigma)
            if broken(body) is None:
                bodies.append(body)
            else:
                self.counters["body_begun_anew"] += 1
                del scene.bodies[body.id]
        return bodies

    def _scene(self, clean: PoseClean) -> Scene | None:
        """The scene of the message's source, without the bodies not heard of for long; None if it is out of order."""
        scene, stamp_ns = self._scenes.pop(clean.source, None), clean.stamp_ns
        if scene is not None and stamp_ns < scene.stamp_ns - self._timeout_ns:
            self.counters["stamp_jumped_back"] += 1
            scene = None
        late = scene is not None and stamp_ns <= scene.stamp_ns
        if scene is None or (scene.calibrated != clean.calibrated and not late):
            scene = Scene(clean.calibrated)
        self._scenes[clean.source] = scene
        if len(self._scenes) > MAX_SOURCES:
            self.counters["source_forgotten"] += 1
            del self._scenes[next(iter(self._scenes))]
        if late:
            self.counters["stamp_repeated" if stamp_ns == scene.stamp_ns else "stamp_out_of_order"] += 1
            return None
        scene.advance(stamp_ns, self._timeout_ns)
        return scene


def _message(clean: PoseClean, scene: Scene, bodies: list[WorldBody]) -> PoseWorld:
    return PoseWorld(clean.stamp_ns, WORLD, clean.source, scene.floor.plane, bodies, clean.end_of_stream)
