"""Computes a body's motion from an intent: the pelvis follows the plan, limbs reach by inverse kinematics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.spatial.transform import Rotation, Slerp

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.capsules import TOE_HEIGHT
from steadypose.prior.body.kinematics import CONTACT_JOINTS, forward_kinematics, heading, yaw_matrix
from steadypose.prior.body.skeleton import JOINTS, J
from steadypose.prior.sim.gait import RATE, FootTrack, Plan, drift, foot_track

Side = Literal["left", "right"]
SIDES: tuple[Side, Side] = ("left", "right")
SIGN: Mapping[Side, float] = {"left": 1.0, "right": -1.0}
"""Sign of each side along the body's left axis."""


@dataclass(frozen=True)
class Motion:
    """One person's true motion."""

    times: Floats  # (T,) seconds, evenly spaced
    offsets: Floats  # (22, 3) metres, the bones
    root: Floats  # (T, 3) metres, position of the pelvis in the world
    rotations: Floats  # (T, 22, 3, 3) local rotations; the pelvis' rotation is its orientation in the world
    contacts: Bools  # (T, 8) which of `CONTACT_JOINTS` rest on the floor

    @cached_property
    def _posed(self) -> tuple[Floats, Floats]:
        return forward_kinematics(self.rotations, self.offsets, self.root)

    @property
    def positions(self) -> Floats:
        """(T, 22, 3) metres, world."""
        return self._posed[0]

    @property
    def orientations(self) -> Floats:
        """(T, 22, 3, 3) orientations of the joints in the world."""
        return self._posed[1]

    @property
    def velocity(self) -> Floats:
        """(T, 3) m/s, velocity of the pelvis, world."""
        return np.gradient(self.root, self.times, axis=0)

    def at(self, times: Floats) -> Motion:
        """Resample the motion at times (S,) within its duration. Rotations are slerped, so bones keep their lengths."""
        if times.min() < self.times[0] - 1e-9 or times.max() > self.times[-1] + 1e-9:
            raise ValueError(
                f"times {times.min():.3f} to {times.max():.3f} s leave the motion, which lasts from "
                f"{self.times[0]:.3f} to {self.times[-1]:.3f} s"
            )
        times = np.clip(times, self.times[0], self.times[-1])
        turning = [Slerp(self.times, Rotation.from_matrix(self.rotations[:, j])) for j in range(len(JOINTS))]
        rotations = np.stack([slerp(times).as_matrix() for slerp in turning], axis=1)
        root = np.stack([np.interp(times, self.times, self.root[:, k]) for k in range(3)], axis=-1)
        nearest = np.clip(np.searchsorted(self.times, times - 0.5 / RATE), 0, len(self.times) - 1)
        return Motion(times, self.offsets, root, rotations, self.contacts[nearest])


@dataclass(frozen=True)
class ArmAction:
    """An action of an arm, blended with its swing."""

    weight: Floats  # (T,) 0 for the swing, 1 for this action
    wrist: Floats  # (T, 3) or (3,) metres, target of the wrist in ``frame``
    pole: Floats  # (T, 3) or (3,) direction in which the elbow points, in the chest's frame
    frame: Literal["world", "pelvis", "shoulder"]
    """"world"; "pelvis": heading frame of the pelvis, origin at the pelvis; "shoulder": the chest's frame, origin at
    this arm's shoulder, in arm lengths"""


@dataclass
class Intent:
    """Everything that a script controls; the rest of the body is at rest."""

    plan: Plan  # path of the body
    shift: Floats = field(init=False)
    """(T, 3) metres, pelvis relative to the plan in the heading frame; z relative to standing"""
    tilt: Floats = field(init=False)  # (T,) radians, forward tilt of the pelvis
    torso: Floats = field(init=False)
    """(T, 3) radians: roll (to the right positive), pitch (forward positive), yaw (to the left positive)"""
    gaze: Floats = field(init=False)  # (T, 2) radians: yaw and pitch of the head beyond the torso's
    arms: dict[Side, list[ArmAction]] = field(default_factory=lambda: {"left": [], "right": []})
    """actions of each arm, in order; a later action overrides an earlier one"""

    def __post_init__(self) -> None:
        n = len(self.plan.times)
        self.shift, self.tilt = np.zeros((n, 3)), np.zeros(n)
        self.torso, self.gaze = np.zeros((n, 3)), np.zeros((n, 2))


