"""Injects faults into running nodes, one after the other: kills, stops, hangs, a full disk, malformed clients, a
sensor's clock that is set.

Half of the time nodes replay a recording that must lose nothing; each replay is recorded and compared with one without
faults. Half of the time they process a live stream, whose every frame must be counted as processed or as dropped, with
a cause.
"""

from __future__ import annotations

import dataclasses
import json
import os
import random
import shutil
import signal
import socket
import struct
import subprocess
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.provenance import WORLD
from steadypose.benchmarks.results import Result, Table
from steadypose.benchmarks.systems.latency import crowd, recorded
from steadypose.benchmarks.systems.running import Running, running_nodes
from steadypose.msgs.recording import RecordingReader, RecordingWriter
from steadypose.msgs.topics import POSE_CLEAN, POSE_RAW, POSE_WORLD
from steadypose.msgs.types import Diagnostics, PoseRaw
from steadypose.nodes.graph.clock import FRAME_NS
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.run_state import LOSSES, Ledger
from steadypose.nodes.graph.topology import NODES, POSE_NODES, Delivery
from steadypose.prior.timing.rate import FPS

DEPENDS_ON = WORLD

MINUTES = 60.0  # duration of both halves together, minutes; the last replay is completed
FRAMES = 1200  # length of a replay, frames: 40 s
BETWEEN_S = 6.0  # time between faults, seconds
BACK_S = 30.0  # longest time without poses after a fault, seconds
HUNG_S = 14.0  # duration of a hang, seconds; longer than a supervisor waits
UNSAID = 40
"""Largest number of messages that a node processes between two reports. A killed node never reports those since its
last."""
DISK = "size=24m"
POSES = (POSE_RAW, POSE_CLEAN, POSE_WORLD)
CAUSES = {"in": "in.", "lost": "dropped.lost", "expired": "dropped.expired", "away": "dropped.away"}
"""What becomes of a message, and its name in diagnostics."""
SAME_M = 1e-6  # largest difference of equal positions, metres; positions are float32
CLOCK_STEPS_S = (3600.0, -1800.0, 60.0, -60.0)
GARBAGE = (
    b"GET / HTTP/1.1\r\n\r\n",
    b"\0" * 4096,
    b"\xff\0\0\0\0\0\0\x7f" + b"A" * 70000,
    b"{" * 5000,
    b"RTPS\2\3" * 99,
)
FOXGLOVE_OPEN = (
    b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
)
ROS_DOMAIN = 87
ROS_PORTS = range(7400 + 250 * ROS_DOMAIN, 7400 + 250 * ROS_DOMAIN + 30)
"""Ports of RTPS in that domain: discovery and data of its first participants."""


@dataclass
class Replayed:
    """Total differences of replays with faults, for one topic: numbers of frames, largest deviation of a joint, and
    longest run of deviating frames."""

    frames: int = 0
    lost: int = 0
    twice: int = 0
    deviating: int = 0
    furthest_m: float = 0.0
    longest_s: float = 0.0


def run(bench: Bench) -> Result:
    """Inject faults into running nodes and account for each frame. A loss without a cause is an error."""
    random_, half_s = random.Random(bench.seeds[0]), 30.0 * (2.0 if bench.quick else MINUTES)
    with tempfile.TemporaryDirectory(prefix="steadypose-") as folder:
        replayed, kills = replays(Path(folder), half_s, random_)
        gaps, counts, wrong = live(Path(folder), half_s, random_)
    wrong += [f"{topic}: {each.lost} lost, {each.twice} twice" for topic, each in replayed.items() if each.lost]
    wrong += [f"{fault}: no poses for {max(found):.1f} s" for fault, found in gaps.items() if max(found) > BACK_S]
    data: dict[str, Any] = {
        "replays": {topic: dataclasses.asdict(each) for topic, each in replayed.items()},
        "kills": kills, "seconds without pose/world": gaps, "live": counts, "wrong": wrong,
    }  # fmt: skip
    return Result([_replays_table(replayed, kills), _live_table(gaps, counts)], data, wrong=wrong)


def replays(folder: Path, seconds: float, random_: random.Random) -> tuple[dict[str, Replayed], dict[str, int]]:
    """Compare replays with kills and stops to one without; also return the number of faults."""
    frames = list(islice(crowd(recorded(), 1), FRAMES))
    _write(folder / "in", frames)
    expected = _played(folder)
    found = {topic: Replayed() for topic in expected}
    kills: dict[str, int] = defaultdict(int)
    ended = time.monotonic() + seconds
    while time.monotonic() < ended:
        for topic, poses in _played(folder, random_, kills).items():
            _compare(expected[topic], poses, found[topic])
    return found, dict(kills)


