from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import record, running, until, walk

from steadypose.msgs.codec import encode
from steadypose.msgs.recording import RecordingReader
from steadypose.msgs.topics import DIAGNOSTICS, POSE_CLEAN, POSE_RAW, POSE_WORLD
from steadypose.msgs.types import Diagnostics
from steadypose.nodes.commands.clean import clean
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.prior_node import PriorNode
from steadypose.nodes.graph.trajectory_node import TrajectoryNode
from steadypose.nodes.sinks.recorder import RecorderNode
from steadypose.nodes.sources.pose_input import PoseInputNode

FRAMES = 30
NODES = '["pose_input", "prior", "trajectory", "recorder"]'


@pytest.fixture
def stream(tmp_path: Path) -> Path:
    return record(tmp_path / "in", walk(FRAMES, bodies=2))


def replay(launch: Launch) -> None:
    """Play the launch's recording through all nodes, and return when the recorder has the end of every topic."""
    source, recorder = PoseInputNode(launch), RecorderNode(launch)
    # started with the stream's end first, stopped with its start first
    with running(source, PriorNode(launch), TrajectoryNode(launch), recorder) as threads:
        until(lambda: {POSE_RAW, POSE_CLEAN, POSE_WORLD} <= recorder.health.ended, timeout_s=120)
        threads[0].join(10)
        assert not threads[0].is_alive(), "the input node ends with its source"


def payloads(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Of every topic, the bytes of each message and the stamp it is filed under."""
    found = defaultdict(list)
    with RecordingReader(path) as reader:
        for topic, stamp_ns, message in reader:
            if topic != DIAGNOSTICS:
                found[topic].append((stamp_ns, encode(message)))
    return dict(found)


def test_the_nodes_and_clean_give_the_same_bytes_every_time(tmp_path: Path, stream: Path, make_launch) -> None:
    """The second time the nodes play what they recorded the first time, which is as good as its source."""
    settings = {"nodes": NODES, "input.rate": "0"}
    for source, name in ((stream, "first"), (tmp_path / "first", "second")):
        replay(make_launch({**settings, "input.recording": str(source)}, recorder__directory=tmp_path / name))
    first = payloads(tmp_path / "first")
    assert len(first[POSE_RAW]) == FRAMES + 1
    assert len(first[POSE_CLEAN]) == len(first[POSE_WORLD]) >= FRAMES
    assert payloads(tmp_path / "second") == first
    clean(stream, tmp_path / "offline")
    assert payloads(tmp_path / "offline") == first


def test_every_node_says_how_it_did(tmp_path: Path, stream: Path, make_launch: Callable[..., Launch]) -> None:
    settings = {"nodes": NODES, "input.recording": str(stream), "input.rate": "20"}
    replay(make_launch(settings, recorder__directory=tmp_path / "out"))
    last: dict[str, Diagnostics] = {}
    with RecordingReader(tmp_path / "out") as reader:
        for _, _, message in reader.messages([DIAGNOSTICS]):
            assert isinstance(message, Diagnostics)
            last[message.node] = message
    assert set(last) == {"pose_input", "prior", "trajectory"}
    for node, topic in (("pose_input", POSE_RAW), ("prior", POSE_CLEAN), ("trajectory", POSE_WORLD)):
        values = last[node].values
        assert int(values[f"count.{topic}"]) >= FRAMES
        assert float(values["latency_ms.p50"]) <= float(values["latency_ms.p99"])
        assert not [key for key in values if key.startswith(("dropped.", "refused."))]
    assert last["prior"].values["delay_frames"] == "4"
    assert 0.0 < float(last["prior"].values["sensor.jitter_mm"]) < 100.0
    assert 0.0 <= float(last["prior"].values["sensor.slow_error_mm"]) < 100.0
    assert float(last["prior"].values["compute_ms.p50"]) > 0
