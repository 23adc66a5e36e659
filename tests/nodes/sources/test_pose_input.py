import os
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from conftest import START_NS, Given, VirtualClock, raw, record, running, walk, walking

from steadypose.msgs.delivery import Deliveries
from steadypose.msgs.recording import RecordingError
from steadypose.msgs.topics import DIAGNOSTICS, POSE_RAW, POSE_TRUTH
from steadypose.msgs.transport import Subscriber
from steadypose.msgs.types import Message, PoseRaw, PoseWorld
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.node import SUPERVISOR
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sources.npz import NpzError, NpzSource
from steadypose.nodes.sources.pose_input import PoseInputNode
from steadypose.nodes.sources.recording import RecordingSource, open_recording
from steadypose.nodes.sources.registry import InputSettings
from steadypose.prior.clean.admission import MAX_DISTANCE

MakeLaunch = Callable[..., Launch]
SECOND_NS = 1_000_000_000


class Frames:
    path = Path("frames")

    def __init__(self, stamps_ns: list[int]) -> None:
        self.refused: Counter[str] = Counter()
        self._stamps_ns = stamps_ns

    def __len__(self) -> int:
        return len(self._stamps_ns)

    def __iter__(self) -> Iterator[tuple[str, Message]]:
        return iter((POSE_RAW, raw(0, walking(0), stamp_ns=stamp)) for stamp in self._stamps_ns)


class Sent:
    """In a publisher's place: notes what is sent, when."""

    subscribers: frozenset[str] = frozenset()

    def __init__(self, clock: VirtualClock) -> None:
        self.refused: Counter[str] = Counter()
        self.deliveries = Deliveries((), {})
        self._clock = clock
        self.at: list[tuple[int, Message]] = []

    def publish(self, topic: str, message: Message, timeout_s: float) -> bool:
        if topic != DIAGNOSTICS:
            self.at.append((self._clock.time_ns, message))
        return True

    def check(self) -> None: ...


def play(launch: Launch, clock: VirtualClock, source: Frames, frames: int | None = None) -> list[tuple[int, PoseRaw]]:
    """Everything the node sends, or the first ``frames``, each with the time it was sent at."""
    node = PoseInputNode(launch, clock, source)
    sent = node._publisher = Sent(clock)  # type: ignore[assignment]
    if frames is not None:
        keep = sent.publish

        def publish(topic: str, message: Message, timeout_s: float) -> bool:
            if len(sent.at) >= frames:
                node.stop()
            return keep(topic, message, timeout_s)

        sent.publish = publish  # type: ignore[method-assign]
    node.work()
    return [(at, message) for at, message in sent.at if isinstance(message, PoseRaw)][:frames]


def waits(sent: list[tuple[int, PoseRaw]]) -> list[float]:
    return [(b - a) / 1e9 for (a, _), (b, _) in pairwise(sent)]


@pytest.fixture
def launch(make_launch: MakeLaunch) -> Launch:
    return make_launch(nodes='["pose_input"]')


def with_input(launch: Launch, **settings: object) -> Launch:
    return replace(launch, sections={"input": InputSettings(**settings)})  # type: ignore[arg-type]


@pytest.mark.parametrize("rate", [1.0, 2.0, 0.5])
def test_frames_come_at_the_rate_asked_for(launch: Launch, clock: VirtualClock, rate: float) -> None:
    steps = np.random.default_rng(0).integers(20, 60, 50) * 1_000_000
    stamps = [int(s) for s in START_NS + np.cumsum(steps)]
    launch = with_input(launch, rate=rate)
    sent = play(launch, clock, Frames(stamps))
    assert [m.stamp_ns for _, m in sent] == [*stamps, stamps[-1]], "stamps are as captured"
    np.testing.assert_allclose(waits(sent[:-1]), np.diff(stamps) / 1e9 / rate, atol=1e-6)


def test_rate_zero_waits_for_nothing_and_the_end_is_marked_once(launch: Launch, clock: VirtualClock) -> None:
    sent = play(with_input(launch, rate=0.0), clock, Frames([START_NS, START_NS + SECOND_NS]))
    assert not clock.slept_ns
    assert [m.end_of_stream for _, m in sent] == [False, False, True]
    assert sent[-1][1].bodies == []


