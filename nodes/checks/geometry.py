"""Checks of joint positions: a human body, in metres, upright, not mirrored, moving at plausible speed."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.types import Level, Pose, PoseRaw
from steadypose.nodes.checks.problem import Problem, bodies, error, observed, tracks, warning
from steadypose.prior.arrays import Floats, medians
from steadypose.prior.body.kinematics import SensorFrame
from steadypose.prior.body.layouts import SKELETONS, Skeleton, to_canonical
from steadypose.prior.body.likeness import Likeness, Stance, likeness, likenesses, stance
from steadypose.prior.body.skeleton import J, at_origin
from steadypose.prior.clean.admission import MAX_DISTANCE

ENOUGH = 15
"""Smallest number of messages to judge by."""
SIZES = (0.5, 1.4)
"""Range of body sizes relative to an adult, from a child of three to the tallest adult."""
UNITS = {"millimetres": 1000.0, "centimetres": 100.0, "inches": 39.37, "feet": 3.281, "metres divided by 1000": 0.001}
ADULT_M = 1.72
UPRIGHT, ALONG = 0.5, 0.85
"""Cosines of the body's up direction: with the vertical, above which it counts as upright; with an axis of its frame,
above which it stands along that axis."""
MIRRORED = -0.2
"""Handedness below which a body counts as mirrored. Correct trackers stay above 0.2."""
FASTEST = 8.0
"""Largest speed of a body, body heights per second; twice a sprinter's."""
RUNNER_M_S, LIMB_M_S = 7.0, 8.0
"""Largest sustained speeds of a body, and of a limb relative to the trunk, m/s. In motion capture of actors, dancers
and sprinters, the largest medians over 1.5 s are 3.7 and 4.8 m/s."""
SPEED_BASE_NS = 50_000_000
"""Interval over which speed is measured, nanoseconds. A jitter of 2 cm then amounts to 0.6 m/s."""
FLOOR_M = (-0.4, 0.7)
"""Range of the lowest leg joint's height above the floor, metres. A pit or a stage exceeds it."""


def check_geometry(messages: Sequence[PoseRaw]) -> Iterator[Problem]:
    """Problems with the joint positions in a window of messages."""
    messages = [raw for raw in messages if raw.skeleton == messages[-1].skeleton]
    if len(messages) < ENOUGH or messages[-1].skeleton not in SKELETONS:
        return
    skeleton = SKELETONS[messages[-1].skeleton]
    joints = tracks(messages, len(skeleton.joints))
    if len(joints) < ENOUGH:
        return
    if not np.isfinite(joints).any():
        if any(np.isfinite(body.positions).any() for body in bodies(messages)):
            return  # all of confidence 0: see `layout`
        yield error(
            "all_missing",
            f"all joints of the last {len(joints)} bodies are NaN: expected metres. Where nobody is, send no body; in "
            "an array, NaN says the same, and this can be ignored",
        )
        return
    if (problem := _degenerate(messages, joints) or _zeros(skeleton, joints)) is not None:
        yield problem
        return
    like = likeness(skeleton, joints)
    if like is None:
        return
    if not like.is_body:
        yield _no_body(skeleton, like, joints)
        return
    if not SIZES[0] < like.scale < SIZES[1]:
        yield _unit(like)
    else:
        yield from _far(joints)
    stand = stance(skeleton, joints)
    if stand is not None:
        yield from _frame(messages[-1].sensor_pose, stand)
        if SIZES[0] < like.scale < SIZES[1]:
            yield from _place(messages[-1], skeleton, joints)


def check_jumps(messages: Sequence[PoseRaw]) -> Iterator[Problem]:
    """The problem of whole bodies that jump. The stamps must be valid nanoseconds."""
    paths = _paths(messages)
    speeds = [np.zeros(0)]
    for stamps, joints in paths:
        intervals = np.diff(stamps)
        moved = np.linalg.norm(np.diff(medians(joints, axis=1), axis=0), axis=-1)
        speeds.append(moved[intervals > 0] / intervals[intervals > 0] * 1e9)
    found = np.concatenate(speeds)
    if len(found) < ENOUGH:
        return
    joints = tracks(messages, paths[0][1].shape[1])
    height = float(np.nanmax(np.nanmax(joints, axis=1) - np.nanmin(joints, axis=1)))
    if (fast := float(np.nanmedian(found))) > FASTEST * height > 0:
        yield warning(
            "jumps",
            f"a body moves at {fast:.0f} units per second, {fast / height:.0f} times its height: expected less than "
            f"{FASTEST:.0f}; if ids switch between people, --set prior.identify.enabled=true; if stamps are times of "
            "arrival, use times of capture",
        )


