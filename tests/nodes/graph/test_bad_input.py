"""Whatever comes in: counted by its cause, reported, and the next good frame is answered."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import raw, record, running, until, walking

from steadypose.msgs.topics import DIAGNOSTICS, POSE_RAW, POSE_WORLD
from steadypose.msgs.transport import Publisher, Subscriber
from steadypose.msgs.types import Diagnostics, Pose, PoseClean, PoseRaw, PoseWorld, RawBody
from steadypose.nodes.commands.clean import clean
from steadypose.nodes.driving import stream
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.prior_node import PriorNode, make_prior
from steadypose.nodes.graph.trajectory_node import TrajectoryNode, make_trajectory

BEFORE, SPOILT, AFTER = 6, 3, 8
SECOND_NS = 1_000_000_000


def body(positions: object, confidence: object = None) -> RawBody:
    array = np.asarray(positions, np.float32).reshape(-1, 3)
    return RawBody(id=0, positions=array, confidence=np.ones(len(array)) if confidence is None else confidence)  # type: ignore[arg-type]


def good(start: int, count: int) -> list[PoseRaw]:
    return [raw(i, walking(i)) for i in range(start, start + count)]


def spoil(change: Callable[[PoseRaw], PoseRaw]) -> list[PoseRaw]:
    """Good frames, some spoilt ones, good frames."""
    spoilt = [change(frame) for frame in good(BEFORE, SPOILT)]
    return [*good(0, BEFORE), *spoilt, *good(BEFORE + SPOILT, AFTER)]


def with_body(positions: object, confidence: object = None) -> Callable[[PoseRaw], PoseRaw]:
    return lambda frame: dataclasses.replace(frame, bodies=[body(positions, confidence)])


def shifted(seconds: float) -> list[PoseRaw]:
    """A stream whose clock is set by so many seconds, for good."""
    later = [dataclasses.replace(f, stamp_ns=f.stamp_ns + round(seconds * 1e9)) for f in good(BEFORE, AFTER)]
    return [*good(0, BEFORE), *later]


def one_off(seconds: float) -> list[PoseRaw]:
    """A stream with one frame whose stamp is off by so many seconds."""
    frames = good(0, BEFORE + AFTER)
    frames[BEFORE] = dataclasses.replace(frames[BEFORE], stamp_ns=frames[BEFORE].stamp_ns + round(seconds * 1e9))
    return frames


NAN, INF = np.full((22, 3), np.nan), np.full((22, 3), np.inf)
FAR = np.full((22, 3), 10_000.0)
EVIL = {
    "nan": spoil(with_body(NAN)),
    "infinite": spoil(with_body(INF)),
    "one joint infinite": spoil(with_body(np.vstack([INF[:1], walking(3).positions[1:]]))),
    "ten kilometres away": spoil(with_body(FAR)),
    "as large as numbers go": spoil(with_body(np.full((22, 3), 3e38))),
    "confidence nan": spoil(with_body(walking(3).positions, np.full(22, np.nan))),
    "confidence out of range": spoil(with_body(walking(3).positions, np.full(22, -1e30))),
    "no joints": spoil(with_body(np.zeros((0, 3)))),
    "too few joints": spoil(with_body(np.zeros((17, 3)))),
    "too many joints": spoil(with_body(np.zeros((1000, 3)))),
    "all joints in one point": spoil(with_body(np.zeros((22, 3)))),
    "no bodies": spoil(lambda frame: dataclasses.replace(frame, bodies=[])),
    "the same body twice": spoil(lambda frame: dataclasses.replace(frame, bodies=frame.bodies * 2)),
    "a hundred bodies": spoil(
        lambda frame: dataclasses.replace(
            frame, bodies=[dataclasses.replace(frame.bodies[0], id=i) for i in range(100)]
        )
    ),
    "unknown skeleton": spoil(lambda frame: dataclasses.replace(frame, skeleton="octopus8")),
    "sensor pose nan": spoil(
        lambda frame: dataclasses.replace(frame, sensor_pose=Pose(np.full(3, np.nan), np.full(4, np.nan)))
    ),
    "sensor pose zero": spoil(lambda frame: dataclasses.replace(frame, sensor_pose=Pose(np.zeros(3), np.zeros(4)))),
    "stamps repeat": [frame for frame in good(0, BEFORE + AFTER) for _ in range(2)],
    "stamps all the same": [*(raw(0, walking(i)) for i in range(BEFORE)), *good(BEFORE, AFTER)],
    "an hour back, for good": shifted(-3600.0),
    "an hour back, once": one_off(-3600.0),
    "an hour ahead, once": one_off(3600.0),
    "stopped for ten seconds": shifted(10.0),
    "out of order": [f for i in range(0, BEFORE + AFTER, 2) for f in (*good(i + 1, 1), *good(i, 1))],
    "end of the stream twice": [
        *good(0, BEFORE),
        *(dataclasses.replace(raw(BEFORE), end_of_stream=True) for _ in range(2)),
        *good(BEFORE + 1, AFTER),
    ],
}
COUNTED = {
    "ten kilometres away",
    "too few joints",
    "too many joints",
    "no joints",
    "a hundred bodies",
    "unknown skeleton",
    "sensor pose nan",
    "sensor pose zero",
    "stamps repeat",
    "stamps all the same",
    "an hour back, for good",
    "an hour back, once",
    "an hour ahead, once",
    "stopped for ten seconds",
    "out of order",
}
"""what is not only survived but must show in the counts"""


#: no header; a header cut short; of another version; of this version, with no message behind it, or with nonsense
GARBAGE = (b"", b"\2\2\3", b"?" * 999, b"\2" + bytes(16), b"\2" + bytes(4) + b"\1" + bytes(11) + b"\xff" * 40)


@pytest.mark.parametrize("kind", EVIL)
def test_clean_gets_over_it(kind: str) -> None:
    prior, trajectory = make_prior({}), make_trajectory({})
    answers = list(stream([(POSE_RAW, frame) for frame in EVIL[kind]], prior, trajectory))
    cleans = [m for _, m in answers if isinstance(m, PoseClean) and not m.end_of_stream]
    worlds = [m for _, m in answers if isinstance(m, PoseWorld) and not m.end_of_stream]
    last = EVIL[kind][-1].stamp_ns
    assert cleans[-1].bodies, "a good frame after the bad ones is answered"
    assert abs(cleans[-1].stamp_ns - last) < 60_000_000
    assert worlds[-1].bodies
    assert abs(worlds[-1].stamp_ns - last) < 60_000_000
    for message in cleans:
        for found in message.bodies:
            assert np.isfinite(found.positions).all()
            assert np.abs(found.positions).max() < 100, "nothing made up of what is not plausible"
    if kind in COUNTED:
        assert (prior.counters + trajectory.counters).total() > 0


@pytest.mark.slow
def test_no_node_goes_down(make_launch: Callable[..., Launch]) -> None:
    """All of it in a row over real sockets, with garbage in between."""
    launch = make_launch(nodes='["pose_input", "prior", "trajectory"]')
    prior, trajectory = PriorNode(launch), TrajectoryNode(launch)
    address = launch.transport.endpoint("pose_input")
    with (
        Publisher(address, reliable={"prior"}) as source,
        Subscriber(launch.transport.endpoint("trajectory"), [POSE_WORLD, DIAGNOSTICS], name="test") as listener,
        running(prior, trajectory) as threads,
    ):
        assert source.wait_for_subscribers({"prior"}, timeout_s=30)
        until(lambda: listener.receive(0.1) is not None)  # diagnostics: it is connected, and will miss no end
        ends = 0
        for frames in EVIL.values():
            for frame in frames:
                source.publish(POSE_RAW, frame)
            for garbage in GARBAGE:
                # under the topic's name, or it would not be let through; a publisher does not send such bytes itself
                source._socket.send(b"pose/raw\0" + garbage)
            source.publish(POSE_RAW, dataclasses.replace(frames[-1], bodies=[], end_of_stream=True))
            ends += 1 + sum(frame.end_of_stream for frame in frames)
        seen = Counter()
        causes: dict[str, str] = {}

        def all_ends_came() -> bool:
            received = listener.receive(0.1)
            if received and isinstance(received[1], PoseWorld):
                seen["end" if received[1].end_of_stream else "world"] += 1
            elif received and isinstance(received[1], Diagnostics):
                causes.update(received[1].values)
            return seen["end"] == ends

        until(all_ends_came, timeout_s=120)
        assert all(thread.is_alive() for thread in threads)
        assert seen["world"] > len(EVIL) * AFTER / 2
    refused = {key: n for key, n in prior.diagnostics().values.items() if key.startswith("refused.")}
    assert {f"refused.{cause}" for cause in ("malformed", "version", "undecodable", "unknown_skeleton")} <= set(refused)
    assert not [cause for cause in (prior.health.counts | trajectory.health.counts) if cause.endswith("Error")], (
        "no surprises"
    )


def test_clean_counts_and_goes_on(tmp_path: Path, capsys) -> None:
    frames = EVIL["unknown skeleton"]
    record(tmp_path / "in", frames)
    clean(tmp_path / "in", tmp_path / "out.npz")
    with np.load(tmp_path / "out.npz") as out:
        assert len(out["stamp_ns"]) == len(frames)
        assert np.isfinite(out["positions"][-1]).all()
    assert f"unknown_skeleton: {SPOILT}" in capsys.readouterr().err
