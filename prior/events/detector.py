"""Detects the events of all bodies of one stream, with thresholds in SI units (``[events]`` of a launch file)."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np

from steadypose.msgs.types import Event, EventKind, Hand, Phase, PoseWorld, Tracking, WorldBody
from steadypose.prior.arrays import Floats
from steadypose.prior.events.features import Arm, Features, facing_away, features
from steadypose.prior.events.trigger import RandomWalk, Trigger, Wave
from steadypose.prior.settings import check_range


@dataclass(frozen=True)
class EventSettings:
    """Thresholds of events. A condition ends at a second, laxer threshold (the margin), so that it does not flicker.

    The values were chosen on simulated streams, on the validation people of Bandai-Namco and on LAFAN1's subject 1
    (``benchmarks/systems/events.py``).
    """

    confidence: float = 0.7
    """Least probability that a threshold is crossed, computed from the joints' standard deviations."""
    hold: float = 0.07
    """Time for which a condition must hold before it begins or ends, seconds."""
    entered: float = 0.15
    """Time for which a body must be tracked before it has entered and its events are published, seconds."""
    left: float = 0.2
    """Time after which a body that is no longer tracked has left, seconds."""
    near: float = 1.2
    """Largest horizontal distance from the sensor to the pelvis of a near body, metres."""
    near_margin: float = 0.2
    """Additional distance at which a body is no longer near, metres."""
    faces: float = 0.6
    """Largest angle between the trunk's heading and the direction of the sensor for a body that faces it, radians."""
    faces_margin: float = 0.2
    """Additional angle at which a body no longer faces the sensor, radians."""
    faces_turn: float = 0.2
    """RMS change in one second of the line from right to left hips and shoulders, metres."""
    stands: float = 0.85
    """Least height of the hips above the lower ankle of a standing body, leg lengths."""
    stands_margin: float = 0.2
    """Reduction of that height at which a body no longer stands, leg lengths."""
    stands_change: float = 0.3
    """RMS change of that height in one second, leg lengths."""
    sits: float = 0.95
    """Least angle of the more upright thigh from the vertical of a sitting body, radians."""
    sits_margin: float = 0.25
    """Reduction of that angle at which a body no longer sits, radians."""
    lies: float = 0.65
    """Largest vertical extent of head, trunk, knees and feet of a lying body, metres."""
    lies_margin: float = 0.15
    """Additional extent at which a body no longer lies, metres."""
    fell_speed: float = 1.2
    """Least downward speed of the neck before lying that makes it a fall, m/s."""
    fell_within: float = 2.0
    """Time before lying in which that speed counts, seconds."""
    raised: float = 0.0
    """Least height of the fingertips above the neck of a raised hand, metres."""
    raised_margin: float = 0.08
    """Reduction of that height at which the hand is no longer raised, metres."""
    wave_swing: float = 0.35
    """Least angle of the forearm's swing from side to side in a wave, radians; of the first, less than half."""
    wave_within: float = 0.8
    """Longest time until the next swing, after which the wave is over, seconds."""
    point_elbow: float = 2.4
    """Least inner angle of the elbow of a stretched arm, radians (pi is straight)."""
    point_elbow_margin: float = 0.25
    """Reduction of that angle at which the arm is no longer stretched, radians."""
    point_lift: float = 0.9
    """Least angle between a pointing arm and the vertical, up or down, radians; otherwise it hangs or reaches up."""
    point_speed: float = 0.4
    """Largest speed of the wrist of a pointing arm, m/s."""
    point_hold: float = 0.15
    """Time for which these conditions must hold before an arm points, seconds."""

    def __post_init__(self) -> None:
        check_range("[events] confidence", self.confidence, 0.5, 0.999)
        for setting in fields(self):
            if setting.name != "confidence":
                most = math.pi if setting.name in _ANGLES else 60.0
                check_range(f"[events] {setting.name}", getattr(self, setting.name), 0.0, most)


_ANGLES = frozenset(
    {"faces", "faces_margin", "sits", "sits_margin", "wave_swing", "point_elbow", "point_elbow_margin", "point_lift"}
)
"""Settings in radians."""


NOWHERE: Floats = np.zeros(3)
NOWHERE.flags.writeable = False
SPEED_NS = 100_000_000
"""Interval over which speeds are measured, nanoseconds; a centimetre of jitter then counts as 0.1 m/s."""
UPRIGHT = 0.5
"""Least height of the neck above the pelvis of a sitting body, trunk lengths: 30 degrees above the horizontal."""
CERTAIN = 1e-6  # standard deviation of quantities that are not computed from joints


