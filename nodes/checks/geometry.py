"""Checks of joint positions: a human body, in metres, upright, not mirrored, moving at plausible speed."""

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

ENOUGH = 15  # smallest number of messages to judge by
SIZES = (0.5, 1.4)  # range of body sizes relative to an adult, from a child of three to the tallest adult
UNITS = {"millimetres": 1000.0, "centimetres": 100.0, "inches": 39.37, "feet": 3.281, "metres divided by 1000": 0.001}
ADULT_M = 1.72
UPRIGHT, ALONG = 0.5, 0.85
"""Cosines of the body's up direction: with the vertical, above which it counts as upright; with an axis of its frame,
above which it stands along that axis."""
MIRRORED = -0.2  # handedness below which a body counts as mirrored. Correct trackers stay above 0.2.
FASTEST = 8.0  # largest speed of a body, body heights per second; twice a sprinter's
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
        remedy = "where nobody is, send no body; in an array, NaN says the same, and this can be ignored"
        yield error("all_missing", f"all joints of the last {len(joints)} bodies are NaN: expected metres; {remedy}")
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
        moves = f"a body moves at {fast:.0f} units per second, {fast / height:.0f} times its height"
        remedy = "if ids switch between people, --set prior.identify.enabled=true; otherwise use stamps of capture"
        yield warning("jumps", f"{moves}: expected less than {FASTEST:.0f}; {remedy}")


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
        apart = f"frames {interval / 1e6:.3g} ms apart"
        remedy = "set fps to that of the recording, such as 30, or give stamps of capture"
        yield warning("too_fast", f"{what} for a second, with {apart}: expected times of capture; {remedy}")


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
        where = f"at one point, {np.nanmax(several[points][-1], axis=0).round(3).tolist()}"
        share = f"in {points.sum()} of the last {len(several)} bodies"
        expected = "expected metres, and NaN for a joint that was not observed"
        return error("one_point", f"all joints of a body are {where}, {share}: {expected}")
    if flat.all(axis=0).any():
        axis = "xyz"[int(np.argmax(flat.all(axis=0)))]
        flat_as = f"{axis} is the same for all joints, as in 2D key points without depth"
        remedy = "if you have a depth image, from_coco lifts key points to 3D (docs/sources.md)"
        return error("flat", f"{flat_as}: expected three coordinates in metres; {remedy}")
    stamps = {raw.stamp_ns for raw in messages if raw.bodies}
    if len(stamps) >= ENOUGH and len(joints) >= len(messages):
        first, *others = (raw.bodies[0].positions for raw in messages if raw.bodies)
        if all(np.array_equal(first, other, equal_nan=True) for other in others):
            same = f"the joints are identical in {len(messages)} messages with {len(stamps)} different stamps"
            expected = "expected new joints with each stamp, or no message"
            return error("frozen", f"{same}: the tracker repeats its last output; {expected}")
    return None


def _zeros(skeleton: Skeleton, joints: Floats) -> Problem | None:
    """The problem of joints (N, J, 3) that are zero where the sensor has none. A pelvis may be the origin, as may the
    midpoint of the hips, which no canonical joint needs."""
    weights = skeleton.to_canonical
    zero = (joints == 0.0).all(axis=-1) & weights.any(axis=0) & (weights[J["pelvis"]] != 1.0)
    if not zero.any():
        return None
    worst = int(zero.sum(axis=0).argmax())
    share = f"{skeleton.joints[worst]} in {zero[:, worst].sum()} of the last {len(joints)} bodies"
    expected = "expected NaN, or confidence 0, for a joint that was not observed"
    return error("zeros", f"joints lie exactly at the origin, {share}: {expected}")


def _no_body(skeleton: Skeleton, like: Likeness, joints: Floats) -> Problem:
    others = [other for other in likenesses(joints) if other.skeleton != skeleton.name]
    worst = f"{like.worst} is {like.ratio:.1f} times as long as in a body"
    wrong = f"in the order of {skeleton.name} these joints do not form a body ({worst})"
    if others and (best := others[0]).is_body:
        name = best.skeleton
        return error("wrong_order", f"{wrong}, but in that of {name} they do: expected skeleton {name!r}")
    tried = ", ".join(other.skeleton for other in others)
    expected = f"expected {', '.join(skeleton.joints[:4])}, …, as in prior/body/layouts.toml"
    remedy = "reorder yours, or describe your layout (docs/sources.md)"
    return error("wrong_order", f"{wrong}{f', nor in that of {tried}' if tried else ''}: {expected}; {remedy}")


