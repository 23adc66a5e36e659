import itertools
import os
import select
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import until
from tests.helpers.synthetic_poses import messages, messages_on, walker

from steadypose.msgs.topics import DIAGNOSTICS, POSE_CLEAN, POSE_RAW, POSE_WORLD
from steadypose.msgs.transport import Publisher
from steadypose.msgs.types import Diagnostics, JointState, Level, Pose, PoseRaw, Tracking
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.topology import TransportSettings
from steadypose.nodes.sinks.viewer import scene
from steadypose.nodes.sinks.viewer import server as viewer_server
from steadypose.nodes.sinks.viewer.layout import FAINT_RGB, SIDE_RGB
from steadypose.nodes.sinks.viewer.node import ViewerNode
from steadypose.nodes.sinks.viewer.scene import PoseView
from steadypose.nodes.sinks.viewer.server import LOOPBACK, Drawings, PageServer, ViewerError, ViewerServer
from steadypose.nodes.sources.image import CameraImage

rr = pytest.importorskip("rerun", reason="the optional extra `view` is not installed")


class Log:
    """Stands in for a Rerun recording: keeps what is drawn, where and when."""

    def __init__(self) -> None:
        self.drawn: list[tuple[float, str, Any]] = []
        self.blueprints = 0
        self.disconnected = False
        self._now = 0.0

    def set_time(self, timeline: str, *, duration: np.timedelta64) -> None:
        self._now = float(duration / np.timedelta64(1, "s"))

    def log(self, path: str, what: Any, *, static: bool = False) -> None:
        if not static:
            self.drawn.append((self._now, path, what))

    def send_blueprint(self, blueprint: Any) -> None:
        self.blueprints += 1

    def disconnect(self) -> None:
        self.disconnected = True

    def last(self, path: str) -> Any:
        return next(what for _, found, what in reversed(self.drawn) if found == path)

    def times(self, path: str) -> list[float]:
        return [time for time, found, _ in self.drawn if found == path]


@pytest.fixture
def log() -> Log:
    return Log()


@pytest.fixture
def view(log: Log) -> PoseView:
    return PoseView(log)  # type: ignore[arg-type]


def points(archetype: Any) -> np.ndarray:
    return np.array(archetype.positions.as_arrow_array().to_pylist(), dtype=float).reshape(-1, 3)


def colours(archetype: Any) -> set[str]:
    return {f"#{int(colour) >> 8:06x}" for colour in archetype.colors.as_arrow_array().to_pylist()}


def draw(view: PoseView, seconds: float, *topics: str) -> None:
    for topic, message in messages(seconds):
        if topic in topics:
            view.log(topic, message)


def test_raw_and_clean_stand_upright_at_the_same_place(view: PoseView, log: Log) -> None:
    draw(view, 0.5, POSE_RAW, POSE_CLEAN)
    positions, _, _ = walker(10 / 30)
    raw = points(log.last("raw/made-up/0/joints"))
    clean = points(log.last("clean/made-up/0/joints"))
    assert clean == pytest.approx(positions, abs=0.02)
    assert raw[:, 2].max() == pytest.approx(positions[:, 2].max(), abs=0.15)
    assert np.linalg.norm(raw.mean(axis=0) - clean.mean(axis=0)) < 0.4


def test_bones_have_the_colours_of_their_sides_and_are_faint_where_not_observed(view: PoseView, log: Log) -> None:
    message = messages_on(POSE_CLEAN, 0.5)[0]
    for state, sides in ((JointState.REFINED, SIDE_RGB), (JointState.IMPUTED, FAINT_RGB)):
        message.bodies[0].state[:] = state
        view.log(POSE_CLEAN, message)
        assert colours(log.last("clean/made-up/0/bones")) == {"#{:02x}{:02x}{:02x}".format(*rgb) for rgb in sides}
    assert len(log.last("clean/made-up/0/sigma").half_sizes.as_arrow_array()) == 22


def test_missing_joints_are_not_drawn_and_a_body_that_left_is_cleared(view: PoseView, log: Log) -> None:
    both, leaving = messages_on(POSE_RAW, 0.3, bodies=2)[-2:]
    both.bodies[0].positions[3:] = np.nan
    view.log(POSE_RAW, both)
    assert len(points(log.last("raw/made-up/0/joints"))) == 3
    leaving.bodies.pop()
    view.log(POSE_RAW, leaving)
    assert isinstance(log.last("raw/made-up/1"), rr.Clear)


def test_tracking_and_path_are_told_in_the_world(view: PoseView, log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene, "PATH_SECONDS", 2.0)
    stream = messages_on(POSE_WORLD, 3.0)
    stream[-1].bodies[0].tracking = Tracking.COASTING
    for message in stream:
        view.log(POSE_WORLD, message)
    assert log.last("world/made-up/0/label").labels.as_arrow_array().to_pylist() == ["0 · coasting"]
    way = log.last("world/made-up/0/path").strips.as_arrow_array().to_pylist()[0]
    assert len(way) == pytest.approx(2.0 * 30, abs=2)