def check_speed(messages: Sequence[PoseRaw]) -> Iterator[Problem]:
    """The problem of a body that moves faster than people do, caused by a wrong rate or wrong stamps. In metres."""
    stamps, joints = max(_paths(messages), key=lambda path: len(path[0]), default=(np.zeros(0), np.zeros(0)))
    if len(stamps) < ENOUGH:
        return
    interval = max(float(np.median(np.diff(stamps))), 1.0)
    step = min(math.ceil(SPEED_BASE_NS / interval), len(stamps) // 2)
    seconds = (stamps[step:] - stamps[:-step]) * 1e-9
    middle = np.nanmedian(joints, axis=1)
    limbs = joints - middle[:, None]
    moved = np.linalg.norm(middle[step:] - middle[:-step], axis=-1) / seconds
    swung = np.linalg.norm(limbs[step:] - limbs[:-step], axis=-1) / seconds[:, None]
    whole, limb = float(np.nanmedian(moved)), float(np.nanmax(np.nanmedian(swung, axis=0)))
    if whole > RUNNER_M_S or limb > LIMB_M_S:
        what = f"a body moves at {whole:.0f} m/s" if whole > RUNNER_M_S else f"a limb swings at {limb:.0f} m/s"
        yield warning(
            "too_fast",
            f"{what} for a second, which no person does, with frames {interval / 1e6:.3g} ms apart: expected times of "
            "capture; set fps to the rate at which the recording was made, such as 30, or give stamps of capture",
        )


def _paths(messages: Sequence[PoseRaw]) -> list[tuple[NDArray[np.int64], Floats]]:
    """Stamps (T,) and joints (T, J, 3) of each body that has all joints of its layout; of no body, if it is unknown."""
    skeleton = SKELETONS.get(messages[-1].skeleton)
    rows: dict[int, list[tuple[int, Floats]]] = {}
    for raw in messages if skeleton else ():
        for body in raw.bodies:
            if skeleton and len(body.positions) == len(skeleton.joints):
                rows.setdefault(body.id, []).append((raw.stamp_ns, observed(body)))
    return [
        (np.array([stamp for stamp, _ in row]), np.array([joints for _, joints in row], np.float64))
        for row in rows.values()
    ]


def _degenerate(messages: Sequence[PoseRaw], joints: Floats) -> Problem | None:
    several = joints[np.isfinite(joints[..., 0]).sum(axis=1) > 1]  # a single joint is a point in any case
    if not len(several):
        return None
    flat = np.nanmax(several, axis=1) == np.nanmin(several, axis=1)
    if 2 * (points := flat.all(axis=1)).sum() >= len(several):
        return error(
            "one_point",
            f"all joints of a body are at one point, {np.nanmax(several[points][-1], axis=0).round(3).tolist()}, in "
            f"{points.sum()} of the last {len(several)} bodies: expected metres, and NaN of a joint that was not seen",
        )
    if flat.all(axis=0).any():
        axis = "xyz"[int(np.argmax(flat.all(axis=0)))]
        return error(
            "flat",
            f"{axis} is the same for all joints, as in 2D key points without depth: expected three coordinates in "
            "metres; if you have a depth image, from_coco lifts key points to 3D (docs/sources.md)",
        )
    stamps = {raw.stamp_ns for raw in messages if raw.bodies}
    if len(stamps) >= ENOUGH and len(joints) >= len(messages):
        first, *others = (raw.bodies[0].positions for raw in messages if raw.bodies)
        if all(np.array_equal(first, other, equal_nan=True) for other in others):
            return error(
                "frozen",
                f"the joints are identical to the last bit in {len(messages)} messages with {len(stamps)} "
                "different stamps: the tracker repeats its last answer; expected new joints with each stamp, or no "
                "message",
            )
    return None


def _zeros(skeleton: Skeleton, joints: Floats) -> Problem | None:
    """The problem of joints (N, J, 3) that are zero where the sensor has none. A pelvis may be the origin, as may the
    midpoint of the hips, which no canonical joint needs."""
    weights = skeleton.to_canonical
    zero = (joints == 0.0).all(axis=-1) & weights.any(axis=0) & (weights[J["pelvis"]] != 1.0)
    if not zero.any():
        return None
    worst = int(zero.sum(axis=0).argmax())
    return error(
        "zeros",
        f"joints lie exactly at the origin, {skeleton.joints[worst]} in {zero[:, worst].sum()} of the last "
        f"{len(joints)} bodies: expected NaN, or confidence 0, for a joint that was not found",
    )


def _no_body(skeleton: Skeleton, like: Likeness, joints: Floats) -> Problem:
    others = [other for other in likenesses(joints) if other.skeleton != skeleton.name]
    off = f"{like.worst} is {like.ratio:.1f} times as long as in a body"
    if others and others[0].is_body:
        return error(
            "wrong_order",
            f"in the order of {skeleton.name} these joints do not form a body ({off}), but in that of "
            f"{others[0].skeleton} they do: expected skeleton {others[0].skeleton!r}",
        )
    tried = ", ".join(other.skeleton for other in others)
    return error(
        "wrong_order",
        f"in the order of {skeleton.name} these joints do not form a body "
        f"({off}){f', nor in that of {tried}' if tried else ''}: expected {', '.join(skeleton.joints[:4])}, …, as in "
        "prior/body/layouts.toml; reorder yours, or describe your layout (docs/sources.md)",
    )


def _unit(like: Likeness) -> Problem:
    height = like.scale * ADULT_M
    for unit, factor in UNITS.items():
        if SIZES[0] < like.scale / factor < SIZES[1]:
            return error(
                "unit",
                f"the body is {float(f'{height:.3g}'):g} m tall: these seem to be {unit}, expected metres; "
                + (f"divide by {factor:g}" if factor > 1 else f"multiply by {1 / factor:g}"),
            )
    return error(
        "unit",
        f"the body is {height:.3g} m tall: expected metres, not image coordinates (pixels or normalised); use the "
        "tracker's world coordinates",
    )


def _far(joints: Floats) -> Iterator[Problem]:
    """The problem of bodies, joints (N, J, 3), of which most joints are too far from the sensor to be used."""
    away = medians(np.abs(joints).max(axis=-1), axis=1)
    far = away[np.isfinite(away)] > MAX_DISTANCE
    if far.sum() >= ENOUGH:
        found = error(
            "too_far",
            f"joints are {np.nanmax(away):.0f} m from the sensor: expected at most {MAX_DISTANCE:.0f} m, and farther "
            "ones are not used; if these are world coordinates, give sensor_pose and joints relative to it, or "
            "subtract an origin near the people",
        )
        yield found if far.all() else replace(found, level=Level.WARN)


def _frame(pose: Pose, stand: Stance) -> Iterator[Problem]:
    """Problems with the direction of up, and with mirrored or exchanged axes."""
    up = SensorFrame.of(pose).rotation @ stand.up
    mirrored = stand.handed < MIRRORED
    if up[2] >= UPRIGHT:
        if mirrored:
            yield error(
                "mirrored",
                "bodies are mirrored: given their left and right, toes, noses and knees point backwards; expected a "
                "right-handed frame and the person's own left: negate x, or undo an exchange of two axes, or of left "
                "and right (a mirrored image)",
            )
        return
    axis = int(np.argmax(np.abs(stand.up)))
    if abs(stand.up[axis]) < ALONG:
        yield warning(
            "not_upright",
            f"bodies lean by {np.degrees(np.arccos(np.clip(up[2], -1, 1))):.0f} degrees, along no axis of their frame: "
            "expected sensor_pose.orientation to turn their frame to z up; calibrate the sensor, or give the direction "
            "of gravity (docs/calibrate.md)",
        )
        return
    name = ("-" if stand.up[axis] < 0 else "") + "xyz"[axis]
    x, _, _, w = pose.orientation
    if abs(abs(x) - 1.0) < 0.01 and abs(w) < 0.01 and name == "z":
        yield error(
            "quaternion_order",
            "sensor_pose.orientation is 1 0 0 0, which turns bodies upside down; it seems to be the identity as wxyz: "
            "expected xyzw, 0 0 0 1",
        )
    elif mirrored and name in ("y", "-y"):
        yield error(
            "axes_exchanged",
            f"bodies stand along {name} of their frame and are mirrored: y and z are exchanged; expected x, y, z of a "
            "right-handed frame: exchange them back",
        )
    elif mirrored:
        yield error(
            "axis_sign",
            f"bodies stand along {name} of their frame and are mirrored: that axis has the wrong sign, or was "
            "exchanged with z; expected a right-handed frame with z up",
        )
    else:
        wanted = f"up {name!r}: Pose.from_up({name!r}), or up = {name!r} in the file"
        yield warning(
            "up_axis",
            f"bodies lie down in the world: they stand along {name} of their frame; unless people do lie, expected "
            + (wanted if name in ("z", "y", "-y") else "sensor_pose.orientation to turn that axis to the world's z"),
        )


def _place(raw: PoseRaw, skeleton: Skeleton, joints: Floats) -> Iterator[Problem]:
    """Problems with bodies that stay at the origin, or whose feet are far from the floor."""
    canonical, _ = to_canonical(skeleton, joints)
    if at_origin(canonical):
        yield warning(
            "root_relative",
            "the pelvis is at the origin in every frame, so that nobody moves: the joints seem to be relative to the "
            "root; expected positions relative to the sensor: add the root's place, or have `steadypose complete` "
            "predict it",
        )
    elif raw.calibrated:
        world = SensorFrame.of(raw.sensor_pose).to_world(canonical)
        legs = world[:, [J[f"{side}_{joint}"] for side in ("left", "right") for joint in ("ankle", "foot")], 2]
        if (
            np.isfinite(legs).any()
            and not FLOOR_M[0] < (lowest := float(np.nanmedian(np.nanmin(legs, axis=1)))) < FLOOR_M[1]
        ):
            yield warning(
                "floor",
                f"the sensor is marked as calibrated, but feet are at a height of {lowest:.2f} m: expected "
                "the floor at 0; calibrate again (docs/calibrate.md), or set calibrated=False",
            )