class EventDetector:
    """Detects the events of one ``pose/world`` stream causally, from the messages so far."""

    def __init__(self, settings: EventSettings | None = None) -> None:
        self._settings = settings or EventSettings()
        self._bodies: dict[int, _Body] = {}
        self._stamp_ns = -1

    def update(self, world: PoseWorld, sensor: Floats = NOWHERE, *, calibrated: bool = False) -> list[Event]:
        """Return all events that begin, continue or end with the next message of the stream.

        Args:
            world: a message of ``pose/world``. A message whose stamp is not after the last starts the stream anew.
            sensor: (3,) metres, world, the position that people come near to and face. The default is the origin, above
                which an uncalibrated sensor is.
            calibrated: whether the sensor's position is known, and so the floor, even under unobserved legs.
        """
        if world.end_of_stream or world.stamp_ns <= self._stamp_ns:
            self._bodies.clear()
        self._stamp_ns = -1 if world.end_of_stream else world.stamp_ns
        followed = {body.id: body for body in world.bodies if body.tracking != Tracking.LOST}
        for new in followed.keys() - self._bodies.keys():
            self._bodies[new] = _Body(new, world.stamp_ns, self._settings)
        floor = -float(world.ground_plane[3]) if calibrated else math.nan
        events: list[Event] = []
        for name, body in list(self._bodies.items()):
            if name in followed:
                events += body.update(world.stamp_ns, followed[name], sensor, floor)
            elif world.stamp_ns - body.stamp_ns >= self._settings.left * 1e9:
                events += body.leave(world.stamp_ns)
                del self._bodies[name]
        return events