def _unit(like: Likeness) -> Problem:
    height = like.scale * ADULT_M
    for unit, factor in UNITS.items():
        if SIZES[0] < like.scale / factor < SIZES[1]:
            tall = f"the body is {float(f'{height:.3g}'):g} m tall"
            remedy = f"divide by {factor:g}" if factor > 1 else f"multiply by {1 / factor:g}"
            return error("unit", f"{tall}: these seem to be {unit}, expected metres; {remedy}")
    expected = "expected metres, not image coordinates (pixels or normalised)"
    return error("unit", f"the body is {height:.3g} m tall: {expected}; use the tracker's world coordinates")


def _far(joints: Floats) -> Iterator[Problem]:
    """The problem of bodies, joints (N, J, 3), of which most joints are too far from the sensor to be used."""
    away = medians(np.abs(joints).max(axis=-1), axis=1)
    far = away[np.isfinite(away)] > MAX_DISTANCE
    if far.sum() >= ENOUGH:
        got = f"joints are {np.nanmax(away):.0f} m from the sensor"
        remedy = "subtract an origin near the people, or give sensor_pose, and joints relative to it"
        expected = f"expected at most {MAX_DISTANCE:.0f} m, and farther ones are not used"
        problem = error("too_far", f"{got}: {expected}; {remedy}")
        yield problem if far.all() else replace(problem, level=Level.WARN)


def _frame(pose: Pose, stand: Stance) -> Iterator[Problem]:
    """Problems with the direction of up, and with mirrored or exchanged axes."""
    up = SensorFrame.of(pose).rotation @ stand.up
    mirrored = stand.handed < MIRRORED
    if up[2] >= UPRIGHT:
        if mirrored:
            yield error(
                "mirrored",
                "bodies are mirrored, toes, noses and knees point backwards: expected a right-handed frame and the "
                "person's own left; negate x, or undo an exchange of two axes, or of left and right (a mirrored image)",
            )
        return
    axis = int(np.argmax(np.abs(stand.up)))
    if abs(stand.up[axis]) < ALONG:
        angle = np.degrees(np.arccos(np.clip(up[2], -1, 1)))
        lean = f"bodies lean by {angle:.0f} degrees, along no axis of their frame"
        expected = "expected sensor_pose.orientation to turn their frame to z up"
        remedy = "calibrate the sensor, or give the direction of gravity (docs/calibrate.md)"
        yield warning("not_upright", f"{lean}: {expected}; {remedy}")
        return
    name = ("-" if stand.up[axis] < 0 else "") + "xyz"[axis]
    x, _, _, w = pose.orientation
    stands = f"stand along {name} of their frame"
    if abs(abs(x) - 1.0) < 0.01 and abs(w) < 0.01 and name == "z":
        got = "sensor_pose.orientation is 1 0 0 0, which turns bodies upside down"
        yield error("quaternion_order", f"{got}: it seems to be the identity as wxyz; expected xyzw, 0 0 0 1")
    elif mirrored and name in ("y", "-y"):
        expected = "expected x, y, z of a right-handed frame; exchange y and z back"
        yield error("axes_exchanged", f"bodies {stands} and are mirrored: {expected}")
    elif mirrored:
        expected = "expected a right-handed frame with z up; change that axis' sign, or exchange it with z"
        yield error("axis_sign", f"bodies {stands} and are mirrored: {expected}")
    else:
        known = f"up {name!r}: Pose.from_up({name!r}), or up = {name!r} in the file"
        other = "sensor_pose.orientation to turn that axis to the world's z"
        expected = f"unless people do lie, expected {known if name in ('z', 'y', '-y') else other}"
        yield warning("up_axis", f"bodies lie down in the world: they {stands}; {expected}")


def _place(raw: PoseRaw, skeleton: Skeleton, joints: Floats) -> Iterator[Problem]:
    """Problems with bodies that stay at the origin, or whose feet are far from the floor."""
    canonical, _ = to_canonical(skeleton, joints)
    if at_origin(canonical):
        yield warning(
            "root_relative",
            "the pelvis is at the origin in every frame, so that nobody moves: expected positions relative to the "
            "sensor; add the root's place, or have `steadypose complete` predict it",
        )
    elif raw.calibrated:
        world = SensorFrame.of(raw.sensor_pose).to_world(canonical)
        legs = world[:, [J[f"{side}_{joint}"] for side in ("left", "right") for joint in ("ankle", "foot")], 2]
        lowest = float(np.nanmedian(np.nanmin(legs, axis=1))) if np.isfinite(legs).any() else 0.0
        if not FLOOR_M[0] < lowest < FLOOR_M[1]:
            got = f"the sensor is marked as calibrated, but feet are at a height of {lowest:.2f} m"
            remedy = "calibrate again (docs/calibrate.md), or set calibrated=False"
            yield warning("floor", f"{got}: expected the floor at 0; {remedy}")
