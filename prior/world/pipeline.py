"""Turns clean poses in the sensor's frame into poses in the world, with root velocity, contacts and floor.

Three sources, which fail at different times, determine a body's position: the observed root, the root velocity that a
network predicts from the body's own motion (HM-VAE, section 3.3), and resting feet, which stay in place. A Kalman
filter fuses them. Its covariance grows while the root is unobserved.
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

WORLD = "world"  # frame id of all published messages

MAX_SOURCES = 64
"""Largest number of sources whose state is kept; beyond it, the least recently received source is forgotten."""


class TrajectoryPipeline:
    """Turns ``pose/clean`` into ``pose/world``, message by message. The same messages give the same output.

    Attributes:
        counters: numbers of messages and bodies refused, and of sources forgotten, by cause.
        scenes: state of each source, the least recently received first.
    """

    def __init__(self, settings: TrajectorySettings) -> None:
        self.counters: Counter[str] = Counter()
        self._core, self._lost_sigma = WorldCore(settings), settings.lost_sigma
        self._timeout_ns = round(settings.timeout_s * 1e9)
        self.scenes: dict[str, Scene] = {}

    def process(self, clean: PoseClean) -> list[PoseWorld]:
        """Return the ``pose/world`` message for a ``pose/clean`` message; none if it was refused (see `counters`)."""
        if clean.end_of_stream:
            return [_message(clean, self.scenes.pop(clean.source, None) or Scene(clean.calibrated), [])]
        orientation, position = unit_quaternion(clean.sensor_pose.orientation), clean.sensor_pose.position
        if orientation is None or not np.isfinite(position).all():
            self.counters["sensor_pose_invalid"] += 1
            return []
        scene = self._scene(clean)
        if scene is None:
            return []
        last = {name: body.observed for name, body in scene.bodies.items()}
        observations = observe(self._named(clean.bodies), clean.stamp_ns, orientation, position, last)
        estimates = self._core.step(scene, observations)
        if len(estimates) < len(observations):
            self.counters["body_without_root"] += len(observations) - len(estimates)
        return [_message(clean, scene, self._composed(scene, estimates))]

    def _named(self, bodies: Sequence[CleanBody]) -> list[CleanBody]:
        """Return the first body with each id."""
        named: dict[int, CleanBody] = {}
        for body in bodies:
            if body.id in named:
                self.counters["body_id_repeated"] += 1
            named.setdefault(body.id, body)
        return [*named.values()]

    def _composed(self, scene: Scene, estimates: Sequence[BodyEstimate]) -> list[WorldBody]:
        """Compose the bodies. A body that breaks the guarantees of `msgs.topics` is left out and its state dropped."""
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
        """Return the source's scene without bodies that timed out; None if the message is out of order."""
        scene, stamp_ns = self.scenes.pop(clean.source, None), clean.stamp_ns
        if scene is not None and stamp_ns < scene.stamp_ns - self._timeout_ns:
            self.counters["stamp_jumped_back"] += 1
            scene = None
        late = scene is not None and stamp_ns <= scene.stamp_ns
        if scene is None or (scene.calibrated != clean.calibrated and not late):
            scene = Scene(clean.calibrated)
        self.scenes[clean.source] = scene
        if len(self.scenes) > MAX_SOURCES:
            self.counters["source_forgotten"] += 1
            del self.scenes[next(iter(self.scenes))]
        if late:
            self.counters["stamp_repeated" if stamp_ns == scene.stamp_ns else "stamp_out_of_order"] += 1
            return None
        scene.advance(stamp_ns, self._timeout_ns)
        return scene


def _message(clean: PoseClean, scene: Scene, bodies: list[WorldBody]) -> PoseWorld:
    return PoseWorld(clean.stamp_ns, WORLD, clean.source, scene.floor.plane, bodies, clean.end_of_stream)
