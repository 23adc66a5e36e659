"""Locomotion: the path of the pelvis, and positions and times of the feet's steps.

A plan moves the pelvis over the floor, and the feet follow. Time is counted in strides (the *phase*). The left foot
swings from 0.05 to 0.45 of each stride, the right foot from 0.55 to 0.95. Stance therefore lasts 60 %, and both feet
stand around each half stride, where a walk can begin or end. A foot is planted under the point that the pelvis passes
at the middle of the stance, whether the body walks, turns on the spot or does both. It does not move until first its
heel and then its toe leaves the floor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.capsules import TOE_HEIGHT
from steadypose.prior.body.kinematics import yaw_matrix
from steadypose.prior.body.skeleton import J


def minimum_jerk(progress: ArrayLike) -> Floats:
    """Minimum-jerk profile of Flash and Hogan (1985): from 0 to 1 over ``progress`` 0..1, at rest at both ends."""
    u = np.clip(np.asarray(progress, dtype=np.float64), 0.0, 1.0)
    return u**3 * (10.0 - 15.0 * u + 6.0 * u**2)


@dataclass(frozen=True)
class Key:
    """A change of a track to ``value`` between ``start`` and ``end``, seconds."""

    start: float
    end: float
    value: ArrayLike


def track(times: Floats, initial: ArrayLike, keys: Sequence[Key]) -> Floats:
    """Interpolate a value (T, ...) at these times (T,) seconds from key to key, twice continuously differentiable.

    Each key adds its difference from the previous key along a minimum-jerk profile. Keys that overlap in time blend:
    the track passes near the first without stopping, like a hand at a via-point.
    """
    previous = np.asarray(initial, dtype=np.float64)
    value = np.broadcast_to(previous, (len(times), *previous.shape)).copy()
    for key in keys:
        target = np.asarray(key.value, dtype=np.float64)
        gain = minimum_jerk((times - key.start) / (key.end - key.start))
        value += gain.reshape(-1, *(1,) * target.ndim) * (target - previous)
        previous = target
    return value


def drift(rng: np.random.Generator, times: Floats, std: ArrayLike, slowest_s: float, fastest_s: float) -> Floats:
    """Random smooth motion (T, C) of these long-term standard deviations (C,): six sinusoids per channel with random
    periods, between these two in seconds, and phases."""
    std = np.atleast_1d(np.asarray(std, dtype=np.float64))
    waves = 6
    period = np.exp(rng.uniform(np.log(fastest_s), np.log(slowest_s), (waves, len(std))))
    phase = rng.uniform(0.0, 2 * np.pi, (waves, len(std)))
    # slow sway is wider than fast tremor: amplitudes are proportional to periods
    amplitude = period / np.sqrt((period**2).sum(axis=0) / 2)
    angle = 2 * np.pi * times[:, None, None] / period + phase
    return std * (amplitude * np.sin(angle)).sum(axis=1)


RATE = 120  # frame rate of the simulated motions, frames per second

LIFT, LAND = 0.05, 0.45
"""Phases at which the left foot's toe leaves the floor and its heel lands; the right foot is half a stride later."""
HEEL_OFF_BEFORE_LIFT = 0.22
FLAT_AFTER_LAND = 0.08
UNDER_AFTER_LAND = 0.255
"""Phase from landing until the pelvis passes over the ankle, a little before mid-stance."""

_RAMP_S = 1.0  # time from standing to full speed, seconds
_REFERENCE_SPEED = 1.2  # speed at which an adult makes 0.9 strides per second, m/s
_REFERENCE_CADENCE = 0.9
_TURN_ARM = 0.8  # radius of a walked arc that takes as many steps as a turn on the spot, metres


@dataclass(frozen=True)
class Stand:
    """Stay for ``seconds``."""

    seconds: float


@dataclass(frozen=True)
class Walk:
    """Walk a smooth curve through ``points`` (metres, world), at ``speed`` m/s once under way."""

    points: Sequence[tuple[float, float]]
    speed: float = 1.1


@dataclass(frozen=True)
class Turn:
    """Turn on the spot by ``angle`` radians (positive to the left) within ``seconds``."""

    angle: float
    seconds: float


@dataclass(frozen=True)
class Plan:
    """The pelvis over the floor."""

    times: Floats  # (T,) seconds at `RATE`
    xy: Floats  # (T, 2) metres, world
    yaw: Floats  # (T,) radians, unwrapped
    phase: Floats  # (T,) strides made
    speed: Floats  # (T,) m/s along the path
    moves: tuple[slice, ...]  # slice of frames of each walk or turn


