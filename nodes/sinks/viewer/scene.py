"""Draws each message in the viewer: bodies in three scenes, and the lines of the plots."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.topics import POSE_TRUTH
from steadypose.msgs.types import (
    OBSERVED,
    CleanBody,
    Diagnostics,
    JointState,
    Message,
    PoseClean,
    PoseEvents,
    PoseRaw,
    PoseWorld,
    RawBody,
    Tracking,
    WorldBody,
)
from steadypose.nodes.sinks.drawing import ALL_BONES, CONTACT_INDICES, SIDES, bone_states, bones, facing, to_world
from steadypose.nodes.sinks.viewer import layout
from steadypose.prior.body.layouts import SKELETONS, layout_names, to_canonical
from steadypose.prior.body.skeleton import HIPS, SHOULDERS, J

if TYPE_CHECKING:
    import rerun as rr

    from steadypose.nodes.sources.image import CameraImage

PATH_SECONDS = 10.0  # length of the drawn path of a body over the floor, seconds
CONTACT_PROBABILITY = 0.5  # contact probability above which a contact is drawn
FOLLOW_SHARE = 0.1
"""Gain per message with which the viewpoint follows the bodies. It is low, so that raw poses do not shake the view."""
FOLLOW_STEP = 0.1  # largest step of the viewpoint per message along an axis, metres
BELOW_TRUNK = 0.25  # distance from the middle of the trunk down to the middle of a standing body, metres
BACK_JUMP_NS = 1_000_000_000  # backward step of stamps beyond which a stream counts as restarted, nanoseconds
MOST_IMAGES = 30  # largest number of images that wait for their poses; two seconds of images
_TRUNK = [J["pelvis"], *HIPS, *SHOULDERS]


class PoseView:
    """Draws messages in three scenes (raw, clean, world), and plots corrections, joint states, rates and anomaly
    scores.

    Everything is drawn in the z-up world, to which raw and clean are transformed by the message's sensor pose. Time is
    capture time since the first message. ``threshold`` is the anomaly score above which the prior raises its flag.
    """

    def __init__(self, recording: rr.RecordingStream, threshold: float = math.nan) -> None:
        self._log, self._threshold = recording.log, threshold
        self._recording = recording
        self._origin_ns: int | None = None
        self._last: dict[str, tuple[int, int]] = {}
        self._eye: layout.Eye | None = None
        self._calibrated = True
        self._scored = False
        self._images: deque[CameraImage] = deque(maxlen=MOST_IMAGES)
        self._has_images = False
        self._focus: dict[str, NDArray[np.float64]] = {}
        self._drawn: dict[str, set[str]] = {}
        self._paths: dict[str, deque[tuple[int, NDArray[np.float64]]]] = {}
        layout.name_series(recording)
        self._send_layout()

    def log(self, topic: str, message: Message) -> None:
        """Draw one message. Raises ValueError if its skeleton, number of joints or sensor pose is invalid."""
        if isinstance(message, Diagnostics):
            self._draw_rates(message)
            return
        if message.end_of_stream or isinstance(message, PoseEvents):
            return
        self._set_time(topic, message.stamp_ns)
        if isinstance(message, PoseRaw):
            drawn = dict(self._draw_raw(message))
        elif isinstance(message, PoseClean):
            drawn = dict(self._draw_clean(message))
            self._draw_image(message)
        else:
            drawn = dict(self._draw_world(message, truth=topic == POSE_TRUTH))
        self._clear_absent(f"{topic}/{message.source}", set(drawn))
        if topic != POSE_TRUTH:
            self._follow(topic, list(drawn.values()), calibrated=getattr(message, "calibrated", True))

    def keep(self, image: CameraImage) -> None:
        """Keep a camera image, which is drawn when the clean poses of its time arrive."""
        self._images.append(image)

    def _draw_image(self, message: PoseClean) -> None:
        """Draw the latest image not newer than the poses, at its camera's pose, so that the poses overlay it."""
        import rerun as rr

        newest: CameraImage | None = None
        while self._images and self._images[0].stamp_ns <= message.stamp_ns:
            newest = self._images.popleft()
        if newest is None:
            return
        if not self._has_images:
            self._has_images = True
            self._send_layout()
        pose, axes = message.sensor_pose, rr.ViewCoordinates.RDF
        self._log("camera", rr.Transform3D(translation=pose.position, quaternion=rr.Quaternion(xyzw=pose.orientation)))
        lens = rr.Pinhole(image_from_camera=newest.intrinsics, resolution=newest.size, camera_xyz=axes)
        self._log("camera/image", lens)
        self._log("camera/image", rr.EncodedImage(contents=newest.jpeg, media_type="image/jpeg"))

    def _draw_rates(self, message: Diagnostics) -> None:
        """Draw the rates that nodes report, at the time of the newest pose. The viewer's own counts may skip frames."""
        for topic in layout.RATE_RGB:
            if (rate := message.values.get(f"rate.{topic}")) is not None and self._origin_ns is not None:
                self._scalar(f"plots/rates/{topic}", float(rate))

    def _draw_raw(self, message: PoseRaw) -> Iterator[tuple[str, NDArray[np.float64]]]:
        import rerun as rr

        skeleton = SKELETONS.get(message.skeleton)
        if skeleton is None:
            raise ValueError(f"unknown skeleton {message.skeleton!r}: expected one of {layout_names()}")
        pairs = bones(skeleton.observable)
        for body in message.bodies:
            if len(body.positions) != len(skeleton.joints):
                raise ValueError(f"{skeleton.name} has {len(skeleton.joints)} joints, got {len(body.positions)}")
            path = _entity("raw", message.source, body)
            positions = to_world(body.positions, message.sensor_pose)
            canonical, _ = to_canonical(skeleton, positions, body.confidence)
            observed = np.isfinite(positions).all(axis=1)
            shade = 70 + 185 * np.clip(np.nan_to_num(body.confidence[observed]), 0, 1)  # higher confidence is whiter
            grey = np.repeat(shade.astype(np.uint8)[:, None], 3, axis=1)
            self._log(f"{path}/joints", rr.Points3D(positions[observed], radii=0.016, colors=grey))
            self._bones(f"{path}/bones", canonical, pairs, layout.SIDE_RGB[SIDES[pairs[:, 1]]])
            yield path, canonical

    def _draw_clean(self, message: PoseClean) -> Iterator[tuple[str, NDArray[np.float64]]]:
        for body in message.bodies:
            path = _entity("clean", message.source, body)
            positions = to_world(body.positions, message.sensor_pose)
            self._body(path, positions, body.state, body.sigma)
            correction = np.linalg.norm(body.positions - body.raw_positions, axis=1)
            if np.isfinite(correction).any():
                self._scalar(_entity("plots/correction", message.source, body), 100 * float(np.nanmean(correction)))
            if np.isfinite(body.anomaly):
                self._draw_anomaly(_entity("plots/anomaly", message.source, body), body)
            yield path, positions
        if message.bodies:
            states = np.concatenate([body.state for body in message.bodies])
            self._scalar("plots/joints", np.bincount(states, minlength=len(JointState)))

    def _draw_anomaly(self, path: str, body: CleanBody) -> None:
        if not self._scored:
            self._scored = True
            self._send_layout()
        self._scalar(path, body.anomaly)
        if math.isfinite(self._threshold):
            self._scalar("plots/anomaly/threshold", self._threshold)
        if body.anomaly_flag:
            self._scalar("plots/anomaly/flagged", body.anomaly)

    def _draw_world(self, message: PoseWorld, *, truth: bool) -> Iterator[tuple[str, NDArray[np.float64]]]:
        import rerun as rr

        if truth and not self._calibrated:
            return  # without calibration, the transform between the poses' world and the true world is unknown
        for body in message.bodies:
            positions = body.positions.astype(np.float64)
            if truth:
                path = _entity("world/truth", message.source, body)
                self._bones(f"{path}/bones", positions, ALL_BONES, layout.TRUTH_RGB, radius=0.006)
                yield path, positions
                continue
            path = _entity("world", message.source, body)
            self._body(path, positions, body.state, body.sigma)
            trail = self._floor_path(path, message, body)
            self._log(f"{path}/path", rr.LineStrips3D([trail], colors=layout.PATH_RGB, radii=0.01))
            touching = positions[CONTACT_INDICES[body.contacts > CONTACT_PROBABILITY]]
            self._log(f"{path}/contacts", rr.Points3D(touching, colors=layout.CONTACT_RGB, radii=0.035))
            root, velocity = [body.root_position], [body.root_velocity]
            self._log(
                f"{path}/velocity", rr.Arrows3D(origins=root, vectors=velocity, colors=layout.PATH_RGB, radii=0.012)
            )
            standing = "" if body.tracking == Tracking.OK else f" · {body.tracking.name.lower()}"
            above = positions[[J["head"]]] + [0, 0, 0.28]
            label = rr.Points3D(above, labels=f"{body.id}{standing}", colors=layout.PATH_RGB, radii=0.0)
            self._log(f"{path}/label", label)
            yield path, positions

    def _body(self, path: str, positions: NDArray, state: NDArray[np.uint8], sigma: NDArray[np.floating]) -> None:
        """Draw a body in its sides' colours, faint where not observed, with a sphere of one sigma at imputed joints."""
        import rerun as rr

        observed = np.isin(bone_states(state), OBSERVED)[:, None]
        sides = SIDES[ALL_BONES[:, 1]]
        self._bones(
            f"{path}/bones", positions, ALL_BONES, np.where(observed, layout.SIDE_RGB[sides], layout.FAINT_RGB[sides])
        )
        shown = (state != JointState.UNKNOWN) & np.isfinite(positions).all(axis=1)
        colours = np.where(np.isin(state, OBSERVED)[:, None], layout.SIDE_RGB[SIDES], layout.FAINT_RGB[SIDES])
        self._log(f"{path}/joints", rr.Points3D(positions[shown], radii=0.018, colors=colours[shown]))
        imputed = shown & (state == JointState.IMPUTED)
        spheres = rr.Ellipsoids3D(
            centers=positions[imputed], radii=sigma[imputed], colors=colours[imputed],
            line_radii=0.0008, fill_mode="majorwireframe",
        )  # fmt: skip
        self._log(f"{path}/sigma", spheres)

    def _bones(self, path: str, positions: NDArray, pairs: NDArray, colours: Any, radius: float = 0.011) -> None:
        import rerun as rr

        ends = positions[pairs]
        drawable = np.isfinite(ends).all(axis=(1, 2))
        colours = colours[drawable] if isinstance(colours, np.ndarray) else colours
        self._log(path, rr.LineStrips3D(ends[drawable], colors=colours, radii=radius))

    def _floor_path(self, path: str, message: PoseWorld, body: WorldBody) -> NDArray[np.float64]:
        """(N, 3) path of the body over the floor in the last seconds, metres."""
        trail = self._paths.setdefault(path, deque())
        trail.append((message.stamp_ns, np.array([*body.root_position[:2], 0.005])))
        while message.stamp_ns - trail[0][0] > PATH_SECONDS * 1e9 or trail[0][0] > message.stamp_ns:
            trail.popleft()
        return np.stack([point for _, point in trail])

    def _clear_absent(self, key: str, drawn: set[str]) -> None:
        import rerun as rr

        for path in self._drawn.get(key, set()) - drawn:
            self._log(path, rr.Clear(recursive=True))
            self._paths.pop(path, None)
        self._drawn[key] = drawn

    def _send_layout(self) -> None:
        self._recording.send_blueprint(
            layout.blueprint(self._eye, calibrated=self._calibrated, scored=self._scored, images=self._has_images)
        )

    def _set_time(self, topic: str, stamp_ns: int) -> None:
        """Set the time of what is drawn next. If a topic's stamps jump back, its time continues from where it was."""
        if self._origin_ns is None:
            self._origin_ns = stamp_ns
        last_ns, origin_ns = self._last.get(topic, (stamp_ns, self._origin_ns))
        if stamp_ns < last_ns - BACK_JUMP_NS:
            origin_ns -= last_ns - stamp_ns
        self._last[topic] = stamp_ns, origin_ns
        self._recording.set_time(layout.TIMELINE, duration=np.timedelta64(stamp_ns - origin_ns, "ns"))

    def _scalar(self, path: str, value: float | NDArray[np.integer]) -> None:
        import rerun as rr

        self._recording.log(path, rr.Scalars(value))

    def _follow(self, topic: str, bodies: list[NDArray[np.float64]], *, calibrated: bool) -> None:
        """Keep the bodies in view: at first from the front of one of them, later from the user's own viewpoint."""
        import rerun as rr

        trunks = np.array([body[_TRUNK] for body in bodies]).reshape(-1, 3)
        trunks = trunks[np.isfinite(trunks).all(axis=1)]
        if not len(trunks):
            return
        target = trunks.mean(axis=0) - [0.0, 0.0, BELOW_TRUNK]
        focus = self._focus.get(topic, target)
        self._focus[topic] = focus + np.clip(FOLLOW_SHARE * (target - focus), -FOLLOW_STEP, FOLLOW_STEP)
        self._log(f"{topic.removeprefix('pose/')}/focus", rr.Points3D([self._focus[topic]], radii=0.0))
        if self._eye is None:
            front = facing(bodies[0])
            self._eye = layout.Eye(target, np.array([1.0, 0.0, 0.0]) if front is None else front)
            self._calibrated = calibrated
            self._send_layout()


def _entity(root: str, source: str, body: RawBody | CleanBody | WorldBody) -> str:
    import rerun as rr

    return f"{root}/{rr.escape_entity_path_part(source or 'source')}/{body.id}"