@pytest.mark.parametrize(("seconds", "waited"), [
    pytest.param([0, 10], [10], id="a pause of ten seconds is a pause"),
    pytest.param([1, 1, 0], [0, 0], id="stamps that repeat or step back come at once"),
    pytest.param([0, 3600, 3601, 0, 1], [0, 1, 0, 1], id="a clock that was set is not waited for"),
    pytest.param([0, 1, 7, 7, 3, 4, 14, 5, 6], [1, 2, 0, 0, 1, 1, 0, 1], id="nor is one stamp that is ahead"),
])  # fmt: skip
def test_what_is_waited_for(launch: Launch, clock: VirtualClock, seconds: list[int], waited: list[int]) -> None:
    stamps = [START_NS + at * SECOND_NS for at in seconds]
    sent = play(launch, clock, Frames(stamps))
    assert [m.stamp_ns for _, m in sent[:-1]] == stamps, "stamps are as captured"
    assert waits(sent)[:-1] == pytest.approx(waited)


@pytest.mark.parametrize("lossless", ["true", "false"])
def test_a_camera_whose_process_is_killed_is_heard_again_at_once(lossless: str, make_launch, monkeypatch) -> None:
    monkeypatch.setenv(SUPERVISOR, str(os.getppid()))
    launch, frames = make_launch(nodes='["pose_input"]', transport__lossless=lossless), walk(20)
    with Subscriber(launch.transport.endpoint("pose_input"), POSE_RAW, name="test") as subscriber:
        for of_process in (frames[:10], frames[10:]):
            source = Given(*of_process)
            node = PoseInputNode(launch, source=source)
            source.may = lambda node=node: "test" in node._publisher.subscribers
            with running(node):  # if it is stopped, it leaves what it leaves if it is killed
                for frame in of_process:
                    received = subscriber.receive(10)
                    assert received
                    assert received[1].stamp_ns == frame.stamp_ns
            assert node.settle(), "messages that nobody waits for fill no memory"
    assert not subscriber.refused + subscriber.dropped


def test_a_loop_goes_on_with_rising_stamps(launch: Launch, clock: VirtualClock) -> None:
    launch = with_input(launch, loop=True)
    sent = play(launch, clock, Frames([START_NS, START_NS + SECOND_NS]), frames=7)
    seconds = [(m.stamp_ns - START_NS) / 1e9 for _, m in sent]
    assert seconds == [0, 1, 2, 3, 4, 5, 6]
    assert not any(m.end_of_stream for _, m in sent)
    assert waits(sent) == pytest.approx([1.0] * 6)


def test_a_recording_gives_raw_and_truth_and_not_what_was_made_of_them(tmp_path: Path) -> None:
    truth = PoseWorld(START_NS, "world", "test", np.array([0.0, 0.0, 1.0, 0.0]), [])
    frames = walk(3)
    stream = [(POSE_TRUTH, truth), *frames, replace(frames[-1], bodies=[], end_of_stream=True)]
    source = RecordingSource(record(tmp_path / "r", stream))
    assert list(source) == [(POSE_TRUTH, truth), *((POSE_RAW, frame) for frame in frames)]


def test_recordings_that_cannot_be_played_say_why(tmp_path: Path, make_launch: MakeLaunch) -> None:
    with pytest.raises(LaunchError, match="does not exist"):
        open_recording(tmp_path / "nowhere")
    with pytest.raises(LaunchError, match="give --input"):
        open_recording("")
    record(tmp_path / "others", [PoseWorld(START_NS, "world", "t", np.zeros(4), [])], POSE_TRUTH)
    with pytest.raises(RecordingError, match=r"expected messages on pose/raw, got pose/truth"):
        open_recording(tmp_path / "others")
    with pytest.raises(LaunchError, match="rate: expected 0"):
        PoseInputNode(make_launch(input__rate=-1), None, Frames([]))


GOOD = {"positions": np.zeros((5, 22, 3)), "skeleton": np.array("smpl22"), "fps": np.array(30.0)}