def _played(
    folder: Path, random_: random.Random | None = None, kills: dict[str, int] | None = None
) -> dict[str, dict[int, list[Any]]]:
    """Return the positions that a replay recorded, by topic and frame number. With ``random_``, inject faults and count
    them in ``kills``."""
    out = folder / "out"
    shutil.rmtree(out, ignore_errors=True)
    settings = _settings(folder / "in", out, lossless=True)
    with running_nodes([*POSE_NODES, "recorder"], settings) as nodes:
        due, left_s = time.monotonic() + BETWEEN_S, FRAMES / FPS
        for topic, message in nodes.messages:
            if topic == POSE_WORLD:
                left_s -= 1.0 / FPS
            if topic == POSE_WORLD and not isinstance(message, Diagnostics) and message.end_of_stream:
                break
            if random_ and kills is not None and time.monotonic() > due and left_s > BETWEEN_S:
                name = random_.choice([*POSE_NODES, "recorder", "prior and trajectory"])
                with_ = random_.choice([signal.SIGKILL, signal.SIGKILL, signal.SIGSTOP])
                for each in name.split(" and "):
                    _send(nodes, each, with_)
                if with_ == signal.SIGSTOP:
                    time.sleep(1.0)
                    for each in name.split(" and "):
                        _send(nodes, each, signal.SIGCONT)
                kills[f"{name} {'killed' if with_ == signal.SIGKILL else 'stopped'}"] += 1
                due = time.monotonic() + BETWEEN_S
        _until_recorded(nodes)
    found: dict[str, dict[int, list[Any]]] = {topic: defaultdict(list) for topic in POSES}
    with RecordingReader(out) as reader:
        for topic, _, message in reader.messages(found):
            assert not isinstance(message, Diagnostics)
            if not message.end_of_stream:
                # a restarted node has another first stamp, and a grid that is off by a nanosecond
                number = round((message.stamp_ns - reader.start_ns) / FRAME_NS)
                found[topic][number].append([body.positions for body in message.bodies])  # type: ignore[union-attr]
    return found


def _until_recorded(nodes: Running) -> None:
    """Wait until the recorder has received the end of the last stream, at most `BACK_S`."""
    ends = time.monotonic() + BACK_S
    for _, message in nodes.messages:
        if time.monotonic() > ends:
            return
        if isinstance(message, Diagnostics) and message.node == "recorder" and POSE_WORLD in message.values["ended"]:
            return


def _compare(expected: dict[int, list[Any]], got: dict[int, list[Any]], found: Replayed) -> None:
    found.frames += len(expected)
    found.twice += sum(len(each) - 1 for each in got.values())
    since: int | None = None
    for number in sorted(expected):
        if number not in got:
            found.lost += 1
            continue
        one, other = np.array(expected[number][0]), np.array(got[number][0])
        off_m = float(np.nan_to_num(np.abs(one - other)).max(initial=0.0)) if one.shape == other.shape else np.inf
        if off_m > SAME_M:
            found.deviating += 1
            found.furthest_m = max(found.furthest_m, off_m)
            since = number if since is None else since
            found.longest_s = max(found.longest_s, (number + 1 - since) / FPS)
        else:
            since = None


