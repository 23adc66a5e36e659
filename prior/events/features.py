"""The quantities of a pose that events depend on, each with its standard deviation.

Most are differences between joints of the same body, in the z-up world frame, so that drift of the body's position
affects only the distance to the sensor. If both legs are only guesses, as behind a counter, the height of the hips over
a known floor determines whether a body stands or sits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from steadypose.msgs.types import CONTACTS, JointState, WorldBody
from steadypose.prior.arrays import Floats, Floats32
from steadypose.prior.body.skeleton import REST_OFFSETS, REST_POSITIONS, J

Point = list[float]
HAND = 0.18
"""Distance from wrist to fingertips of an adult, metres (Drillis and Contini 1966: 0.108 of the stature)."""

ACROSS = [J[f"{side}_{part}"] for side in ("left", "right") for part in ("hip", "shoulder")]
HIPS, SHOULDERS = (
    float(REST_POSITIONS[J[f"left_{part}"], 1] - REST_POSITIONS[J[f"right_{part}"], 1]) for part in ("hip", "shoulder")
)
"""Distances between the hip and shoulder joints of an adult, metres."""

NARROW = 0.05  # least horizontal width of hips and shoulders together at which a body's heading is defined, metres

ANKLE, LEG_SIGMA, TRUNK_SIGMA = 0.07, 0.05, 0.05
"""Height of a standing adult's ankle over the floor, and standard deviations of an unobserved leg's length and of
unobserved hips' height under the neck, metres."""

SEATED, UPRIGHT = 0.5, 0.85
"""Heights of the hips above a standing ankle that count as level thighs and as straight legs if both are unobserved, in
their guessed lengths. A short person's are guessed too long, by up to a fifth."""

ANKLES = [J["left_ankle"], J["right_ankle"]]
ANKLE_CONTACTS = [CONTACTS.index("left_ankle"), CONTACTS.index("right_ankle")]
"""Ankles among joints and among `CONTACTS`; those of legs that are only guesses have no contacts."""

_ABOVE = [[J["left_hip"], J["right_hip"]], [J["left_knee"], J["right_knee"]]]
_BELOW = [[J["left_knee"], J["right_knee"]], ANKLES]
_LEG = np.linalg.norm(REST_OFFSETS[[[J["left_knee"]], [J["left_ankle"]]]], axis=-1)
"""Ends of thighs and shanks, and their lengths in an adult, metres."""

EXTENT = [J[name] for name in ("head", "neck", "pelvis", "left_knee", "right_knee", "left_ankle", "right_ankle")]


class Quantity(NamedTuple):
    """An estimate and its standard deviation; NaN if a joint that it needs is unknown."""

    value: float
    sigma: float


class Arm(NamedTuple):
    """One arm."""

    raised: Quantity  # height of the fingertips above the neck, from the forearm's direction, metres
    elbow: Quantity  # inner angle, radians; pi is straight
    lift: float  # angle between the line from shoulder to wrist and the nearer vertical, radians
    swing: float
    """Angle of the forearm from upright, towards the body's left, radians; NaN if unobserved, as guesses jitter."""
    up: bool  # whether the hand is at least as high as the chest
    upright: bool  # whether, in addition, the forearm points up
    wrist: Point  # (3,) metres, world
    direction: Floats
    """(3,) unit vector, world, from the head through the wrist: the most accurate line of pointing (Nickel and
    Stiefelhagen 2007)."""


class Features(NamedTuple):
    """Quantities of one body at one time."""

    distance: Quantity  # horizontal distance from sensor to pelvis, metres
    to_sensor: tuple[float, float]  # (2,) horizontal vector from the pelvis to the sensor, metres
    across: tuple[float, float]
    """(2,) horizontal vector from right to left, hips and shoulders together, metres, normal to the heading; from the
    rotations of pelvis and chest, because bone lengths and the whole body correct their joints."""
    across_sigma: float  # standard deviation of each component of `across`, metres
    extension: Quantity  # height of the hips above the lower ankle, leg lengths
    thigh: Quantity  # angle of the more upright thigh from straight down, radians
    extent: Quantity  # vertical extent of head, trunk, knees and feet, metres
    neck: float  # height of the neck in the world, metres
    trunk: float  # height of the neck above the pelvis, trunk lengths
    arms: tuple[Arm, Arm]  # left and right arm


