"""From clean poses in the sensor's frame to poses in the world: root velocity, contacts, floor and their fusion.

A body's place comes from three sources that fail at different times: the observed root, where there is one; the root
velocity that the network reads from the body's own motion (HM-VAE, section 3.3); and the feet at rest, which stay
where they are. A Kalman filter weighs them, and its covariance grows while the root is hidden.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.contract import broken
from steadypose.msgs.types import CleanBody, PoseClean, PoseWorld, WorldBody
from steadypose.prior.body.kinematics import yaw_matrix
from steadypose.prior.models.root_velocity.inference import LiveRootVelocity
from steadypose.prior.settings import build_settings
from steadypose.prior.world.body_filter import BodyNoise
from steadypose.prior.world.body_track import BodyTrack, Motion
from steadypose.prior.world.contact_reader import ContactReader
from steadypose.prior.world.ground import Ground
from steadypose.prior.world.sighting import Sighting, sightings, unit_quaternion

Floats = NDArray[np.float64]

WORLD = "world"
"""The frame of everything published here."""


CAMERA_ERROR, CAMERA_MEMORY_S = 2.0, 0.3
"""On poses from a camera the velocity that the network reads errs so many times as much as validation on motion capture
found, and for at least so many seconds: on simulated streams 0.2 m/s where 0.1 was stated, half of it still there after
0.5 s, and not the same in all streams."""

SCALE_FACTOR_ERROR = 0.35
"""Of the speed that the network reads, the standard deviation of an error that it does not state: a runner, of whom
training has none, is read a third too slow."""


@dataclass(frozen=True)
class TrajectorySettings:
    """What a launch file may set.

    Attributes:
        weights: the weight set of the root's velocity, or a path to a ``.safetensors`` file.
        contact_weights: the same of the contacts.
        network: whether the network's root velocity is used.
        contacts: whether feet that rest stand, and hold the root.
        acceleration: m/s² over √Hz, how quickly a root may change its velocity.
        lost_sigma: metres, the horizontal standard deviation beyond which a body counts as LOST.
        timeout_s: seconds after which a body that no message mentions is forgotten.
    """

    weights: str = "default"
    contact_weights: str = "default"
    network: bool = True
    contacts: bool = True
    acceleration: float = 3.0
    lost_sigma: float = 0.5
    timeout_s: float = 1.0

    @classmethod
    def from_dict(cls, settings: Mapping[str, Any]) -> TrajectorySettings:
        """From the table of a launch file.

        Raises:
            ValueError: a key that does not exist, a value of the wrong type, or a number that is not above 0.
        """
        return build_settings(cls, settings, "trajectory")

    def __post_init__(self) -> None:
        for name in ("acceleration", "lost_sigma", "timeout_s"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"[trajectory] {name}: expected a finite number above 0, got {getattr(self, name)}")


class _Scene:
    """What is known of one source: its floor and its bodies."""

    def __init__(self, calibrated: bool) -> None:
        self.ground = Ground(calibrated)
        self.tracks: dict[int, BodyTrack] = {}
        self.stamp_ns = -1


class TrajectoryPipeline:
    """Turns ``pose/clean`` into ``pose/world``, message by message; the same messages give the same answers.

    Attributes:
        counters: messages and bodies refused, by cause.
    """

    def __init__(self, settings: TrajectorySettings) -> None:
        self.settings = settings
        self.counters: Counter[str] = Counter()
        self._reader = MotionReader(settings.weights)
        self._contacts = ContactReader(settings.contact_weights)
        self._noise = BodyNoise(settings.acceleration, network_memory_s=self._reader.memory_s)
        self._scenes: dict[str, _Scene] = {}

    def process(self, clean: PoseClean) -> list[PoseWorld]:
        """The world at the message's moment: one message, or none if it was refused (see `counters`)."""
        if clean.end_of_stream:
            scene = self._scenes.pop(clean.source, None) or _Scene(clean.calibrated)
            return [_message(clean, scene.ground, [])]
        turn, place = unit_quaternion(clean.sensor_pose.orientation), clean.sensor_pose.position
        if turn is None or not np.isfinite(place).all():
            self.counters["sensor pose is not a pose"] += 1
            return []
        scene = self._scene(clean)
        if scene is None:
            return []
        named: dict[int, CleanBody] = {}
        for body in clean.bodies:
            if body.id in named:
                self.counters["body id twice in a message"] += 1
            else:
                named[body.id] = body
        followed: list[tuple[BodyTrack, Sighting]] = []
        for sighting in sightings([*named.values()], turn, place):
            track = scene.tracks.get(sighting.body.id)
            if track is not None:
                track.advance(sighting, clean.stamp_ns)
            elif sighting.root is not None:
                memory = self._contacts.nothing
                track = BodyTrack(sighting, clean.stamp_ns, self._reader.context, self._noise, memory)
                scene.tracks[sighting.body.id] = track
            else:
                self.counters["body without a root so far"] += 1
                continue
            followed.append((track, sighting))
        motions = self._reader.read([track for track, _ in followed])
        contacts = self._contacts.read([track.glimpse(sighting, scene.ground) for track, sighting in followed])
        s, bodies = self.settings, []
        for (track, sighting), motion, touching in zip(followed, motions, contacts, strict=True):
            track.fuse(sighting, motion, touching, scene.ground, s.network, s.contacts)
            body = track.publish(sighting, touching, s.lost_sigma)
            if (promise := broken(body)) is None:
                bodies.append(body)
            else:  # whatever made it so is in the track, which begins anew
                self.counters[promise] += 1
                del scene.tracks[body.id]
        return [_message(clean, scene.ground, bodies)]

    def _scene(self, clean: PoseClean) -> _Scene | None:
        """The scene of the message's source, without the bodies not heard of for long; None if it is out of order."""
        scene = self._scenes.get(clean.source)
        timeout_ns = round(self.settings.timeout_s * 1e9)
        if scene is not None and clean.stamp_ns < scene.stamp_ns - timeout_ns:
            self.counters["stamps went back: started anew"] += 1
            scene = None
        if scene is not None and clean.stamp_ns <= scene.stamp_ns:
            self.counters["stamp is not after the last"] += 1
            return None
        if scene is None or scene.ground.calibrated != clean.calibrated:
            scene = self._scenes[clean.source] = _Scene(clean.calibrated)
        scene.stamp_ns = clean.stamp_ns
        scene.tracks = {i: t for i, t in scene.tracks.items() if clean.stamp_ns - t.stamp_ns <= timeout_ns}
        return scene


