"""Checks of layouts, joint counts, confidences and ids; and hints for arrays of the wrong shape."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.types import JOINTS, Level, Pose, PoseRaw, RawBody
from steadypose.nodes.checks.problem import Problem, bodies, error, observed, some_bodies, tracks, warning
from steadypose.prior.body.layouts import SKELETONS, Skeleton, layout_names, to_canonical
from steadypose.prior.body.likeness import likenesses
from steadypose.prior.body.skeleton import finite_joints
from steadypose.prior.clean.admission import MAX_PLACE
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.settings import nearest

UNIT_TOLERANCE = 0.01
_LAYOUT_OF = {
    **dict.fromkeys(("mediapipe", "mediapipe33"), "blazepose33"),
    **dict.fromkeys(("human3.6m", "human36m"), "h36m17"),
    **dict.fromkeys(("azure", "k4a"), "azure_kinect32"),
    "body25": "openpose25",
    "body38": "zed38",
}
"""Names by which others know a layout, in small letters and without separators."""
ENOUGH = 5  # smallest number of messages to judge by
HANDOVERS = 3
"""Smallest number of handovers from one id to another in a window that make a problem: a tracker that loses a person
now and then has fewer."""
SAME_PLACE = 0.15  # largest distance between two bodies in one place, relative to their size


def check_layout(messages: Sequence[PoseRaw], settings: PriorSettings) -> Iterator[Problem]:
    """Problems with the layout, sensor pose, confidences and ids in a window of messages, for a prior of these
    settings."""
    if len(messages) < ENOUGH:
        return
    newest = messages[-1]
    counts = Counter(len(body.positions) for body in bodies(messages)).most_common(1)
    count = counts[0][0] if counts else 0
    if newest.skeleton not in SKELETONS:
        yield _unknown(messages, count)
        return
    yield from check_sensor_pose(newest.sensor_pose)
    skeleton = SKELETONS[newest.skeleton]
    if counts and count != len(skeleton.joints):
        yield _wrong_count(messages, skeleton, count)
        return
    few = some_bodies(messages)
    yield from _confidence(few, settings.gate.min_confidence)
    yield from _seen(few, skeleton)
    yield from _ids(messages, settings.max_bodies, settings.identify.enabled)


def _unknown(messages: Sequence[PoseRaw], count: int) -> Problem:
    name = messages[-1].skeleton
    like = _best(messages, count)
    hint = f"{_named_like(name)}; its {count} joints are most like {like!r}" if like else _named_like(name)
    expected = f"expected one of {layout_names()}; for a layout of your own, see docs/sources.md"
    return error("unknown_skeleton", f"skeleton {name!r}{hint}: {expected}")


def _wrong_count(messages: Sequence[PoseRaw], skeleton: Skeleton, count: int) -> Problem:
    same = [s.name for s in SKELETONS.values() if len(s.joints) == count]
    if like := _best(messages, count):
        hint = f"; these are most like {like!r}: use that name"
    elif same:
        hint = f"; {' and '.join(same)} have {count}"
    else:
        hint = "; a joint that was not detected is NaN, not left out"
    expected = f"expected bodies of {len(skeleton.joints)} joints"
    return error("wrong_joint_count", f"{skeleton.name}: {expected}, got {count}{hint}")


def _best(messages: Sequence[PoseRaw], count: int) -> str | None:
    """The layout under which bodies of ``count`` joints fit a body best."""
    if not count:
        return None
    joints = np.array([body.positions for body in bodies(messages) if len(body.positions) == count], np.float64)
    best = next(iter(likenesses(np.where(np.isfinite(joints), joints, np.nan))), None)
    return best.skeleton if best and best.is_body else None


def check_sensor_pose(pose: Pose) -> Iterator[Problem]:
    """The problem of a sensor pose that cannot be used."""
    norm = float(np.linalg.norm(pose.orientation))
    if not np.isfinite(pose.position).all() or not abs(norm - 1.0) < UNIT_TOLERANCE:
        place, turn = np.round(pose.position, 3).tolist(), np.round(pose.orientation, 3).tolist()
        got = f"sensor_pose is not a valid pose: position {place}, orientation {turn} of norm {norm:.3g}"
        expected = "expected finite numbers and a unit quaternion xyzw"
        remedy = "Pose.from_up('-y') for a level camera, 0 0 0 1 if z is up"
        yield error("sensor_pose", f"{got}; {expected}: {remedy}")
    elif not (farthest := float(np.abs(pose.position).max())) < MAX_PLACE:
        got = f"sensor_pose.position is {farthest:.0f} m from the world's origin along an axis"
        expected = f"expected less than {MAX_PLACE:.0f}, or rounding would move joints by millimetres"
        remedy = "subtract an origin near the people, or use a frame such as odom"
        yield error("sensor_pose", f"{got}: {expected}; {remedy}")


def _confidence(messages: Sequence[PoseRaw], needed: float) -> Iterator[Problem]:
    found = [body.confidence for body in bodies(messages) if len(body.confidence)]
    if not found:
        return
    values = np.concatenate(found)
    seen = np.concatenate([np.isfinite(body.positions).all(axis=1) for body in bodies(messages)])
    if not np.isfinite(values).any():
        yield error("confidence_nan", "confidence is NaN for every joint: expected 0 to 1; 1 if the source has none")
        return
    most, least = float(np.nanmax(values)), float(np.nanmin(values))
    if most > 1.0:
        top = 100 if most <= 100 else 255 if most <= 255 else None
        remedy = f"divide by {top}" if top and most > 1.5 else "scale or clip it"
        yield warning("confidence_range", f"confidence goes up to {most:g}: expected 0 to 1; {remedy}")
    elif least < 0.0:
        yield warning("confidence_range", f"confidence goes down to {least:g}: expected 0 to 1; below 0 counts as 0")
    elif seen.any() and not (np.nan_to_num(values[seen]) > 0).any():
        remedy = "give 1 if the source has none, and NaN positions for joints that it did not observe"
        yield warning("confidence_zero", f"confidence is 0 for every joint with a position: expected 0 to 1; {remedy}")
    elif seen.any() and most < needed:
        expected = f"expected 0 to 1, as a joint below {needed:g} counts as not observed"
        remedy = "scale it, or lower [prior.gate] min_confidence"
        yield warning("confidence_low", f"confidence is {most:.2g} at most: {expected}; {remedy}")


def _seen(messages: Sequence[PoseRaw], skeleton: Skeleton) -> Iterator[Problem]:
    from steadypose.prior.clean.slots import MIN_JOINTS  # imported late: loads 95 MB of numba

    joints, _ = to_canonical(skeleton, tracks(messages, len(skeleton.joints)))
    seen = finite_joints(joints).sum(axis=1)
    if len(seen) and 0 < (usual := int(np.median(seen))) < MIN_JOINTS:
        remedy = "get the whole body into the image, or lower the tracker's own threshold"
        got = f"only {usual} of a body's {len(JOINTS)} joints are observed"
        yield warning("few_joints", f"{got}: expected {MIN_JOINTS} or more; {remedy}")


def _ids(messages: Sequence[PoseRaw], max_bodies: int, identified: bool) -> Iterator[Problem]:
    most = max(len(raw.bodies) for raw in messages)
    if most > max_bodies:
        remedy = f"send fewer, or --set prior.max_bodies={most}"
        yield warning("too_many_bodies", f"{most} bodies in a message: expected at most {max_bodies}; {remedy}")
    twice = sum(len({body.id for body in raw.bodies}) < len(raw.bodies) for raw in messages)
    if identified:
        return
    if twice > len(messages) / 2:
        got = f"bodies of one message share an id in {twice} of {len(messages)} messages"
        remedy = "number them, or let steadypose assign ids: --set prior.identify.enabled=true"
        yield error("ids_repeated", f"{got}: expected one id per person; {remedy}")
        return
    appearances = Counter(body.id for body in bodies(messages))
    inhabited = sum(bool(raw.bodies) for raw in messages)
    always = inhabited >= 2 * ENOUGH and np.median(list(appearances.values())) <= 2 and len(appearances) > 2 * most
    if always or _handovers(messages) >= HANDOVERS:
        got = f"{len(appearances)} ids in {inhabited} messages of at most {most} bodies"
        remedy = "where the tracker does not, --set prior.identify.enabled=true"
        problem = error("ids_change", f"{got}: expected a person to keep the id; {remedy}")
        yield problem if always else replace(problem, level=Level.WARN)


def _handovers(messages: Sequence[PoseRaw]) -> int:
    """Number of messages in which a new id has the place of another in the message before, which is gone.

    People who walk in and out do not take each other's places from one message to the next.
    """
    found = 0
    for before, after in pairwise(messages):
        left, came = {body.id: body for body in before.bodies}, {body.id: body for body in after.bodies}
        found += any(
            _is_same_place(left[gone], came[new])
            for gone in left.keys() - came.keys()
            for new in came.keys() - left.keys()
        )
    return found


def _is_same_place(one: RawBody, other: RawBody) -> bool:
    a, b = observed(one), observed(other)
    if a.shape != b.shape:
        return False
    size = np.nanmax(np.nanmax(a, axis=0) - np.nanmin(a, axis=0))
    return bool(np.nanmedian(np.linalg.norm(a - b, axis=1)) < SAME_PLACE * size)


def count_hint(shape: Sequence[int]) -> str:
    """A hint for positions without a skeleton's name."""
    if len(shape) not in (3, 4) or shape[-1] != 3:
        return ""
    names = _with_joints(shape[-2])
    return f": {shape[-2]} joints, {' or '.join(names)}?" if names else ""