@pytest.mark.parametrize("calibrated", [True, False])
def test_truth_is_drawn_thin_where_the_cameras_place_is_known(view: PoseView, log: Log, calibrated: bool) -> None:
    for topic, message in messages(0.1):
        if isinstance(message, PoseRaw):
            message.calibrated = calibrated
        view.log(topic, message)
    paths = {path for _, path, _ in log.drawn if path.startswith("world/truth")}
    assert paths == ({"world/truth/made-up/0/bones"} if calibrated else set())
    assert log.times("raw/made-up/0/bones")


def test_rates_are_the_nodes_own(view: PoseView, log: Log) -> None:
    report = Diagnostics(0, "prior", Level.OK, "", {"rate.pose/clean": "29.97", "queue": "0"})
    view.log(DIAGNOSTICS, report)
    assert not log.drawn, "before the first pose there is no time to draw a rate at"
    draw(view, 0.5, POSE_CLEAN)
    view.log(DIAGNOSTICS, report)
    assert log.last("plots/rates/pose/clean").scalars.as_arrow_array().to_pylist() == [29.97]
    assert log.times("plots/rates/pose/clean") == [pytest.approx(0.3333, abs=0.04)]


def test_anomaly_is_drawn_once_there_is_a_score(view: PoseView, log: Log) -> None:
    unscored, *stream = messages_on(POSE_CLEAN, 1.0)
    unscored.bodies[0].anomaly = np.nan
    view.log(POSE_CLEAN, unscored)
    blueprints = log.blueprints
    assert not log.times("plots/anomaly/made-up/0")
    for message in stream:
        view.log(POSE_CLEAN, message)
    assert len(log.times("plots/anomaly/made-up/0")) == len(stream)
    assert log.blueprints == blueprints + 1


def test_time_goes_on_when_stamps_jump_back(view: PoseView, log: Log) -> None:
    for _ in range(2):
        draw(view, 3.0, POSE_CLEAN)
    times = log.times("clean/made-up/0/bones")
    assert np.all(np.diff(times) >= 0)
    assert times[-1] == pytest.approx(2 * 2.83, abs=0.1)


def test_the_eye_follows_a_walker_and_not_a_joint_far_away(view: PoseView, log: Log) -> None:
    stream = messages_on(POSE_RAW, 4.0)
    stream[60].bodies[0].positions[:] = 1e4
    for message in stream:
        view.log(POSE_RAW, message)
    positions, _, _ = walker(4.0)
    assert points(log.last("raw/focus"))[0][:2] == pytest.approx(positions[0, :2], abs=0.5)


@pytest.mark.parametrize(("spoil", "expected"), [
    (lambda m: setattr(m, "skeleton", "octopus8"), "unknown skeleton 'octopus8'"),
    (lambda m: setattr(m.bodies[0], "positions", np.zeros((3, 3), np.float32)), "has 32 joints, got 3"),
    (lambda m: setattr(m, "sensor_pose", Pose(np.zeros(3), np.zeros(4))), "norm"),
    (lambda m: setattr(m, "source", "") or m.bodies[0].positions.fill(np.nan), ""),
    (lambda m: m.bodies[0].positions.fill(np.inf) or m.bodies[0].confidence.fill(np.nan), ""),
])  # fmt: skip
def test_what_cannot_be_drawn_says_why(view: PoseView, spoil, expected: str) -> None:
    message = messages_on(POSE_RAW, 0.1)[0]
    spoil(message)
    with pytest.raises(ValueError, match=expected) if expected else nullcontext():
        view.log(POSE_RAW, message)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return probe.getsockname()[1]


@pytest.fixture(scope="module")
def server() -> Iterator[ViewerServer]:
    with ViewerServer(free_port()) as server:
        yield server


def test_the_server_listens_on_this_machine_alone_and_at_a_port_that_is_free() -> None:
    port = free_port()
    with ViewerServer(port):
        listening = [line.split()[1] for line in Path("/proc/net/tcp").read_text().splitlines() if " 0A " in line]
        assert [at.partition(":")[0] for at in listening if int(at.partition(":")[2], 16) == port] == ["0100007F"]
        with pytest.raises(ViewerError, match=f"port {port} at 127.0.0.1 cannot be opened"):
            ViewerServer(port)
    ViewerServer(port).close()


@pytest.mark.slow
def test_the_server_goes_with_a_node_that_is_killed() -> None:
    port = free_port()
    code = (
        "from steadypose.nodes.sinks.viewer.server import ViewerServer; "
        f"s = ViewerServer({port}); print(s._process.pid, flush=True); input()"
    )
    node = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert node.stdout is not None
    pid = int(node.stdout.readline())
    watch = os.pidfd_open(pid)
    node.send_signal(signal.SIGKILL)
    node.wait()
    assert select.select([watch], [], [], 10.0)[0], "the server outlived its node"


class Server(nullcontext[Any]):
    url, stopped = "http://somewhere", False

    def __init__(self, port: int, host: str) -> None:
        super().__init__(self)

    def check(self) -> None:
        if self.stopped:
            raise RuntimeError("stopped")