class MotionReader:
    """The network, asked about the newest frame of every body at once.

    Args:
        weights: the weight set, or a path to a ``.safetensors`` file.

    Attributes:
        memory_s: (3,) the time constants of the velocity's errors.
    """

    def __init__(self, weights: str) -> None:
        self._net = LiveRootVelocity.load(weights)
        config, horizontal_first = self._net.config, [0, 0, 1]
        self._scale = CAMERA_ERROR * np.array(config.sigma_scale)[horizontal_first]
        self.memory_s = np.maximum(np.array(config.correlation_s)[horizontal_first] / 2.0, CAMERA_MEMORY_S)

    @property
    def context(self) -> int:
        """Frames of motion that it looks at."""
        return self._net.config.context

    def read(self, tracks: Sequence[BodyTrack]) -> list[Motion]:
        """What each track's body does, by its window of motion."""
        if not tracks:
            return []
        velocity, log_sigma, _ = self._net(np.stack([track.window() for track in tracks]))
        variance = np.exp(2.0 * log_sigma)
        variance[:, :2] = variance[:, :2].mean(axis=1, keepdims=True)  # the filter's noise must not know the heading
        speed = np.linalg.norm(velocity[:, :2], axis=1, keepdims=True)
        sigma = np.hypot(np.sqrt(variance) * self._scale, SCALE_FACTOR_ERROR * speed)
        return [Motion(yaw_matrix(track.yaw) @ v, sd) for track, v, sd in zip(tracks, velocity, sigma, strict=True)]


def _message(clean: PoseClean, ground: Ground, bodies: list[WorldBody]) -> PoseWorld:
    return PoseWorld(clean.stamp_ns, WORLD, clean.source, ground.plane, bodies, clean.end_of_stream)