def plan(start: tuple[float, float], yaw: float, parts: Sequence[Stand | Walk | Turn]) -> Plan:
    """Build a plan part by part from the body's start position, facing ``yaw`` radians."""
    place, facing, strides = np.array(start, dtype=np.float64), float(yaw), 0.0
    columns: list[tuple[Floats, Floats, Floats, Floats]] = []
    moves: list[slice] = []
    count = 0
    for part in parts:
        if isinstance(part, Stand):
            n = round(part.seconds * RATE)
            xy, heading = np.tile(place, (n, 1)), np.full(n, facing)
            speed, phase = np.zeros(n), np.full(n, strides)
        else:
            xy, heading, speed = _walk(place, facing, part) if isinstance(part, Walk) else _turn(place, facing, part)
            phase = _phase(strides, speed, heading)
            moves.append(slice(count, count + len(xy)))
            place, facing, strides = xy[-1], float(heading[-1]), float(phase[-1])
        columns.append((xy, heading, speed, phase))
        count += len(xy)
    xy, heading, speed, phase = (np.concatenate(c) for c in zip(*columns, strict=True))
    return Plan(np.arange(count) / RATE, xy, heading, phase, speed, tuple(moves))


def _walk(start: Floats, facing: float, part: Walk) -> tuple[Floats, Floats, Floats]:
    points = np.vstack([start, np.asarray(part.points, dtype=np.float64)])
    chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    ahead = np.array([np.cos(facing), np.sin(facing)])
    ends: Any = ((1, ahead), (2, np.zeros(2)))  # starts in the direction the body faces, ends without curvature
    curve = CubicSpline(chord, points, bc_type=ends)
    fine = np.linspace(0.0, chord[-1], max(50, int(400 * chord[-1])))
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve(fine), axis=0), axis=1))])
    ramp = min(_RAMP_S, length[-1] / part.speed)
    duration = length[-1] / part.speed + ramp
    n = round(duration * RATE)
    t = (np.arange(n) + 1) / n * duration
    speed = part.speed * (minimum_jerk(t / ramp) - minimum_jerk((t - duration + ramp) / ramp))
    travelled = np.cumsum(speed)
    at = CubicSpline(length, fine)(travelled / travelled[-1] * length[-1])
    tangent = curve(at, 1)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    heading += 2 * np.pi * np.round((facing - heading[0]) / (2 * np.pi))
    return curve(at), heading, speed


def _turn(place: Floats, facing: float, part: Turn) -> tuple[Floats, Floats, Floats]:
    n = round(part.seconds * RATE)
    heading = facing + part.angle * minimum_jerk((np.arange(n) + 1) / n)
    return np.tile(place, (n, 1)), heading, np.zeros(n)


def _phase(before: float, speed: Floats, heading: Floats) -> Floats:
    """Return strides, from half stride to half stride. Slow steps are shorter rather than less frequent."""
    effort = np.hypot(speed, _TURN_ARM * np.gradient(heading) * RATE)
    cadence = _REFERENCE_CADENCE * (effort / _REFERENCE_SPEED) ** 0.4
    strides = np.cumsum(cadence) / RATE
    halves = max(2, round(2 * float(strides[-1]) + 0.3))  # prefer a short step to a long one
    return before + strides / strides[-1] * halves / 2


@dataclass(frozen=True)
class FootTrack:
    """One foot over time."""

    ankle: Floats  # (T, 3) metres, world
    yaw: Floats  # (T,) radians, direction of the foot
    pitch: Floats  # (T,) radians, positive with the toe down
    heel_planted: Bools  # (T,) whether the ankle stays in place
    toe_planted: Bools  # (T,) whether the ball of the foot stays in place

    @property
    def rotation(self) -> Floats:
        """(T, 3, 3) world orientation of the foot; the identity is flat on the floor, facing +x."""
        return yaw_matrix(self.yaw) @ pitch_matrix(self.pitch)