def perform(intent: Intent, offsets: Floats, rng: np.random.Generator) -> Motion:
    """Perform an intent with a body of bones (22, 3) metres; ``rng`` draws the idle drift.

    The pelvis sways, tilts and turns with the steps, as high as the legs allow. The chest turns against it, and the
    arms swing from the shoulders. A body that stands still drifts slightly. Feet follow `foot_track`.
    """
    plan = intent.plan
    n = len(plan.times)
    angle = 2 * np.pi * plan.phase
    effort = plan.speed / 1.2
    step, stride = np.sin(angle) * effort, np.cos(angle) * effort

    # idle drift vanishes in walking, where it would disturb the gait
    still = 1.0 / (1.0 + (4 * effort) ** 2)
    idle_shift = drift(rng, plan.times, [0.006, 0.012], 12.0, 2.5) * still[:, None]
    idle_torso = drift(rng, plan.times, np.radians([1.0, 1.0, 1.8]), 10.0, 2.0)
    idle_gaze = drift(rng, plan.times, np.radians([6.0, 2.5]), 9.0, 2.0)

    yaw = plan.yaw + np.radians(5.0) * stride
    list_ = -np.radians(3.5) * step
    pelvis = yaw_matrix(yaw) @ Rotation.from_euler("yx", np.stack([intent.tilt, list_], -1)).as_matrix()
    shift = intent.shift.copy()
    shift[:, :2] += idle_shift
    shift[:, 1] -= 0.022 * step
    root = np.concatenate([plan.xy, np.full((n, 1), _standing_height(offsets))], axis=1)
    root += np.einsum("tij,tj->ti", yaw_matrix(plan.yaw), shift)
    feet: dict[Side, FootTrack] = {side: foot_track(plan, side, offsets) for side in SIDES}
    root[:, 2] -= _lowering(root, pelvis, feet, offsets)

    torso = intent.torso + idle_torso
    torso[:, 2] -= np.radians(12.0) * stride
    torso[:, 0] += 0.8 * -list_
    torso[:, 1] += np.radians(3.0) * np.minimum(effort, 1.0)
    rotations = np.broadcast_to(np.eye(3), (n, len(JOINTS), 3, 3)).copy()
    rotations[:, 0] = pelvis
    for joint in ("spine1", "spine2", "spine3"):
        rotations[:, J[joint]] = _bend(torso / 3)
    gaze = intent.gaze + idle_gaze
    # the head is more upright, and turns less, than the chest
    nod = gaze[:, 1] - 0.5 * (torso[:, 1] + intent.tilt)
    head = np.stack([-0.6 * torso[:, 0], nod, gaze[:, 0] - 0.6 * torso[:, 2]], axis=-1)
    for joint, share in (("neck", 0.45), ("head", 0.55)):
        rotations[:, J[joint]] = _bend(share * head)

    for side in SIDES:
        _leg(rotations, root, offsets, side, feet[side], plan)
        _arm(rotations, root, offsets, side, intent, SIGN[side] * stride)

    contacts = np.zeros((n, len(CONTACT_JOINTS)), dtype=bool)
    for side in SIDES:
        contacts[:, CONTACT_JOINTS.index(J[f"{side}_ankle"])] = feet[side].heel_planted
        contacts[:, CONTACT_JOINTS.index(J[f"{side}_foot"])] = feet[side].toe_planted
    return Motion(plan.times, offsets, root, rotations, contacts)


def _bend(roll_pitch_yaw: Floats) -> Floats:
    return Rotation.from_euler("ZYX", roll_pitch_yaw[:, ::-1]).as_matrix()


def _standing_height(offsets: Floats) -> float:
    """Return the height of the pelvis above the floor, standing upright with almost straight knees, metres."""
    chain = [J["left_hip"], J["left_knee"], J["left_ankle"], J["left_foot"]]
    return TOE_HEIGHT - float(offsets[chain, 2].sum()) - 0.008