def features(body: WorldBody, sensor: Floats, floor: float = math.nan) -> Features:
    """Compute the features of one body, relative to a sensor at (3,) metres, world.

    ``floor`` is the height of a known floor, metres, world; NaN if there is none.
    """
    known = body.state != JointState.UNKNOWN
    observed: list[bool] = np.isin(body.state, (JointState.SEEN, JointState.REFINED)).tolist()
    p: list[Point] = np.where(known[:, None], body.positions, np.nan).tolist()
    s: list[float] = body.sigma.tolist()
    hips = _middle(p[J["left_hip"]], p[J["right_hip"]])
    ankle = min(ANKLES, key=lambda joint: _last_if_nan(p[joint][2]))
    leg = 0.5 * sum(
        math.dist(p[J[f"{side}_{upper}"]], p[J[f"{side}_{lower}"]])
        for side in ("left", "right")
        for upper, lower in (("hip", "knee"), ("knee", "ankle"))
    )
    extension = Quantity((hips[2] - p[ankle][2]) / leg, math.hypot(s[J["pelvis"]], s[ankle]) / leg)
    thigh = min((_thigh(p, s, side) for side in ("left", "right")), key=lambda q: _last_if_nan(q.value))
    if np.isnan(body.contacts[ANKLE_CONTACTS]).all() and not any(observed[joint] for joint in ANKLES):
        neck, pelvis = J["neck"], J["pelvis"]
        # a guess's deviation is mostly horizontal: that of hips under an observed neck is the trunk's lean and length
        below = math.hypot(s[neck], TRUNK_SIGMA) if observed[neck] and not observed[pelvis] else math.inf
        extension, thigh = _from_height(body.positions, hips[2] - floor - ANKLE, min(s[pelvis], below))
    heights = sorted((p[joint][2], joint) for joint in EXTENT if not math.isnan(p[joint][2]))
    if len(heights) > len(EXTENT) // 2:
        (low, lowest), (high, highest) = heights[0], heights[-1]
        extent = Quantity(high - low, math.hypot(s[lowest], s[highest]))
    else:
        extent = Quantity(math.nan, math.nan)
    left = _left(body) if all(known[ACROSS]) else (math.nan, math.nan)
    to_sensor = (float(sensor[0] - body.root_position[0]), float(sensor[1] - body.root_position[1]))
    return Features(
        _away(body, to_sensor),
        to_sensor,
        left,
        math.sqrt(sum(s[joint] ** 2 for joint in ACROSS)),
        extension,
        thigh,
        extent,
        p[J["neck"]][2],
        (p[J["neck"]][2] - p[J["pelvis"]][2]) / max(math.dist(p[J["neck"]], p[J["pelvis"]]), 0.1),
        (_arm(p, s, observed, left, "left"), _arm(p, s, observed, left, "right")),
    )


def facing_away(across: Sequence[float], sigma: float, to_sensor: Sequence[float]) -> Quantity:
    """Horizontal angle between a body's heading and the sensor, radians; the body's left is along ``across``."""
    width, far = math.hypot(*across), math.hypot(*to_sensor)
    if far < 1e-6 or not width > NARROW:
        return Quantity(math.nan, math.nan)
    cosine = (across[1] * to_sensor[0] - across[0] * to_sensor[1]) / (width * far)
    return Quantity(math.acos(max(-1.0, min(1.0, cosine))), sigma / width)


def _away(body: WorldBody, to_sensor: Sequence[float]) -> Quantity:
    """Horizontal distance from the sensor to the pelvis, metres."""
    (x, y), c = to_sensor, body.covariance
    far = math.hypot(x, y)
    if far < 1e-6:
        return Quantity(0.0, 0.0)
    variance = float(c[0, 0] * x * x + (c[0, 1] + c[1, 0]) * x * y + c[1, 1] * y * y) / far**2
    return Quantity(far, math.sqrt(max(variance, 0.0)))


def _thigh(p: list[Point], s: list[float], side: str) -> Quantity:
    hip, knee = J[f"{side}_hip"], J[f"{side}_knee"]
    length = math.dist(p[hip], p[knee])
    return Quantity(_angle_to_up(p[knee], p[hip]), math.hypot(s[hip], s[knee]) / max(length, 0.1))