@pytest.mark.parametrize(("change", "expected"), [
    ({"positions": None}, "expected an array 'positions'"),
    ({"skeleton": None}, "expected an array 'skeleton'"),
    ({"skeleton": np.array("smpl23")}, "expected one of smpl22"),
    ({"skeleton": np.array(3)}, "expected one text"),
    ({"positions": np.zeros((5, 17, 3))}, r"\(T, 22, 3\), or \(T, bodies, 22, 3\), for smpl22, got \(5, 17, 3\)"),
    ({"positions": np.zeros((5, 22))}, "expected shape"),
    ({"positions": np.zeros((0, 22, 3))}, "at least one frame"),
    ({"positions": np.full((5, 22, 3), "x")}, "expected numbers"),
    ({"positions": np.full((5, 22, 3), None)}, "cannot be read"),
    ({"fps": None}, "expected stamp_ns"),
    ({"fps": np.array(0)}, "fps: expected one number above 0"),
    ({"fps": np.array([30, 30])}, "fps: expected one number"),
    ({"fps": np.array(1e-9)}, "5 frames at 1e-09 a second last longer than stamps can hold"),
    ({"stamp_ns": np.arange(4)}, "stamp_ns: expected 5 integers"),
    ({"stamp_ns": np.arange(5.0)}, "stamp_ns: expected 5 integers"),
    ({"stamp_ns": np.arange(5) - 1}, "-1 to 3"),
    ({"stamp_ns": np.arange(5) + 2**61}, "under 2147483648000000000, .* to 2305843009213693956"),
    ({"stamp_ns": np.full(5, 2**63 + 5, np.uint64)}, "stamp_ns: expected 5 integers"),
    ({"confidence": np.ones((5, 17))}, r"confidence: expected \(5, 22\)"),
    ({"up": np.array("x")}, "up: expected one of"),
])  # fmt: skip
def test_an_npz_that_is_not_poses_says_what_was_expected(tmp_path: Path, change: dict, expected: str) -> None:
    arrays = {name: array for name, array in (GOOD | change).items() if array is not None}
    np.savez(tmp_path / "x.npz", **arrays)
    with pytest.raises(NpzError, match=expected):
        NpzSource(tmp_path / "x.npz")


def test_an_npz_with_damaged_bytes_says_that_it_cannot_be_read(tmp_path: Path) -> None:
    """zipfile, zlib and numpy's parser of headers each complain in their own way."""
    path, rng, refused = tmp_path / "x.npz", np.random.default_rng(0), 0
    for save in (np.savez, np.savez_compressed):
        save(path, **GOOD)  # type: ignore[arg-type]
        whole = path.read_bytes()
        for _ in range(150):
            damaged = bytearray(whole)
            for place in rng.integers(len(whole), size=rng.integers(1, 9)):
                damaged[place] = rng.integers(256)
            path.write_bytes(damaged)
            try:
                list(NpzSource(path))
            except NpzError:
                refused += 1
    assert refused > 250


def test_an_npz_gives_a_message_a_row(tmp_path: Path) -> None:
    positions = np.random.default_rng(0).normal(size=(4, 17, 3))
    positions[2, 5] = np.nan
    stamps = START_NS + np.array([0, 30, 70, 100]) * 1_000_000
    np.savez(tmp_path / "x.npz", positions=positions, skeleton="coco17", stamp_ns=stamps, up="-y")
    messages = [m for _, m in NpzSource(tmp_path / "x.npz") if isinstance(m, PoseRaw)]
    assert [m.stamp_ns for m in messages] == stamps.tolist()
    np.testing.assert_array_equal([m.bodies[0].positions for m in messages], positions.astype(np.float32))
    assert messages[2].bodies[0].confidence[5] == 0.0
    assert messages[2].bodies[0].confidence.sum() == 16
    assert messages[0].skeleton == "coco17"
    assert not messages[0].calibrated
    np.testing.assert_allclose(messages[0].sensor_pose.orientation, [-np.sqrt(0.5), 0, 0, np.sqrt(0.5)])


@pytest.mark.parametrize(("start", "sensor"), [(-25.0, 0.0), (0.0, 25.0), (300.0, 325.0)])
def test_motion_capture_may_be_anywhere(start: float, sensor: float, tmp_path: Path) -> None:
    """Somebody goes 50 m, from anywhere, and stays where the file has it in the world."""
    path = tmp_path / "walk.npz"
    trans = np.linspace([start, 0.0, 0.9], [start + 50.0, 0.0, 0.9], 100)
    poses = np.tile([np.pi / 2, *[0.0] * 65], (100, 1))
    np.savez(path, poses=poses, trans=trans, mocap_framerate=30.0)
    raws = [message for _, message in open_recording(path) if isinstance(message, PoseRaw)]
    seen = np.array([raw.bodies[0].positions for raw in raws])
    places = np.array([raw.sensor_pose.position for raw in raws])
    assert np.abs(seen).max() < MAX_DISTANCE
    np.testing.assert_allclose(places, np.tile([sensor, 0.0, 0.0], (100, 1)), atol=0.5)
    np.testing.assert_allclose(seen[:, 0] + places, trans, atol=1e-4)