class _Body:
    """State of one body: its active conditions, and its last one and a half seconds."""

    def __init__(self, name: int, stamp_ns: int, settings: EventSettings) -> None:
        s = self._settings = settings

        def trigger(on: float, margin: float, hold_s: float = s.hold) -> Trigger:
            return Trigger(on, margin, hold_s, s.confidence)

        self._name, self._first_ns, self.stamp_ns = name, stamp_ns, stamp_ns
        self._entered = False
        none = Hand.NONE
        self._triggers = {
            (EventKind.NEAR, none): trigger(-s.near, s.near_margin),
            (EventKind.STANDS, none): trigger(s.stands, s.stands_margin),
            (EventKind.SITS, none): trigger(s.sits, s.sits_margin),
            (EventKind.LIES, none): trigger(-s.lies, s.lies_margin),
            (EventKind.FELL, none): trigger(s.fell_speed, s.fell_speed, 0.0),
            (EventKind.FACES_SENSOR, none): trigger(-s.faces, s.faces_margin),
        }
        for hand in (Hand.LEFT, Hand.RIGHT):
            self._triggers[EventKind.HAND_RAISED, hand] = trigger(s.raised, s.raised_margin)
            self._triggers[EventKind.WAVES, hand] = trigger(0.5, 0.0, 0.0)
            self._triggers[EventKind.POINTS, hand] = trigger(s.point_elbow, s.point_elbow_margin, s.point_hold)
        self._waves = {hand: Wave(s.wave_swing, s.wave_within) for hand in (Hand.LEFT, Hand.RIGHT)}
        self._facing, self._extension = RandomWalk(s.faces_turn), RandomWalk(s.stands_change)
        self._heights: deque[tuple[int, float]] = deque()
        self._falls: deque[tuple[int, float]] = deque()
        self._wrists: deque[tuple[int, tuple[list[float], ...]]] = deque()
        self._arms: tuple[Arm, ...] = ()

    def update(self, stamp_ns: int, body: WorldBody, sensor: Floats, floor: float) -> Iterator[Event]:
        """Yield the events that begin, continue or end at ``stamp_ns``."""
        self.stamp_ns = stamp_ns
        seen = features(body, sensor, floor)
        self._arms = seen.arms
        changed = self._changed(stamp_ns, seen)
        if not self._entered:
            if stamp_ns - self._first_ns < self._settings.entered * 1e9:
                return
            self._entered = True
            changed = {key for key, trigger in self._triggers.items() if trigger.active}
            yield Event(self._name, EventKind.ENTERED, Phase.BEGINS, Hand.NONE, 1.0, NOWHERE, self._first_ns)
        for key, trigger in self._triggers.items():
            if trigger.active:
                yield self._event(key, Phase.BEGINS if key in changed else Phase.HOLDS)
            elif key in changed:
                yield self._event(key, Phase.ENDS)

    def leave(self, stamp_ns: int) -> Iterator[Event]:
        """Yield the events that end when the body leaves."""
        if self._entered:
            for key, trigger in self._triggers.items():
                if trigger.active:
                    yield self._event(key, Phase.ENDS)
            yield Event(self._name, EventKind.LEFT, Phase.BEGINS, Hand.NONE, 1.0, NOWHERE, stamp_ns)

    def _event(self, key: tuple[EventKind, Hand], phase: Phase) -> Event:
        kind, hand = key
        trigger = self._triggers[key]
        direction = NOWHERE if kind != EventKind.POINTS else self._arms[hand - Hand.LEFT].direction
        return Event(self._name, kind, phase, hand, trigger.confidence, direction, trigger.since_ns)

    def _changed(self, now: int, seen: Features) -> set[tuple[EventKind, Hand]]:
        """Update all triggers, and return those that have changed."""
        s, none = self._settings, Hand.NONE
        changed: set[tuple[EventKind, Hand]] = set()

        def take(kind: EventKind, hand: Hand, value: float, sigma: float, possible: bool = True) -> bool:
            if self._triggers[kind, hand].update(now, value, sigma, possible):
                changed.add((kind, hand))
            return self._triggers[kind, hand].active

        lies = take(EventKind.LIES, none, -seen.extent.value, seen.extent.sigma)
        upright = not seen.trunk < UPRIGHT  # also True if it is unknown
        sits = take(EventKind.SITS, none, *seen.thigh, possible=upright and not lies)
        (extension,), extension_sigma = self._extension.update(now, (seen.extension.value,), seen.extension.sigma)
        stands = take(EventKind.STANDS, none, extension, extension_sigma, possible=not lies and not sits)
        fastest = self._fastest_fall(now, seen.neck)
        fallen = self._triggers[EventKind.FELL, none].active
        down = (lies or fallen) and not (stands or sits)
        take(EventKind.FELL, none, s.fell_speed + 1.0 if fallen else fastest, CERTAIN, possible=down)
        take(EventKind.NEAR, none, -seen.distance.value, seen.distance.sigma)
        turned = facing_away(*self._facing.update(now, seen.across, seen.across_sigma), seen.to_sensor)
        take(EventKind.FACES_SENSOR, none, -turned.value, turned.sigma, possible=not lies)
        speeds = self._wrist_speeds(now, seen.arms)
        for hand, arm, speed in zip((Hand.LEFT, Hand.RIGHT), seen.arms, speeds, strict=True):
            take(EventKind.HAND_RAISED, hand, *arm.raised, possible=upright and not lies)
            upright_arm, up = arm.upright and not lies, arm.up and not lies
            waving = self._waves[hand].update(now, arm.swing, arm.raised.value, upright_arm, up)
            take(EventKind.WAVES, hand, float(waving), CERTAIN)
            still = speed < s.point_speed and arm.lift > s.point_lift
            take(EventKind.POINTS, hand, *arm.elbow, possible=still and not lies)
        return changed

    def _fastest_fall(self, now: int, height: float) -> float:
        """Return the largest downward speed of the neck in the time that counts for a fall, m/s."""
        self._heights.append((now, height))
        while now - self._heights[0][0] > SPEED_NS:
            then, was = self._heights.popleft()
            self._falls.append((now, (was - height) * 1e9 / (now - then)))
        while self._falls and now - self._falls[0][0] > self._settings.fell_within * 1e9:
            self._falls.popleft()
        return max((speed for _, speed in self._falls if not math.isnan(speed)), default=0.0)

    def _wrist_speeds(self, now: int, arms: tuple[Arm, Arm]) -> list[float]:
        """Return the speeds of both wrists, m/s."""
        self._wrists.append((now, tuple(arm.wrist for arm in arms)))
        while len(self._wrists) > 2 and now - self._wrists[1][0] >= SPEED_NS:
            self._wrists.popleft()
        then, were = self._wrists[0]
        if then == now:
            return [math.inf, math.inf]
        return [math.dist(arm.wrist, was) * 1e9 / (now - then) for arm, was in zip(arms, were, strict=True)]