def foot_track(plan: Plan, side: str, offsets: Floats) -> FootTrack:
    """Compute the steps of the foot on one side, "left" or "right", that a plan needs, of a person with bones (22, 3)
    metres."""
    sign = 1.0 if side == "left" else -1.0
    sole = offsets[J[f"{side}_foot"]]
    hip = abs(offsets[J[f"{side}_hip"], 1])
    toe_out = sign * np.radians(7.0)

    def planted(frame: float, width: float) -> tuple[Floats, float]:
        """Return ankle and yaw of a foot under the pelvis at a frame, which may be fractional."""
        x, y, yaw = (
            float(np.interp(frame, np.arange(len(plan.yaw)), v)) for v in (plan.xy[:, 0], plan.xy[:, 1], plan.yaw)
        )
        beside = yaw_matrix(yaw) @ np.array([-0.02, sign * width, 0.0])
        return np.array([x, y, TOE_HEIGHT - sole[2]]) + beside, yaw + toe_out

    standing, walking = 1.15 * hip, 0.8 * hip
    place, yaw = planted(0.0, standing)
    n = len(plan.times)
    ankle, heading, pitch = np.tile(place, (n, 1)), np.full(n, yaw), np.zeros(n)
    heel, toe = np.ones(n, dtype=bool), np.ones(n, dtype=bool)

    for move in plan.moves:
        frames = np.arange(move.start, move.stop, dtype=np.float64)
        phase = plan.phase[move]
        first = float(np.floor(phase[0] * 2 + 1e-9) / 2)
        last = float(phase[-1])

        def frame_at(p: float, phase: Floats = phase, frames: Floats = frames) -> float:
            return float(np.interp(p, phase, frames))

        offset = 0.0 if side == "left" else 0.5
        lifts = np.arange(np.ceil(first - offset - 1e-9), last - offset) + offset + LIFT
        lifts = lifts[lifts + (LAND - LIFT) < last]
        for k, lift in enumerate(lifts):
            land = lift + LAND - LIFT
            ends = k == len(lifts) - 1
            under = land + (0.37 if ends else UNDER_AFTER_LAND)  # the last steps close up to standing
            to = planted(frame_at(min(under, last)), standing if ends else walking)
            step = _Step(
                heel_off=frame_at(max(first, lift - HEEL_OFF_BEFORE_LIFT)),
                lift=frame_at(lift),
                land=frame_at(land),
                flat=frame_at(min(last, land + FLAT_AFTER_LAND)),
                origin=(place, yaw),
                target=to,
                sole=sole,
            )
            here = np.arange(int(np.ceil(step.heel_off)), n)
            ankle[here], heading[here], pitch[here] = step.at(here.astype(np.float64))
            heel[(here[0]) : int(np.ceil(step.land))] = False
            toe[int(np.ceil(step.lift)) : int(np.ceil(step.flat))] = False
            place, yaw = to
    return FootTrack(ankle, heading, pitch, heel, toe)


def pitch_matrix(angle: Floats) -> Floats:
    """Rotations (..., 3, 3) about y: a positive angle turns what faces +x towards the floor."""
    c, s, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    return np.stack([np.stack([c, zero, s], -1), np.stack([zero, one, zero], -1), np.stack([-s, zero, c], -1)], axis=-2)


@dataclass(frozen=True)
class _Step:
    """One swing of a foot, from heel-off until it is flat again; times in frames."""

    heel_off: float
    lift: float
    land: float
    flat: float
    origin: tuple[Floats, float]
    target: tuple[Floats, float]
    sole: Floats

    def pitch(self, t: Floats) -> Floats:
        """Pitch: the heel rises about the toe until toe-off; the toe is raised before the heel lands, then lowered."""
        stride = float(np.linalg.norm(self.target[0][:2] - self.origin[0][:2]))
        vigour = min(1.0, stride / 1.2)
        swing = self.land - self.lift
        rise = minimum_jerk((t - self.heel_off) / (self.lift + 0.10 * swing - self.heel_off))
        fall = minimum_jerk((t - self.lift) / (0.65 * swing))
        raise_toe = minimum_jerk((t - self.lift - 0.4 * swing) / (0.6 * swing))
        lower_toe = minimum_jerk((t - self.land) / (self.flat - self.land))
        return vigour * (np.radians(52.0) * (rise - fall) - np.radians(18.0) * (raise_toe - lower_toe))

    def _pivot(self, t: Floats) -> Floats:
        """Ankle while the toe stays: (T, 3)."""
        place, yaw = self.origin
        turned = yaw_matrix(yaw) @ (np.eye(3) - pitch_matrix(self.pitch(t))) @ self.sole
        return place + turned

    def at(self, t: Floats) -> tuple[Floats, Floats, Floats]:
        """Ankle (T, 3), yaw (T,) and pitch (T,) from heel-off on."""
        yaw = self.origin[1]
        goal, goal_yaw = self.target
        duration = self.land - self.lift
        u = np.clip((t - self.lift) / duration, 0.0, 1.0)[:, None]
        eps = 1e-3
        left = self._pivot(np.array([self.lift - eps, self.lift]))
        velocity = (left[1] - left[0]) / eps * duration
        swing = left[1] * (2 * u**3 - 3 * u**2 + 1) + velocity * (u**3 - 2 * u**2 + u) + goal * (3 * u**2 - 2 * u**3)
        swing[:, 2:] += 0.035 * 16 * u**2 * (1 - u) ** 2
        turn = (goal_yaw - yaw + np.pi) % (2 * np.pi) - np.pi
        return (
            np.where(t[:, None] < self.lift, self._pivot(t), swing),
            yaw + turn * minimum_jerk(u[:, 0]),
            self.pitch(t),
        )
