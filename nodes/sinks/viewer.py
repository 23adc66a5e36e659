"""The viewer: raw and clean poses side by side in a browser, through Rerun.

It only subscribes, so the pipeline does not know of it: start it, stop it, look or do not look, the poses are the
same. `PoseView` turns messages into drawings and knows neither sockets nor nodes; `ViewerServer` is the process that
keeps the last minutes of drawings and serves them with the page. Both need the optional extra ``view``.
"""

from __future__ import annotations

import ctypes
import signal
import socket
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.topics import POSE_CLEAN, POSE_RAW, POSE_TRUTH, POSE_WORLD
from steadypose.msgs.types import (
    CleanBody,
    Diagnostics,
    JointState,
    Message,
    PoseClean,
    PoseRaw,
    PoseWorld,
    RawBody,
    Tracking,
    WorldBody,
)
from steadypose.nodes.graph.runtime import TURN_S, Node
from steadypose.nodes.sinks.drawing import (
    ALARM_COLOUR,
    ALL_BONES,
    CONTACT_COLOUR,
    CONTACT_INDICES,
    RAW_COLOUR,
    STATE_COLOURS,
    TRUTH_COLOUR,
    bone_states,
    bones,
    facing,
    to_world,
)
from steadypose.prior.body.layouts import SKELETONS, to_canonical
from steadypose.prior.body.skeleton import J

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

HOST = "127.0.0.1"
TIMELINE = "elapsed"
FLUSH_S = 0.05
"""between batches of drawings: longer looks jerky, shorter costs more in wrapping than in drawings"""
MEMORY = "256MB"
"""of drawings that the server keeps for browsers that come later: about five minutes of one body"""
PATH_SECONDS = 10.0
"""how much of a body's way over the floor is drawn"""
CONTACT_PROBABILITY = 0.5
FOLLOW_SHARE = 0.1
"""of the way to the bodies that the eye goes with each message: slow enough not to shake with a raw pose"""
FOLLOW_STEP = 0.1
"""metres: the most it goes, so that a joint 10 km away does not take it along"""
BELOW_TRUNK = 0.25
"""metres from the middle of the trunk down to the middle of somebody who stands"""
BACK_JUMP_NS = 1_000_000_000
"""a stamp this far behind the last one starts the stream again"""


def _rgb(colour: str) -> list[int]:
    return [int(colour[i : i + 2], 16) for i in (1, 3, 5)]


_STATE_RGB = np.array([_rgb(STATE_COLOURS[state]) for state in JointState], np.uint8)
_RAW_RGB, _TRUTH_RGB, _CONTACT_RGB, _ALARM_RGB = map(_rgb, (RAW_COLOUR, TRUTH_COLOUR, CONTACT_COLOUR, ALARM_COLOUR))
_TRUNK = [J[name] for name in ("pelvis", "left_hip", "right_hip", "left_shoulder", "right_shoulder")]
_PATH_RGB = [235, 235, 235]
_RATE_RGB = {POSE_RAW: _RAW_RGB, POSE_CLEAN: _rgb(STATE_COLOURS[JointState.REFINED]), POSE_WORLD: _CONTACT_RGB}


class ViewerError(RuntimeError):
    """The viewer cannot start. The text says what to do."""


def require_rerun() -> None:
    """Raises:
    ViewerError: Rerun is not installed.
    """
    if find_spec("rerun") is None:
        raise ViewerError(
            "the viewer needs rerun-sdk, which is not installed: run `uv sync --inexact --extra view` in the checkout, "
            "or `pip install 'steadypose[view]'`; everything but the viewer works without it"
        )