def _lowering(root: Floats, pelvis: Floats, feet: Mapping[Side, FootTrack], offsets: Floats) -> Floats:
    """(T,) metres by which the pelvis must sink, smoothly, so that no leg must exceed its length."""
    need = np.zeros(len(root))
    for side in SIDES:
        hip = root + pelvis @ offsets[J[f"{side}_hip"]]
        reach = 0.995 * _lengths(offsets, f"{side}_knee", f"{side}_ankle").sum()
        across = np.linalg.norm(hip[:, :2] - feet[side].ankle[:, :2], axis=1)
        allowed = feet[side].ankle[:, 2] + np.sqrt(np.maximum(reach**2 - across**2, 0.01))
        need = np.maximum(need, hip[:, 2] - allowed)
    # the maximum's window is wider than the Gaussian, so the smoothed curve is never too low
    half = round(0.07 * RATE)
    highest = maximum_filter1d(need, 2 * half + 1, mode="nearest")
    return gaussian_filter1d(highest, half / 2.5, mode="nearest", radius=half)


def _lengths(offsets: Floats, middle: str, end: str) -> Floats:
    return np.linalg.norm(offsets[[J[middle], J[end]]], axis=1)


def two_bone(start: Floats, goal: Floats, pole: Floats, lengths: Floats) -> tuple[Floats, Floats, Floats]:
    """Analytic two-bone inverse kinematics from shoulder or hip (T, 3) to a goal (T, 3), with elbow or knee towards
    ``pole`` (T, 3).

    A goal nearer than the limb can fold, or farther than 99.9 % of its length, is approached as far as possible.
    Returns directions of both bones, (T, 3) each, and the hinge's axis (T, 3), about which the limb flexes.
    """
    upper, lower = lengths
    along = goal - start
    far = np.linalg.norm(along, axis=-1)
    distance = np.clip(far, abs(upper - lower) + 0.15 * min(upper, lower), 0.999 * (upper + lower))
    ahead = along / np.maximum(far, 1e-9)[:, None]
    hinge = np.cross(pole, ahead)
    hinge /= np.linalg.norm(hinge, axis=-1, keepdims=True)
    outward = np.cross(ahead, hinge)
    cosine = (upper**2 + distance**2 - lower**2) / (2 * upper * distance)
    first = cosine[:, None] * ahead + np.sqrt(np.maximum(1 - cosine**2, 0.0))[:, None] * outward
    second = distance[:, None] * ahead - upper * first
    return first, second / np.linalg.norm(second, axis=-1, keepdims=True), hinge


def _oriented(direction: Floats, hinge: Floats, rest_direction: Floats, rest_pole: Floats) -> Floats:
    """Return world rotations (T, 3, 3) that turn a bone and its hinge from the rest pose to the given directions."""
    rest = rest_direction / np.linalg.norm(rest_direction)
    rest_hinge = np.cross(rest_pole, rest)
    rest_hinge /= np.linalg.norm(rest_hinge)
    after = np.stack([direction, hinge, np.cross(direction, hinge)], axis=-1)
    before = np.stack([rest, rest_hinge, np.cross(rest, rest_hinge)], axis=-1)
    return after @ before.T


_Limb = tuple[tuple[str, str, str], Floats]
_LEG: _Limb = ("hip", "knee", "ankle"), np.array([1.0, 0.0, 0.0])
_ARM: _Limb = ("shoulder", "elbow", "wrist"), np.array([-1.0, 0.0, 0.0])
"""Joints of a limb, and the direction of knee or elbow in the rest pose."""


def _limb(
    rotations: Floats, side: Side, limb: _Limb, parent: Floats, start: Floats, goal: Floats, pole: Floats,
    offsets: Floats,
) -> Floats:  # fmt: skip
    """Set the local rotations of a limb's two upper joints; returns the lower bone's world rotation."""
    joints, rest_pole = limb
    base, middle, end = (J[f"{side}_{name}"] for name in joints)
    first, second, hinge = two_bone(start, goal, pole, np.linalg.norm(offsets[[middle, end]], axis=1))
    upper = _oriented(first, hinge, offsets[middle], rest_pole)
    lower = _oriented(second, hinge, offsets[end], rest_pole)
    rotations[:, base] = np.swapaxes(parent, -1, -2) @ upper
    rotations[:, middle] = np.swapaxes(upper, -1, -2) @ lower
    return lower