def test_the_node_draws_what_is_published_and_ends_with_its_server(tmp_path: Path, log: Log, monkeypatch) -> None:
    monkeypatch.setattr(viewer_server, "ViewerServer", Server)
    monkeypatch.setattr(Server, "connect", lambda self: log, raising=False)
    launch = Launch(transport=TransportSettings(directory=str(tmp_path)))
    node, stream = ViewerNode(launch), itertools.cycle(messages_on(POSE_CLEAN, 1.0))
    with Publisher(launch.transport.endpoint("prior")) as publisher, ThreadPoolExecutor(1) as thread:
        ends = thread.submit(node.run)

        def drawn() -> bool:
            publisher.publish(POSE_CLEAN, next(stream))
            return any(path.startswith("clean/") for _, path, _ in log.drawn)

        until(drawn)
        monkeypatch.setattr(Server, "stopped", True)
        with pytest.raises(RuntimeError, match="stopped"):  # with its server gone the node ends, to be started again
            ends.result(10.0)
    assert log.last("clean/made-up/0/bones") is not None
    assert log.disconnected


def test_the_page_may_call_nobody_but_this_server(server: ViewerServer) -> None:
    """By itself Rerun's page sends telemetry and asks for news; its policy has the browser refuse that."""
    with urllib.request.urlopen(server.url, timeout=20) as response:
        page = response.read().lower()
        assert b"<html" in page
        assert b"rerun" in page
        rules = dict(rule.strip().split(" ", 1) for rule in response.headers["Content-Security-Policy"].split(";"))
    assert rules["connect-src"].split() == ["'self'", "blob:", "data:"]
    assert not [word for rule in rules.values() for word in rule.split() if word in ("*", "http:", "https:")]


def test_a_name_that_was_made_to_lead_here_gets_nothing(server: ViewerServer) -> None:
    for url in (server.url, server.data_url):
        request = urllib.request.Request(url, headers={"Host": "evil.example"})
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(request, timeout=20)


def test_who_does_not_know_the_token_sees_no_drawings(server: ViewerServer) -> None:
    recording = server.connect()
    recording.log("a", rr.TextLog("somebody"))
    with urllib.request.urlopen(server.data_url, timeout=20) as response:
        assert response.read(3) == b"RRF"
    at, token, name = server.data_url.rsplit("/", 2)
    for guess in ("", f"/{name}", f"/{'x' * len(token)}/{name}", f"/{token[:-1]}/{name}", f"/{token}/./{name}"):
        with suppress(urllib.error.HTTPError), urllib.request.urlopen(at + guess, timeout=20) as response:
            assert not response.read().startswith(b"RRF"), guess
    recording.disconnect()


def test_a_browser_that_comes_late_gets_the_beginning_and_what_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer_server, "FIRST", 2)
    monkeypatch.setattr(viewer_server, "MOST_BYTES", 3)
    kept = Drawings()
    early = kept.follow()
    for number in range(3):
        kept.add(b"%d" % number)
    assert [next(early) for _ in range(3)] == [b"0", b"1", b"2"]
    for number in range(3, 9):
        kept.add(b"%d" % number)
    late = kept.follow()
    assert [next(late) for _ in range(5)] == [b"0", b"1", b"6", b"7", b"8"]
    assert [next(early) for _ in range(3)] == [b"6", b"7", b"8"], "who is too slow misses some"
    kept.add(b"9")
    assert (next(early), next(late)) == (b"9", b"9")
    kept.close()
    assert list(late) == []


def test_an_image_is_drawn_with_the_clean_poses_of_its_moment_and_not_before(view: PoseView, log: Log) -> None:
    cleaned = messages_on(POSE_CLEAN, 0.5)
    layouts = log.blueprints
    view.keep(CameraImage(cleaned[1].stamp_ns, (480, 360), np.eye(3), b"a jpeg"))
    view.log(POSE_CLEAN, cleaned[0])
    assert not log.times("camera/image")
    view.log(POSE_CLEAN, cleaned[1])
    assert len(log.times("camera/image")) == 2, "a lens, and an image"
    assert set(log.times("camera/image")) == {log.times("camera")[-1]}
    assert log.blueprints > layouts, "a panel of its own"
    view.log(POSE_CLEAN, cleaned[2])
    assert len(log.times("camera/image")) == 2


@pytest.mark.parametrize("path", ["http://[", ":x", "/\x01", "/\xe9"])
def test_a_request_that_is_none_is_answered_as_such(path: str, capfd: pytest.CaptureFixture[str]) -> None:
    port = free_port()
    page = PageServer(LOOPBACK, port, "http://127.0.0.1:1", "token", Drawings())
    try:
        with socket.create_connection((LOOPBACK, port), 20) as it:
            it.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode("latin-1"))
            assert it.recv(100).startswith(b"HTTP/1.0 400")
    finally:
        page.close()
    assert "Traceback" not in capfd.readouterr().err