def _from_height(p: Floats32, height: float, sigma: float) -> tuple[Quantity, Quantity]:
    """Extension of unobserved legs and angle of their thighs, from the height of the hips above a standing ankle and
    its standard deviation, metres. Between `SEATED` and `UPRIGHT`, they are interpolated. A bone without an estimate is
    as long as the other side's, or an adult's."""
    lengths = np.linalg.norm(p[_BELOW] - p[_ABOVE], axis=-1)
    lengths = np.where(np.isfinite(lengths), lengths, lengths[:, ::-1])
    leg = float(np.where(np.isfinite(lengths), lengths, _LEG).mean(axis=1).sum())
    upright = (height / leg - SEATED) / (UPRIGHT - SEATED)
    spread = math.hypot(sigma, LEG_SIGMA) / leg / (UPRIGHT - SEATED)
    angle = math.nan if math.isnan(height) else math.acos(max(-1.0, min(1.0, upright)))
    return Quantity(0.5 + 0.5 * upright, 0.5 * spread), Quantity(angle, spread)


def _left(body: WorldBody) -> tuple[float, float]:
    rotations, root = body.rotations.tolist(), body.root_orientation.tolist()
    chest = [0.0, SHOULDERS, 0.0]
    for joint in (J["spine3"], J["spine2"], J["spine1"]):
        chest = _rotated(rotations[joint], chest)
    chest, hips = _rotated(root, chest), _rotated(root, [0.0, HIPS, 0.0])
    return chest[0] + hips[0], chest[1] + hips[1]


def _rotated(quaternion: list[float], v: Point) -> Point:
    x, y, z, w = quaternion
    a, b, c = 2.0 * (y * v[2] - z * v[1]), 2.0 * (z * v[0] - x * v[2]), 2.0 * (x * v[1] - y * v[0])
    return [v[0] + w * a + y * c - z * b, v[1] + w * b + z * a - x * c, v[2] + w * c + x * b - y * a]


def _arm(p: list[Point], s: list[float], observed: list[bool], left: tuple[float, float], side: str) -> Arm:
    shoulder, elbow, wrist = (J[f"{side}_{part}"] for part in ("shoulder", "elbow", "wrist"))
    neck, head = J["neck"], J["head"]
    upper, lower = math.dist(p[shoulder], p[elbow]), math.dist(p[elbow], p[wrist])
    whole = math.dist(p[shoulder], p[wrist])
    cosine = (upper**2 + lower**2 - whole**2) / max(2.0 * upper * lower, 1e-6)
    inner = math.nan if math.isnan(cosine) else math.acos(max(-1.0, min(1.0, cosine)))
    from_up = _angle_to_up(p[shoulder], p[wrist])
    forearm = [p[wrist][k] - p[elbow][k] for k in range(3)]
    width = math.hypot(*left)
    aside = (forearm[0] * left[0] + forearm[1] * left[1]) / max(width, 1e-6)
    along = np.array(p[wrist]) - p[head]
    return Arm(
        Quantity(p[wrist][2] + HAND * forearm[2] / max(lower, 0.1) - p[neck][2], math.hypot(s[wrist], s[neck])),
        Quantity(inner, math.hypot(s[elbow], s[wrist]) / max(min(upper, lower), 0.1)),
        min(from_up, math.pi - from_up),
        math.atan2(aside, forearm[2]) if observed[elbow] and observed[wrist] else math.nan,
        p[wrist][2] > p[J["spine3"]][2],
        forearm[2] > 0.5 * lower and p[wrist][2] > p[J["spine3"]][2],
        p[wrist],
        along / max(float(np.linalg.norm(along)), 1e-6),
    )


def _middle(a: Point, b: Point) -> Point:
    return [0.5 * (a[k] + b[k]) for k in range(3)]


def _angle_to_up(start: Point, end: Point) -> float:
    """Angle between the line from ``start`` to ``end`` and the vertical, radians."""
    length = math.dist(start, end)
    return math.acos(max(-1.0, min(1.0, (end[2] - start[2]) / length))) if length > 1e-6 else math.nan


def _last_if_nan(value: float) -> float:
    return math.inf if math.isnan(value) else value