def _leg(rotations: Floats, root: Floats, offsets: Floats, side: Side, foot: FootTrack, plan: Plan) -> None:
    sign = SIGN[side]
    hip = root + rotations[:, 0] @ offsets[J[f"{side}_hip"]]
    # the knee points between the directions of pelvis and foot, and a little outward
    lag = np.angle(np.exp(1j * (foot.yaw - plan.yaw)))
    pole = yaw_matrix(plan.yaw + lag / 2) @ np.array([1.0, 0.08 * sign, 0.0])
    shin = _limb(rotations, side, _LEG, rotations[:, 0], hip, foot.ankle, pole, offsets)
    rotations[:, J[f"{side}_ankle"]] = np.swapaxes(shin, -1, -2) @ foot.rotation


def _arm(rotations: Floats, root: Floats, offsets: Floats, side: Side, intent: Intent, forward: Floats) -> None:
    """Set collar, shoulder and elbow. ``forward`` (T,) is the swing; 1 is the farthest forward in a walk at 1.2 m/s."""
    sign = SIGN[side]
    collar, shoulder = J[f"{side}_collar"], J[f"{side}_shoulder"]
    lengths = _lengths(offsets, f"{side}_elbow", f"{side}_wrist")

    def place() -> tuple[Floats, Floats, Floats]:
        positions, world = forward_kinematics(rotations, offsets, root)
        return positions[:, shoulder], world[:, collar], world[:, J["spine3"]]

    at, _, chest = place()
    # arms hang by gravity, also if the chest leans
    wrist = at + _apply(yaw_matrix(heading(chest)), _hanging(forward, sign, lengths))
    pole = chest @ np.array([-1.0, 0.25 * sign, -0.2])
    for action in intent.arms[side]:
        if action.frame == "world":
            goal = action.wrist + np.zeros_like(at)
        elif action.frame == "pelvis":
            goal = root + _apply(yaw_matrix(intent.plan.yaw), action.wrist)
        else:
            goal = at + _apply(chest, action.wrist * lengths.sum())
        weight = action.weight[:, None]
        wrist = wrist + weight * (goal - wrist)
        pole = pole + weight * (_apply(chest, action.pole) - pole)
    # the shoulder girdle rises with a raised arm (scapulohumeral rhythm): above the horizontal, by a third
    raised = _apply(np.swapaxes(chest, -1, -2), wrist - at)
    u = np.clip((raised[:, 2] / lengths.sum() + 0.4) / 1.3, 0.0, 1.0)
    lift = np.radians(18.0) * (u * u * (3 - 2 * u))
    rotations[:, collar] = Rotation.from_rotvec(np.multiply.outer(sign * lift, [1.0, 0.0, 0.0])).as_matrix()
    at, girdle, _ = place()
    wrist = at + _within_reach(wrist - at, lengths.sum())
    _limb(rotations, side, _ARM, girdle, at, wrist, pole, offsets)


def _within_reach(vector: Floats, full: float) -> Floats:
    """Shorten vectors (T, 3), increasingly beyond 92 % of a limb's ``full`` length, so that it straightens smoothly."""
    far = np.linalg.norm(vector, axis=-1, keepdims=True)
    free, room = 0.92 * full, 0.065 * full
    soft = free + room * (1 - np.exp(-np.maximum(far - free, 0) / room))
    return vector * np.where(far > free, soft / np.maximum(far, 1e-9), 1.0)


def _apply(rotation: Floats, vector: Floats) -> Floats:
    return np.einsum("tij,tj->ti", rotation, np.broadcast_to(vector, (len(rotation), 3)))


def _hanging(forward: Floats, sign: float, lengths: Floats) -> Floats:
    """(T, 3) wrist relative to the shoulder, heading frame, of a hanging arm that swings by ``forward`` (T,)."""
    shoulder = np.radians(4.0) + np.radians(20.0) * forward
    elbow = np.radians(16.0) + np.radians(10.0) * (forward + np.sqrt(forward**2 + 0.04))

    def bone(flexion: Floats, outward: float) -> Floats:
        along = np.stack([np.sin(flexion), np.full_like(flexion, sign * outward), -np.cos(flexion)], axis=-1)
        return along / np.linalg.norm(along, axis=-1, keepdims=True)

    return lengths[0] * bone(shoulder, 0.16) + lengths[1] * bone(shoulder + elbow, 0.08)