def skeleton_hint(name: str, shape: Sequence[int]) -> str:
    """A hint for an unknown skeleton name."""
    own = "; for joints of your own, give their layout (docs/library.md, docs/sources.md)"
    return _named_like(name) or count_hint(shape) or own


def _named_like(name: str) -> str:
    plain = name.lower().replace("_", "").replace("-", "").replace(" ", "")
    return nearest(_LAYOUT_OF.get(plain, plain), SKELETONS)


def axes_hint(shape: Sequence[int], skeleton: str) -> str:
    """A hint for positions whose shape does not fit the skeleton."""
    joints = len(SKELETONS[skeleton].joints)
    if len(shape) == 2 and shape == (joints, 3):
        return "; for a single frame: positions[None], or steadypose.Filter for frame by frame"
    if len(shape) == 2 and shape[-1] in (3 * joints, 2 * joints, 4 * joints):
        shaped = f"positions.reshape(len(positions), {joints}, {shape[-1] // joints})[..., :3]"
        return f"; a row of numbers a frame: {shaped}"
    if len(shape) == 3 and shape[1:] == (3, joints):
        return "; the last two axes are exchanged: positions.transpose(0, 2, 1)"
    if len(shape) == 3 and shape[0] == joints and shape[2] == 3:
        return "; the first two axes are exchanged: positions.transpose(1, 0, 2)"
    if len(shape) == 4 and shape[0] != joints and shape[1] == joints and shape[3] == 3:
        return "; bodies come after time: positions.transpose(0, 2, 1, 3)"
    if len(shape) in (3, 4) and shape[-2] == joints and shape[-1] == 4:
        return "; the fourth number seems to be a confidence: positions[..., :3], confidence=positions[..., 3]"
    if len(shape) in (3, 4) and shape[-1] == 2:
        return "; two coordinates are key points of an image: steadypose fit lifts them (docs/fit.md)"
    if len(shape) in (3, 4) and shape[-1] == 3 and (names := _with_joints(shape[-2])):
        return f"; {shape[-2]} joints: skeleton {' or '.join(map(repr, names))}?"
    return ""


def stamps_hint(stamps: NDArray[Any], frames: int) -> str:
    """A hint for stamps that are not integer nanoseconds, one per frame."""
    if stamps.ndim != 1 or stamps.dtype.kind not in "fiuM":
        return ""
    if len(stamps) != frames:
        return f"; one stamp a frame: {frames} frames, {len(stamps)} stamps"
    if stamps.dtype.kind == "M":
        return "; of dates: np.asarray(stamps, 'datetime64[ns]').astype(np.int64)"
    if stamps.dtype.kind == "f":
        step = float(np.median(np.diff(stamps))) if frames > 1 else 0.0
        for unit, factor in (("seconds", 10**9), ("milliseconds", 10**6), ("microseconds", 10**3)):
            if 3e6 <= step * factor <= 3e8:
                return f"; these seem to be {unit}: np.round(stamps * {factor:.0e}).astype(np.int64)"
        return "; whole numbers: np.round(stamps).astype(np.int64)"
    return ""


def _with_joints(count: int) -> list[str]:
    return [skeleton.name for skeleton in SKELETONS.values() if len(skeleton.joints) == count]
