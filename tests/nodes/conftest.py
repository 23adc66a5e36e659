"""What the tests of the nodes share: a clock that does not wait, streams made up on the spot, models of noise."""

import os
import shutil
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from tests.helpers.synthetic_poses import walker

from steadypose.msgs.recording import RecordingWriter
from steadypose.msgs.topics import POSE_RAW, POSE_WORLD
from steadypose.msgs.transport import Publisher
from steadypose.msgs.types import Message, Pose, PoseRaw, PoseWorld, RawBody
from steadypose.nodes.graph.clock import Clock
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.node import Node
from steadypose.nodes.sources.source import LiveSource

START_NS = 1_700_000_000_000_000_000


class VirtualClock(Clock):
    """Time that passes only when somebody sleeps."""

    def __init__(self) -> None:
        self.time_ns = 5_000_000_000
        self.set_ns = 0
        """by how much the wall clock was set meanwhile"""
        self.slept_ns: list[int] = []

    def now_ns(self) -> int:
        return self.time_ns + self.set_ns

    def monotonic_ns(self) -> int:
        return self.time_ns

    def sleep(self, duration_ns: int) -> None:
        self.slept_ns.append(duration_ns)
        self.time_ns += duration_ns


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock()


@pytest.fixture
def folder() -> Iterator[Path]:
    """A folder with a short path: an ipc address has 107 bytes at most."""
    path = Path(tempfile.mkdtemp(prefix="sp"))
    yield path
    shutil.rmtree(path)


@pytest.fixture
def make_launch(folder: Path, tmp_path: Path) -> Callable[..., Launch]:
    """A launch with its sockets in ``folder``; settings by their path, dots as ``__``."""

    def make(settings: dict[str, str] | None = None, **more: object) -> Launch:
        file = tmp_path / "test.toml"
        file.write_text("")
        overrides = [f"transport.directory={folder}"]
        overrides += [f"{key}={value}" for key, value in (settings or {}).items()]
        overrides += [f"{key.replace('__', '.')}={value}" for key, value in more.items()]
        return Launch.read(file, overrides)

    return make


def raw(index: int, *bodies: RawBody, stamp_ns: int | None = None, skeleton: str = "smpl22") -> PoseRaw:
    """Frame ``index`` of a 30 Hz stream."""
    return PoseRaw(
        stamp_ns=START_NS + index * 33_333_333 if stamp_ns is None else stamp_ns, frame_id="camera", source="test",
        skeleton=skeleton, sensor_pose=Pose.identity(), calibrated=True, bodies=list(bodies),
    )  # fmt: skip


def walking(index: int, body: int = 0) -> RawBody:
    """A walker at frame ``index``, as a sensor with a centimetre of noise sees him."""
    noise = np.random.default_rng((index, body)).normal(0.0, 0.01, (22, 3))
    positions, _, _ = walker(index / 30, phase=1.5 * body)
    return RawBody(id=body, positions=positions + noise, confidence=np.ones(22))


def walk(frames: int, bodies: int = 1) -> list[PoseRaw]:
    return [raw(i, *(walking(i, body) for body in range(bodies))) for i in range(frames)]


def walked(frames: int, bodies: int = 1) -> np.ndarray:
    """(T, 22, 3) metres, z up, or of several bodies (T, B, 22, 3): the joints of `walk`."""
    found = np.array([[body.positions for body in frame.bodies] for frame in walk(frames, bodies)])
    return found[:, 0] if bodies == 1 else found


def write_npz(path: Path, positions: np.ndarray, **more: object) -> Path:
    """Write an input of `clean`, at 30 Hz unless ``more`` has stamps or another rate."""
    arrays = {"positions": positions, "skeleton": "smpl22"} | ({} if "stamp_ns" in more else {"fps": 30.0}) | more
    np.savez(path, **arrays)  # type: ignore[arg-type]
    return path


def record(directory: Path, messages: Iterable[Message | tuple[str, Message]], topic: str = POSE_RAW) -> Path:
    """Record messages of one topic, or each with its own."""
    with RecordingWriter(directory) as writer:
        for item in messages:
            of, message = item if isinstance(item, tuple) else (topic, item)
            writer.write(of, message, message.stamp_ns)
    return directory


class Given(LiveSource):
    """Gives these frames, then none; the first once it `may`."""

    def __init__(self, *frames: PoseRaw | None) -> None:
        super().__init__()
        self._frames = frames
        self.may: Callable[[], bool] = lambda: True

    def frames(self) -> Generator[PoseRaw | None, None, None]:
        while not self.may():
            yield None
        yield from self._frames
        while True:
            yield None

    def status(self) -> dict[str, str]:
        return {}


@pytest.fixture
def ros(monkeypatch: pytest.MonkeyPatch) -> None:
    """ROS 2, if there are wheels of it for this machine, in a domain of this test's own."""
    for package in ("cyclonedds", "rclpy"):
        pytest.importorskip(package, reason="there are no wheels for this machine: only x86-64 has them")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))  # above 101 a domain's ports may be taken by others
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


@contextmanager
def running(*nodes: Node) -> Iterator[list[threading.Thread]]:
    """The nodes, each in a thread, stopped in the order given."""
    # one that hangs is a failure below, and not to keep the tests from ending
    threads = [threading.Thread(target=node.run, daemon=True) for node in nodes]
    for thread in threads:
        thread.start()
    try:
        yield threads
    finally:
        for node, thread in zip(nodes, threads, strict=True):
            node.stop()
            thread.join(20)
        assert not any(thread.is_alive() for thread in threads)


def listeners(node: Node) -> set[str]:
    """The names of who listens to a node that runs in another thread, which alone may read its sockets."""
    return {listener.name for listener in list(node._publisher._listeners)}


@contextmanager
def repeated(act: Callable[[], object], every_s: float = 0.02) -> Iterator[None]:
    """Do something again and again beside the block: publishers do not say when a subscriber has come."""
    over = threading.Event()

    def go_on() -> None:
        while not over.wait(every_s):
            act()

    thread = threading.Thread(target=go_on, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join(20)


def first_datagram(
    make_launch: Callable[..., Launch], kind: type[Node], worlds: Iterator[PoseWorld], **settings: str
) -> bytes:
    """What a node that sends datagrams of the trajectory's poses sends first."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(30)
        settings[f"{kind.name}__port"] = str(listener.getsockname()[1])
        launch = make_launch(nodes=f'["trajectory", "{kind.name}"]', transport__lossless="false", **settings)
        with (
            Publisher(launch.transport.endpoint("trajectory")) as publisher,
            running(kind(launch)),
            repeated(lambda: publisher.publish(POSE_WORLD, next(worlds))),
        ):
            return listener.recv(65536)


def until(condition: Callable[[], bool], *, timeout_s: float = 30.0) -> None:
    """Look again and again whether something that other threads bring about has come."""
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        if condition():
            return
        threading.Event().wait(0.001)
    raise AssertionError(f"did not come within {timeout_s:g} s")