def live(
    folder: Path, seconds: float, random_: random.Random
) -> tuple[dict[str, list[float]], dict[str, dict[str, int]], list[str]]:
    """Process a live stream with faults. Returns seconds without poses after each fault; what became of each node's
    frames; and what does not add up."""
    _write(folder / "stepping", _stepping(list(islice(crowd(recorded(), 1), FRAMES))))
    gaps: dict[str, list[float]] = defaultdict(list)
    optional = {"foxglove": "foxglove", "ros2_bridge": "cyclonedds"}
    names = [*POSE_NODES, "recorder", *(node for node, module in optional.items() if find_spec(module))]
    os.environ |= {"ROS_DOMAIN_ID": str(ROS_DOMAIN), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    port = _free_port()
    with _small_disk(folder / "disk") as disk:
        settings = [*_settings(folder / "stepping", disk / "out", lossless=False), f"foxglove.port={port}"]
        # poses are read while faults are injected
        with running_nodes(names, settings) as nodes, ThreadPoolExecutor(1) as another:
            ledger, reports = Ledger(Launch.read("replay", settings)), {}
            faults = _faults(nodes, disk, port, random_)
            ended, fault, last_s = time.monotonic() + seconds, "", 0.0
            pending: Future[None] = another.submit(time.sleep, 2 * BETWEEN_S)
            for topic, message in nodes.messages:
                now = time.monotonic()
                if isinstance(message, Diagnostics):
                    restarts = nodes.supervisor.children[message.node].restarts
                    reports[message.node] = ledger.note(message, restarts)
                elif topic == POSE_WORLD:
                    if fault and last_s:  # not while waiting for the first pose
                        gaps[fault][-1] = max(gaps[fault][-1], round(now - last_s, 3))
                    last_s = now
                if pending.done():
                    pending.result()
                    if now > ended:
                        break
                    fault = random_.choice(list(faults))
                    gaps[fault].append(0.0)
                    pause_s = BETWEEN_S + (HUNG_S if fault.startswith("hang") else 0.0)
                    pending = another.submit(_befall, faults[fault], pause_s)
            deaths = {name: child.restarts for name, child in nodes.supervisor.children.items()}
            counts, wrong = _accounts(ledger, reports, deaths)
            failed = nodes.supervisor.failed
    return dict(gaps), counts, wrong + [f"{name} has failed" for name in failed]


def _befall(fault: Callable[[], None], pause_s: float) -> None:
    fault()
    time.sleep(pause_s)


def _faults(nodes: Running, disk: Path, port: int, random_: random.Random) -> dict[str, Callable[[], None]]:
    def stop(name: str) -> None:
        _send(nodes, name, signal.SIGSTOP)
        time.sleep(random_.uniform(0.5, 2.0))
        _send(nodes, name, signal.SIGCONT)

    def fill() -> None:
        with suppress(OSError), open(disk / "filler", "wb") as file:
            while True:
                file.write(bytes(2**20))
        time.sleep(2.0)
        (disk / "filler").unlink()

    def disturb() -> None:
        for garbage in GARBAGE:
            with suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0) as client:
                client.sendall(garbage)
            for endpoint in nodes.endpoints:
                with suppress(OSError), socket.socket(socket.AF_UNIX) as client:
                    client.settimeout(1.0)
                    client.connect(endpoint.removeprefix("ipc://"))
                    client.sendall(garbage)

    def disturb_foxglove() -> None:
        """Connect as a valid client, then send malformed data."""
        with suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0) as client:
            client.sendall(FOXGLOVE_OPEN)
            client.recv(4096)
            for text in (
                b'{"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 4294967295}]}',
                b'{"op": 7}',
                b"{",
            ):
                client.sendall(bytes([0x81, 0x80 | len(text), 0, 0, 0, 0]) + text)
            client.sendall(bytes([0x82, 0x80 | 100, 0, 0, 0, 0]) + random_.randbytes(100))
            client.sendall(bytes([0xFF, 0xFF]) + b"\xff" * 12)

    def disturb_ros() -> None:
        """Send RTPS submessages with invalid lengths and kinds."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            for place in ROS_PORTS:
                for _ in range(20):
                    kind = random_.choice((0x15, 0x09, 0x07, 0x06, random_.randrange(256)))
                    length = random_.randrange(65536)
                    header = b"RTPS\2\3\1\x10" + random_.randbytes(12) + struct.pack("<BBH", kind, 1, length)
                    with suppress(OSError):
                        client.sendto(header + random_.randbytes(random_.randrange(400)), ("127.0.0.1", place))

    faults: dict[str, Callable[[], None]] = {"malformed clients": disturb}
    if "foxglove" in nodes.supervisor.children:
        faults["malformed Foxglove client"] = disturb_foxglove
    if "ros2_bridge" in nodes.supervisor.children:
        faults["malformed ROS client"] = disturb_ros
    for name in nodes.supervisor.children:
        faults[f"kill {name}"] = lambda name=name: _send(nodes, name, signal.SIGKILL)
        faults[f"stop {name}"] = lambda name=name: stop(name)
    faults["hang prior"] = lambda: _send(nodes, "prior", signal.SIGSTOP)
    if disk.is_mount():
        faults["full disk"] = fill
    return faults


def _accounts(
    ledger: Ledger, reports: dict[str, Diagnostics], restarts: dict[str, int]
) -> tuple[dict[str, dict[str, int]], list[str]]:
    """Return for each node: frames published for it, processed, dropped by cause; and where that does not add up."""
    counts: dict[str, dict[str, int]] = {}
    wrong = []
    for name, report in reports.items():
        if NODES[name].delivery is Delivery.BEST_EFFORT or not NODES[name].subscribes:
            continue  # may miss any message, or receives none
        values = {k: int(v) for k, v in report.values.items() if k.startswith((*LOSSES, "in."))}
        values |= {k: int(v) for k, v in ledger.away(name, reports).items()}
        streams = [
            (p, t) for p, topics in NODES[name].subscribes.items() for t in topics if p in reports and t in POSES
        ]
        counts[name] = {"published": sum(int(reports[p].values.get(f"count.{t}", 0)) for p, t in streams)}
        for cause, key in CAUSES.items():
            counts[name][cause] = sum(values.get(f"{key} {t}".replace(". ", "."), 0) for _, t in streams)
        counts[name]["late"] = values.get("dropped.late", 0)
        unexplained = 2 * counts[name]["published"] - sum(counts[name].values())
        deaths = sum(restarts[each] for each in (name, *NODES[name].subscribes) if each in restarts)
        if abs(unexplained) > UNSAID * len(streams) * (1 + deaths):
            wrong.append(f"{name}: {unexplained} of {counts[name]['published']} messages are not accounted for")
    return counts, wrong


@contextmanager
def _small_disk(folder: Path) -> Iterator[Path]:
    """Mount a file system of a few megabytes, if this user may; otherwise use a folder."""
    folder.mkdir()
    mounted = (
        not os.getuid()
        and not subprocess.run(
            ["mount", "-t", "tmpfs", "-o", DISK, "tmpfs", folder], capture_output=True, timeout=30
        ).returncode
    )
    try:
        yield folder
    finally:
        if mounted:
            subprocess.run(["umount", "--lazy", folder], check=True, timeout=30)


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def _settings(played: Path, out: Path, *, lossless: bool) -> list[str]:
    return [
        f"input.recording={json.dumps(str(played))}", "input.rate=1.0", f"input.loop={json.dumps(not lossless)}",
        f"transport.lossless={json.dumps(lossless)}", f"recorder.directory={json.dumps(str(out))}",
        "recorder.free_mb=1.0", "recorder.split_mb=4.0", f"recorder.keep_mb={0.0 if lossless else 12.0}",
    ]  # fmt: skip


def _stepping(frames: Sequence[PoseRaw]) -> list[PoseRaw]:
    """Return the frames of a sensor whose clock is set a few times, permanently or for one frame."""
    stepped, shift_s, span = [], 0.0, len(frames) // (len(CLOCK_STEPS_S) + 1)
    for index, frame in enumerate(frames):
        if index and index % span == 0:
            shift_s += CLOCK_STEPS_S[(index // span - 1) % len(CLOCK_STEPS_S)]
        once_s = 60.0 if index % span == span // 2 else 0.0
        stepped.append(dataclasses.replace(frame, stamp_ns=frame.stamp_ns + round(1e9 * (shift_s + once_s))))
    return stepped


def _write(directory: Path, frames: Sequence[PoseRaw]) -> None:
    with RecordingWriter(directory) as writer:
        for index, frame in enumerate(frames):  # recorded in their order, whatever their stamps
            writer.write(POSE_RAW, frame, frames[0].stamp_ns + index)


def _send(nodes: Running, name: str, with_: signal.Signals) -> None:
    with suppress(ProcessLookupError):
        os.kill(nodes.supervisor.children[name].pid, with_)


def _replays_table(found: dict[str, Replayed], kills: dict[str, int]) -> Table:
    return Table(
        "soak-replays", "A replay that is to lose nothing, with faults",
        ["topic", "frames", "lost", "twice", "deviating", "furthest, mm", "longest, s"],
        [[topic, *map(str, (f.frames, f.lost, f.twice, f.deviating)), f"{1e3 * f.furthest_m:.1f}",
          f"{f.longest_s:.1f}"] for topic, f in found.items()],
        f"Against a replay without: {', '.join(f'{name} {n} times' for name, n in sorted(kills.items()))}.",
    )  # fmt: skip


def _live_table(gaps: dict[str, list[float]], counts: dict[str, dict[str, int]]) -> Table:
    published = sum(row["published"] for row in counts.values())
    causes = {cause: sum(row[cause] for row in counts.values()) for cause in ("in", "lost", "expired", "late", "away")}
    return Table(
        "soak-live", "A live stream with faults: seconds without pose/world",
        ["fault", "p50", "p95", "longest", "times"],
        [[fault, *(f"{q:.2f}" for q in np.percentile(found, (50, 95, 100))), str(len(found))]
         for fault, found in sorted(gaps.items())],
        f"Of {published:,} messages published to the nodes, {', '.join(f'{n:,} {c}' for c, n in causes.items())}: "
        "worked on, lost in a full queue, older than they may be, dropped for a newer one, and published while nobody "
        "of that name was there.",
    )  # fmt: skip