class ViewerServer:
    """The Rerun process that keeps the drawings and serves them, with the page that shows them, to browsers.

    It listens on this machine alone: a picture of people in a room is not for whoever shares the network, and
    Rerun's own ``serve_grpc`` would listen on every address. To look from another machine, carry both ports over
    ssh: ``ssh -L 9090:localhost:9090 -L 9091:localhost:9091 robot``.
    """

    def __init__(self, port: int) -> None:
        """Start serving.

        Args:
            port: of the page; the drawings come on the next one.

        Raises:
            ViewerError: Rerun is missing, a port is taken, or the server does not come up.
        """
        require_rerun()
        import rerun_cli

        for wanted in (port, port + 1):
            _refuse_taken(wanted)
        self.data_url = f"rerun+http://{HOST}:{port + 1}/proxy"
        self.url = f"http://{HOST}:{port}/?url={quote(self.data_url, safe='')}"
        binary = Path(next(iter(rerun_cli.__path__)), "rerun")
        command = [str(binary), "--serve-web", "--bind", HOST, "--web-viewer-port", str(port), "--port", str(port + 1)]
        # The server must not outlive a node that is killed, or its ports stay taken.
        self._process = subprocess.Popen(
            [*command, "--server-memory-limit", MEMORY, "--newest-first"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            preexec_fn=_die_with_parent if sys.platform == "linux" else None,
        )
        try:
            for wanted in (port, port + 1):
                self._wait_for(wanted)
        except RuntimeError:
            self.close()
            raise

    def check(self) -> None:
        """Raises:
        RuntimeError: the server has stopped; to be started again, unlike what a `ViewerError` says.
        """
        if self._process.poll() is not None:
            raise RuntimeError(f"Rerun's server has stopped, exit code {self._process.returncode}")

    def close(self) -> None:
        self._process.terminate()
        try:
            self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def __enter__(self) -> ViewerServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _wait_for(self, port: int, timeout_s: float = 20.0) -> None:
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            self.check()
            with socket.socket() as probe:
                if probe.connect_ex((HOST, port)) == 0:
                    return
            time.sleep(0.05)
        raise ViewerError(f"Rerun's server did not open port {port} within {timeout_s:.0f} s")


class ViewerNode(Node):
    """Draws what the other nodes publish, newest first when it falls behind; the pipeline never waits for it."""

    name = "viewer"

    def run(self) -> None:
        with ViewerServer(self.launch.viewer.port) as self._server:
            recording = connect(self._server)
            self._view = PoseView(recording)
            print(f"viewer: {self._server.url}", flush=True)
            try:
                super().run()
            finally:
                recording.disconnect()

    @property
    def queue_limit(self) -> int | None:
        return self.launch.transport.queue

    def work(self) -> None:
        while not self.stopping:
            self.take_next(TURN_S)
            self.report_if_due()
            self._server.check()

    def handle(self, topic: str, message: Message) -> None:
        self._view.log(topic, message)

    def status(self) -> dict[str, str]:
        return {"address": self._server.url}


def connect(server: ViewerServer) -> rr.RecordingStream:
    """A stream of drawings to the server."""
    import rerun as rr

    recording = rr.RecordingStream("steadypose", batcher_config=rr.ChunkBatcherConfig(flush_tick=FLUSH_S))
    recording.connect_grpc(server.data_url)
    return recording


class PoseView:
    """Draws messages: three scenes (raw, clean, world), and as plots corrections, joint states, rates and, where the
    prior scores its windows, anomaly.

    Everything is drawn in the z-up world, raw and clean by way of the message's sensor pose, at the time of capture
    counted from the first message.
    """

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._recording = recording
        self._origin_ns: int | None = None
        self._last: dict[str, tuple[int, int]] = {}
        self._eye: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        self._calibrated = True
        self._scored = False
        self._focus: dict[str, NDArray[np.float64]] = {}
        self._drawn: dict[str, set[str]] = {}
        self._paths: dict[str, deque[tuple[int, NDArray[np.float64]]]] = {}
        self._name_series()
        self._recording.send_blueprint(self._blueprint())

    def log(self, topic: str, message: Message) -> None:
        """Draw one message.

        Raises:
            ValueError: the message cannot be drawn: an unknown skeleton, a wrong number of joints, a sensor pose
                that is no rotation.
        """
        if isinstance(message, Diagnostics):
            self._draw_rates(message)
            return
        if message.end_of_stream:
            return
        self._set_time(topic, message.stamp_ns)
        if isinstance(message, PoseRaw):
            drawn = dict(self._draw_raw(message))
        elif isinstance(message, PoseClean):
            drawn = dict(self._draw_clean(message))
        else:
            drawn = dict(self._draw_world(message, truth=topic == POSE_TRUTH))
        self._clear_gone(f"{topic}/{message.source}", set(drawn))
        if topic != POSE_TRUTH:
            self._follow(topic, list(drawn.values()), calibrated=getattr(message, "calibrated", True))

    def _draw_rates(self, message: Diagnostics) -> None:
        """The nodes' own counts, drawn at the time of the newest pose: the viewer may skip frames, they do not."""
        for topic in _RATE_RGB:
            if (rate := message.values.get(f"rate.{topic}")) is not None and self._origin_ns is not None:
                self._scalar(f"plots/rates/{topic}", float(rate))

    def _draw_raw(self, message: PoseRaw) -> Iterator[tuple[str, NDArray[np.float64]]]:
        import rerun as rr

        skeleton = SKELETONS.get(message.skeleton)
        if skeleton is None:
            raise ValueError(f"unknown skeleton {message.skeleton!r}: expected one of {', '.join(SKELETONS)}")
        pairs = bones(skeleton.observable)
        for body in message.bodies:
            if len(body.positions) != len(skeleton.joints):
                raise ValueError(f"{skeleton.name} has {len(skeleton.joints)} joints, got {len(body.positions)}")
            path = _entity("raw", message.source, body)
            positions = to_world(body.positions, message.sensor_pose)
            canonical, _ = to_canonical(skeleton, positions, body.confidence)
            seen = np.isfinite(positions).all(axis=1)
            self._log(f"{path}/joints", rr.Points3D(positions[seen], radii=0.016, colors=_grey(body.confidence[seen])))
            self._bones(f"{path}/bones", canonical, pairs, _RAW_RGB)
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
            self._recording.send_blueprint(self._blueprint())
        self._scalar(path, body.anomaly)
        if body.anomaly_flag:
            self._scalar("plots/anomaly/flagged", body.anomaly)

    def _draw_world(self, message: PoseWorld, *, truth: bool) -> Iterator[tuple[str, NDArray[np.float64]]]:
        import rerun as rr

        if truth and not self._calibrated:
            return  # the poses have a world of their own, and where that lies in the true one is not known
        for body in message.bodies:
            positions = body.positions.astype(np.float64)
            if truth:
                path = _entity("world/truth", message.source, body)
                self._bones(f"{path}/bones", positions, ALL_BONES, _TRUTH_RGB, radius=0.006)
                yield path, positions
                continue
            path = _entity("world", message.source, body)
            self._body(path, positions, body.state, body.sigma)
            self._log(f"{path}/path", rr.LineStrips3D([self._way(path, message, body)], colors=_PATH_RGB, radii=0.01))
            touching = body.contacts > CONTACT_PROBABILITY
            self._log(
                f"{path}/contacts",
                rr.Points3D(positions[CONTACT_INDICES[touching]], colors=_CONTACT_RGB, radii=0.035),
            )
            standing = "" if body.tracking == Tracking.OK else f" · {body.tracking.name.lower()}"
            above = positions[[J["head"]]] + [0, 0, 0.28]
            label = rr.Points3D(above, labels=f"{body.id}{standing}", colors=_PATH_RGB, radii=0.0)
            self._log(f"{path}/label", label)
            yield path, positions

    def _body(self, path: str, positions: NDArray, state: NDArray[np.uint8], sigma: NDArray[np.floating]) -> None:
        """A body in the colours of its joints' states; around each imputed joint a sphere of one sigma."""
        import rerun as rr

        self._bones(f"{path}/bones", positions, ALL_BONES, _STATE_RGB[bone_states(state)])
        shown = (state != JointState.UNKNOWN) & np.isfinite(positions).all(axis=1)
        self._log(f"{path}/joints", rr.Points3D(positions[shown], radii=0.018, colors=_STATE_RGB[state[shown]]))
        guessed = shown & (state == JointState.IMPUTED)
        spheres = rr.Ellipsoids3D(
            centers=positions[guessed],
            radii=sigma[guessed],
            colors=_STATE_RGB[state[guessed]],
            line_radii=0.0008,
            fill_mode="majorwireframe",
        )
        self._log(f"{path}/sigma", spheres)

    def _bones(
        self, path: str, positions: NDArray, pairs: NDArray[np.intp], colours: Any, radius: float = 0.011
    ) -> None:
        import rerun as rr

        ends = positions[pairs]
        drawable = np.isfinite(ends).all(axis=(1, 2))
        colours = colours[drawable] if isinstance(colours, np.ndarray) else colours
        self._log(path, rr.LineStrips3D(ends[drawable], colors=colours, radii=radius))

    def _way(self, path: str, message: PoseWorld, body: WorldBody) -> NDArray[np.float64]:
        """(N, 3) the body's way over the floor in the last seconds."""
        way = self._paths.setdefault(path, deque())
        way.append((message.stamp_ns, np.array([*body.root_position[:2], 0.005])))
        while message.stamp_ns - way[0][0] > PATH_SECONDS * 1e9 or way[0][0] > message.stamp_ns:
            way.popleft()
        return np.stack([point for _, point in way])

    def _clear_gone(self, key: str, drawn: set[str]) -> None:
        import rerun as rr

        for path in self._drawn.get(key, set()) - drawn:
            self._log(path, rr.Clear(recursive=True))
            self._paths.pop(path, None)
        self._drawn[key] = drawn

    def _set_time(self, topic: str, stamp_ns: int) -> None:
        """Draw from now on at that moment; where a topic's stamps jump back, its time goes on from where it was."""
        if self._origin_ns is None:
            self._origin_ns = stamp_ns
        last_ns, origin_ns = self._last.get(topic, (stamp_ns, self._origin_ns))
        if stamp_ns < last_ns - BACK_JUMP_NS:
            origin_ns -= last_ns - stamp_ns
        self._last[topic] = stamp_ns, origin_ns
        self._recording.set_time(TIMELINE, duration=np.timedelta64(stamp_ns - origin_ns, "ns"))

    def _log(self, path: str, what: Any) -> None:
        self._recording.log(path, what)

    def _scalar(self, path: str, value: float | NDArray[np.integer]) -> None:
        import rerun as rr

        self._recording.log(path, rr.Scalars(value))

    def _follow(self, topic: str, bodies: list[NDArray[np.float64]], *, calibrated: bool) -> None:
        """Keep the eye on the bodies: first from the front of one of them, later from where the user turns it."""
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
            self._eye = target, front if (front := facing(bodies[0])) is not None else np.array([1.0, 0.0, 0.0])
            self._calibrated = calibrated
            self._recording.send_blueprint(self._blueprint())

    def _name_series(self) -> None:
        """Give the plots' lines their names and colours once, for good."""
        import rerun as rr

        self._recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        states = rr.SeriesLines(
            names=[state.name.lower() for state in JointState], colors=_STATE_RGB, widths=[2.0] * len(JointState)
        )
        self._recording.log("plots/joints", states, static=True)
        for topic, colour in _RATE_RGB.items():
            self._recording.log(
                f"plots/rates/{topic}", rr.SeriesLines(names=topic, colors=colour, widths=2), static=True
            )
        flagged = rr.SeriesPoints(names="flagged", colors=_ALARM_RGB, markers="circle", marker_sizes=3)
        self._recording.log("plots/anomaly/flagged", flagged, static=True)

    def _blueprint(self) -> rrb.Blueprint:
        import rerun.blueprint as rrb

        last_half_minute = rrb.VisibleTimeRange(
            TIMELINE,
            start=rrb.TimeRangeBoundary.cursor_relative(seconds=-30.0),
            end=rrb.TimeRangeBoundary.cursor_relative(),
        )

        def scene(origin: str, name: str, *, distance: float, height: float, floor: bool) -> rrb.Spatial3DView:
            return rrb.Spatial3DView(
                origin="/",
                contents=f"/{origin}/**",
                name=name,
                background=[18, 20, 26],
                line_grid=rrb.LineGrid3D(visible=floor, spacing=0.5, color=[120, 130, 150, 90]),
                eye_controls=self._eye_controls(origin, distance, height),
            )

        def plot(origin: str, name: str, span: tuple[float, float] | None = None) -> rrb.TimeSeriesView:
            return rrb.TimeSeriesView(
                origin=f"/plots/{origin}",
                name=name,
                axis_y=None if span is None else rrb.ScalarAxis(range=span),
                plot_legend=rrb.Corner2D.LeftTop,
                time_ranges=last_half_minute,
            )

        floor = self._calibrated
        return rrb.Blueprint(
            rrb.Vertical(
                rrb.Horizontal(
                    scene("raw", "raw: what the sensor says", distance=2.5, height=0.5, floor=floor),
                    scene("clean", "clean: seen, refined, imputed", distance=2.5, height=0.5, floor=floor),
                    scene("world", "world: path and contacts", distance=3.2, height=1.3, floor=True),
                ),
                rrb.Horizontal(
                    *([plot("anomaly", "anomaly score")] if self._scored else []),
                    plot("correction", "mean correction of a joint, cm"),
                    plot("joints", "joints by state"),
                    plot("rates", "messages a second", (0.0, 40.0)),
                ),
                row_shares=[5, 2],
            ),
            rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
            rrb.BlueprintPanel(state="hidden"),
            rrb.SelectionPanel(state="hidden"),
        )

    def _eye_controls(self, origin: str, distance: float, height: float) -> rrb.EyeControls3D | None:
        import rerun.blueprint as rrb

        if self._eye is None:
            return None
        centre, front = self._eye
        aside = np.array([-front[1], front[0], 0.0])
        eye = centre + distance * (0.94 * front + 0.34 * aside) + [0, 0, height]
        return rrb.EyeControls3D(
            kind="orbital", position=eye, look_target=centre, eye_up=[0, 0, 1], tracking_entity=f"/{origin}/focus"
        )


def _entity(root: str, source: str, body: RawBody | CleanBody | WorldBody) -> str:
    import rerun as rr

    return f"{root}/{rr.escape_entity_path_part(source or 'source')}/{body.id}"


def _grey(confidence: NDArray[np.floating]) -> NDArray[np.uint8]:
    """(J, 3) the surer, the whiter."""
    shade = 70 + 185 * np.clip(np.nan_to_num(confidence), 0, 1)
    return np.repeat(shade.astype(np.uint8)[:, None], 3, axis=1)


def _refuse_taken(port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            raise ViewerError(
                f"port {port} is not to be had ({error.strerror}): another viewer may be running; "
                "close it, or set another [viewer] port (it needs that port and the next)"
            ) from error


def _die_with_parent() -> None:
    PR_SET_PDEATHSIG = 1
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
