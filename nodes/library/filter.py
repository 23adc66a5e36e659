"""Frame by frame: the nodes `prior` and `trajectory` as one object, for programs with joints of their own."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import timedelta
from numbers import Integral, Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from steadypose.msgs.codec import MAX_BODIES
from steadypose.msgs.topics import POSE_CLEAN, POSE_WORLD
from steadypose.msgs.types import JOINTS, Message, Pose, PoseClean, PoseRaw, RawBody
from steadypose.nodes.checks.layout import axes_hint, check_sensor_pose, skeleton_hint
from steadypose.nodes.driving import CHECKED, Diagnosis
from steadypose.nodes.graph.loops import compile_missing
from steadypose.nodes.graph.prior_node import make_prior
from steadypose.nodes.graph.threads import one_thread
from steadypose.nodes.graph.trajectory_node import make_trajectory
from steadypose.nodes.library.arrays import SkeletonLike, as_array, logger, sections, skeleton_name, suggesting, warn
from steadypose.nodes.library.poses import Poses
from steadypose.nodes.sinks.arrays import NpzCollector
from steadypose.nodes.sources.npz import STAMPS_END_NS
from steadypose.nodes.timeline import FrameEvents, TimedEvent
from steadypose.prior.body.layouts import SKELETONS, layout_names
from steadypose.prior.clean.pipeline import load_loops
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.events.detector import EventSettings
from steadypose.prior.settings import build_settings


class FilterError(ValueError):
    """An invalid frame or argument. The text says what was expected, what came, and what to do."""


class Filter:
    """Cleans joints live: ``pose = cleaner(joints, t)``. The result is the same as that of the nodes.

    Use one filter per camera, from one thread. It handles all bodies in view. The same input always gives the same
    output. Poses are at 30 Hz, ``delay`` frames behind the input. The stream restarts if stamps go back, or pause for
    longer than the prior's timeout.

    Args:
        skeleton: name of the joint layout, or a layout of your own, as for `clean`.
        up: the axis of the joints' frame that points up: ``z``, ``y``, or ``-y`` (a level camera: y down).
        delay: frames at 30 Hz that the output lags behind, 0 to 16; more is more accurate.
        sensor_pose: pose of the sensor in the world, instead of ``up``. The floor is then at z = 0.
        settings: sections ``prior``, ``trajectory`` and ``events`` of a launch file.
        events: whether to detect what people do. It takes about 5 % more time.

    Attributes:
        problems: probable faults of the input so far, as text. Each is warned of once, as `InputWarning`.
        events: with ``events=True``, what begins, holds or ends in the frames that the last call completed, oldest
            first. It includes that of frames without a pose: the last person may have left.

    Raises:
        ValueError: an unknown skeleton, axis or setting, or a sensor pose that cannot be used.
    """

    @suggesting
    def __init__(
        self,
        skeleton: SkeletonLike = "smpl22",
        up: str = "z",
        delay: int = 4,
        *,
        sensor_pose: Pose | None = None,
        settings: Mapping[str, Mapping[str, Any]] | None = None,
        events: bool = False,
    ) -> None:
        self._skeleton = skeleton_name(skeleton)
        if self._skeleton not in SKELETONS:
            hint = skeleton_hint(self._skeleton, ())
            raise FilterError(f"skeleton: expected one of {layout_names()}, got {skeleton!r}{hint}")
        _check_pose(sensor_pose)
        self._pose, self._calibrated = sensor_pose or Pose.from_up(up), sensor_pose is not None
        given = sections(settings, delay)
        event_settings = build_settings(EventSettings, given["events"], "events")
        self._frame_events = FrameEvents(event_settings) if events else None
        self.events: tuple[TimedEvent, ...] = ()
        compile_missing(logger.warning)
        prior = given["prior"]
        self._prior, self._trajectory = make_prior(prior), make_trajectory(given["trajectory"])
        one_thread()
        load_loops(PriorSettings.from_dict(prior))  # now, so that the first frame does not wait for it
        self._diagnosis = Diagnosis(PriorSettings.from_dict(prior))
        self._next_look = CHECKED
        self._last: PoseRaw | None = None
        self._several = False
        self._recognised = False

    @suggesting
    def __call__(
        self,
        joints: ArrayLike,
        t: float | None = None,
        *,
        stamp_ns: int | None = None,
        confidence: ArrayLike | None = None,
        ids: Sequence[int] | None = None,
        sensor_pose: Pose | None = None,
    ) -> Poses | None:
        """Take a frame, and return the newest pose that it completes.

        Args:
            joints: (J, 3) metres of one body, NaN where a joint is missing; or (B, J, 3) of the B bodies in this frame,
                where B may be 0.
            t: time of capture in seconds, on any clock that only goes forward.
            stamp_ns: time of capture in whole nanoseconds, instead of ``t``.
            confidence: (J,) or (B, J) 0 to 1, or True where a joint was seen, if the source has it.
            ids: list of the ids of the B bodies, one per person, integers of 32 bits. Default: 0, 1, ….
            sensor_pose: pose of the sensor in this frame, if the camera moves; then in every frame until `flush`.

        Returns:
            The pose of one body, or poses with an axis of bodies if ``joints`` has one. None for the first ``delay``
            frames, while nobody is visible, and in some calls if the camera is faster than 30 Hz.

        Raises:
            FilterError: an array or the ids have the wrong form, or there is not one time of capture, or no sensor
                pose although the frame before had one, or one that cannot be used; the frame is not used.
        """
        found = self.update(joints, t, stamp_ns=stamp_ns, confidence=confidence, ids=ids, sensor_pose=sensor_pose)
        return found[-1] if found else None

    @suggesting
    def update(
        self,
        joints: ArrayLike,
        t: float | None = None,
        *,
        stamp_ns: int | None = None,
        confidence: ArrayLike | None = None,
        ids: Sequence[int] | None = None,
        sensor_pose: Pose | None = None,
    ) -> list[Poses]:
        """Take a frame, and return all poses that it completes, oldest first: several if the camera is below 30 Hz."""
        _check_pose(sensor_pose)
        stamp = _stamp(t, stamp_ns)
        bodies, self._several = self._bodies(joints, confidence, ids)
        if sensor_pose is None and self._last is not None and self._last.sensor_pose is not self._pose:
            expected = "expected one with every frame, as with the last, got none"
            raise FilterError(f"sensor_pose: {expected}; if the camera stands still, give it to Filter alone")
        pose, calibrated = sensor_pose or self._pose, self._calibrated or sensor_pose is not None
        raw = PoseRaw(stamp, "sensor", "program", self._skeleton, pose, calibrated, bodies)
        self._diagnosis.see(raw)
        self._last = raw
        poses = self._poses(self._prior.process(raw))
        if self._diagnosis.frames == self._next_look:
            self._next_look *= 2  # a check takes as long as several frames, so checks become rarer
            warn(self._diagnosis.look())
        return poses

    def flush(self) -> list[Poses]:
        """End the stream, and return its last ``delay`` poses, oldest first. The next frame begins a new stream."""
        if self._last is None:
            self.events = ()
            return []
        end = replace(self._last, bodies=[], end_of_stream=True)
        poses, self._last = self._poses(self._prior.process(end)), None
        warn(self._diagnosis.end() + self._diagnosis.check_output(0, self._recognised))
        return poses

    @property
    def problems(self) -> tuple[str, ...]:
        return tuple(self._diagnosis.texts)

    @property
    def refused(self) -> dict[str, int]:
        """Counts of unused frames, bodies and joints so far, by cause."""
        return {cause: n for cause, n in (self._prior.counters + self._trajectory.counters).items() if n}

    def _poses(self, cleaned: list[PoseClean]) -> list[Poses]:
        poses, of_call = [], []
        for clean in cleaned:
            worlds = self._trajectory.process(clean)
            events: list[TimedEvent] | None = None
            if (detector := self._frame_events) is not None:
                place, known = clean.sensor_pose.position, clean.calibrated
                events = [event for world in worlds for event in detector.update(world, place, calibrated=known)]
                of_call += events
            if clean.bodies:
                self._recognised = True
                outputs: list[tuple[str, Message]] = [(POSE_CLEAN, clean), *((POSE_WORLD, world) for world in worlds)]
                poses.append(Poses(self._arrays(NpzCollector(outputs).newest), self.problems, events=events))
        self.events = tuple(of_call)
        return poses

    def _arrays(self, rows: dict[int, NDArray[np.void]]) -> dict[str, NDArray[Any]]:
        """The arrays of `NpzCollector` for a single frame; without an axis of bodies, of the first."""
        table = np.stack(list(rows.values()))
        shown = table if self._several else table[0]
        arrays = {name: np.asarray(shown[name]) for name in table.dtype.names or ()}
        arrays |= {"stamp_ns": np.asarray(table["stamp_ns"][0]), "joint_names": np.array(JOINTS)}
        return arrays | ({"body_id": np.array(list(rows), np.int32)} if self._several else {})

    def _bodies(
        self, joints: ArrayLike, confidence: ArrayLike | None, ids: Sequence[int] | None
    ) -> tuple[list[RawBody], bool]:
        """The bodies of a frame, and whether there is an axis of them."""
        layout = SKELETONS[self._skeleton]
        positions = as_array("joints", joints)
        wanted = (len(layout.joints), 3)
        several = positions.ndim == 3
        if positions.size == 0 and positions.ndim in (1, 3):  # nobody; [] does not show whether B is an axis
            return [], several or self._several
        if positions.dtype.kind not in "fiu" or positions.shape[-2:] != wanted or positions.ndim not in (2, 3):
            hint = axes_hint((1, *positions.shape[-2:]), self._skeleton) if positions.ndim > 1 else ""
            expected = f"({wanted[0]}, 3) metres, or (bodies, {wanted[0]}, 3), for {self._skeleton}"
            got = f"{positions.dtype} of shape {positions.shape}{hint}"
            raise FilterError(f"joints: expected {expected}, got {got}")
        positions = positions.reshape(-1, *wanted)
        if len(positions) > MAX_BODIES:
            got = f"got {len(positions)}; frames go one by one, and a whole recording into steadypose.clean"
            raise FilterError(f"joints: expected {MAX_BODIES} bodies of one moment at most, {got}")
        sure = np.isfinite(positions).all(axis=-1) if confidence is None else as_array("confidence", confidence)
        if sure.dtype.kind not in "fiub" or sure.size != positions.shape[0] * wanted[0]:
            got = f"{sure.dtype} of shape {sure.shape}"
            raise FilterError(f"confidence: expected {positions.shape[:-1]} numbers of 0 to 1, got {got}")
        sure = np.asarray(sure, np.float32).reshape(positions.shape[:-1])
        numbers = list(range(len(positions)) if ids is None else ids if isinstance(ids, Iterable) else ())
        fit = all(isinstance(id, Integral) and -(2**31) <= id < 2**31 for id in numbers)
        if not fit or not len(set(numbers)) == len(numbers) == len(positions):
            expected = f"a list of {len(positions)} different integers of 32 bits, one a body"
            raise FilterError(f"ids: expected {expected}, got {ids!r}")
        bodies = [RawBody(int(id), *parts) for id, *parts in zip(numbers, positions, sure, strict=True)]
        return [body for body in bodies if not (several and np.isnan(body.positions).all())], several


def _check_pose(pose: object) -> None:
    if not isinstance(pose, Pose | None):
        raise FilterError(f"sensor_pose: expected steadypose.Pose(position, orientation), got {pose!r}")
    for problem in check_sensor_pose(pose) if pose else ():
        raise FilterError(problem.text)


def _stamp(t: float | None, stamp_ns: int | None) -> int:
    if (t is None) == (stamp_ns is None):
        got = f"{'neither' if t is None else 'both'}: cleaner(joints, time.time())"
        raise FilterError(f"expected the time of capture, as t in seconds or as stamp_ns, got {got}")
    if stamp_ns is not None:
        number = isinstance(stamp_ns, Real) and not isinstance(stamp_ns, np.timedelta64)
        if not number or not 0 <= stamp_ns < STAMPS_END_NS or stamp_ns != round(stamp_ns):
            expected = f"whole nanoseconds of 0 or more and under {STAMPS_END_NS}"
            raise FilterError(f"stamp_ns: expected {expected}, got {stamp_ns!r}; seconds are t")
        return int(stamp_ns)
    if isinstance(t, timedelta | np.timedelta64):
        raise FilterError(f"t: expected a number of seconds, got {t!r}; t / np.timedelta64(1, 's')")
    if not isinstance(t, Real) or isinstance(t, bool) or not math.isfinite(t) or t < 0:
        raise FilterError(f"t: expected a number of seconds, 0 or more, got {t!r}")
    if t >= 2**31:
        raise FilterError(f"t: expected seconds, got {t!r}; say stamp_ns= of nanoseconds, divide milliseconds by 1000")
    return round(t * 1e9)
