import dataclasses
import itertools
import shutil
import socket
import stat
import threading
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zmq
from tests.helpers.msg_strategies import EXAMPLES, diagnostics, raw

from steadypose.msgs import delivery
from steadypose.msgs import publisher as publishing
from steadypose.msgs import subscriber as subscribing
from steadypose.msgs.codec import encode
from steadypose.msgs.delivery import PREFIX
from steadypose.msgs.security import create_keys, load_keys
from steadypose.msgs.subscriber import MAX_RECEIVED
from steadypose.msgs.topics import DIAGNOSTICS, POSE_CLEAN, POSE_RAW, POSE_WORLD
from steadypose.msgs.transport import MAX_FRAME, VERSION, Publisher, Subscriber, TransportError

SOON_S = 20.0
"""for what must happen; the machine may be busy"""
NEVER_S = 0.3
"""for what must not happen"""
BIG = raw(joints=100, bodies=100)
"""160 kB, so that the kernel's buffers hold few"""


@pytest.fixture(params=["ipc", "tcp"])
def endpoint(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return f"ipc://{tmp_path}/socket" if request.param == "ipc" else "tcp://127.0.0.1:*"


@pytest.fixture
def small_buffers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(publishing, "SEND_HIGH_WATER", 5)


@pytest.fixture
def rogue() -> Iterator[zmq.Socket[bytes]]:
    """A publisher that does not keep to the layout."""
    with zmq.Context() as context, context.socket(zmq.XPUB) as publisher:
        publisher.bind("tcp://127.0.0.1:*")
        yield publisher


@contextmanager
def hearing(rogue: zmq.Socket[bytes], *topics: str, **options: Any) -> Iterator[Subscriber]:
    where = rogue.get_string(zmq.LAST_ENDPOINT)
    with Subscriber(where, topics or POSE_RAW, clear_text=True, **options) as subscriber:
        for _ in topics or (POSE_RAW,):
            assert rogue.poll(round(SOON_S * 1000))
            rogue.recv()
        yield subscriber


def frame(sequence: int, payload: bytes = encode(raw()), topic=b"pose/raw", version=VERSION, age_s=0.0) -> bytes:
    prefix = PREFIX.pack(version, 42, sequence, time.monotonic_ns() - round(age_s * 1e9))
    return topic + b"\0" + prefix + payload


def wait_until(condition: Callable[[], Any]) -> Any:
    deadline = time.monotonic() + SOON_S
    while not (met := condition()):
        assert time.monotonic() < deadline, "waited in vain"
    return met


def stamps_until(subscriber: Subscriber, last: int) -> list[int]:
    stamps = []
    while not stamps or stamps[-1] < last:
        received = subscriber.receive(SOON_S)
        assert received, f"{last} did not come after {stamps}"
        stamps.append(received[1].stamp_ns)
    return stamps


@contextmanager
def connected(at: str, topics: Collection[str] = POSE_RAW, **options: Any) -> Iterator[tuple[Publisher, Subscriber]]:
    with Publisher(at) as publisher, Subscriber(publisher.endpoint, topics, name="test", **options) as subscriber:
        assert publisher.wait_for_subscribers(["test"], timeout_s=SOON_S)
        yield publisher, subscriber


@pytest.mark.parametrize("topics", [tuple(EXAMPLES), (POSE_WORLD,)])
def test_messages_of_the_topics_subscribed_to_arrive_as_they_were_and_no_others(endpoint: str, topics: tuple[str, ...]):
    with connected(endpoint, topics) as (publisher, subscriber):
        for topic, message in EXAMPLES.items():
            assert publisher.publish(topic, message)
        for topic in topics:
            assert subscriber.receive(SOON_S) == (topic, EXAMPLES[topic])
        assert subscriber.receive(NEVER_S) is None
        assert not subscriber.dropped
        assert not subscriber.refused


def test_a_subscriber_may_be_first_and_outlive_its_publisher(endpoint: str, tmp_path: Path) -> None:
    with Publisher(endpoint) as publisher:
        subscriber = Subscriber(publisher.endpoint, POSE_RAW, name="test")
        assert publisher.wait_for_subscribers(["test"], timeout_s=SOON_S)
        publisher.publish(POSE_RAW, raw())
    with subscriber:
        assert subscriber.receive(SOON_S) == (POSE_RAW, raw())
    path = f"ipc://{tmp_path}/socket"
    with Subscriber(path, POSE_RAW, name="test") as subscriber:
        for start in (0, 10):
            with Publisher(path) as publisher:
                # ZeroMQ subscribes again when the subscriber next looks for messages
                wait_until(lambda publisher=publisher: subscriber.receive(0) or publisher.subscribers)
                for stamp in range(start, start + 3):
                    publisher.publish(POSE_RAW, raw(stamp))
                    assert subscriber.receive(SOON_S) == (POSE_RAW, raw(stamp))
        assert not subscriber.dropped, "a publisher that starts again counts from 0, which is no loss"


def test_publishers_of_one_topic_at_ipc_and_tcp_addresses_are_counted_apart(tmp_path: Path):
    with (
        Publisher(f"ipc://{tmp_path}/a") as near,
        Publisher("tcp://127.0.0.1:*") as far,
        Publisher(f"ipc://{tmp_path}/b") as last,
    ):
        publishers = (near, far, last)
        addresses = [*(publisher.endpoint for publisher in publishers), f"ipc://{tmp_path}/nobody"]
        with Subscriber(addresses, [DIAGNOSTICS, POSE_RAW], name="test") as subscriber:
            for publisher in publishers:
                assert publisher.wait_for_subscribers(["test"], timeout_s=SOON_S)
            for n in (0, 0, 1, 2, 0, 1):
                publishers[n].publish(DIAGNOSTICS, diagnostics())
                publishers[n].publish(POSE_RAW, dataclasses.replace(raw(), source=f"camera {n}"))
            for _ in range(12):
                assert subscriber.receive(SOON_S)
            assert not subscriber.dropped
            assert not subscriber.refused


def test_listeners_come_and_go(endpoint: str):
    with Publisher(endpoint) as publisher, Subscriber(publisher.endpoint, POSE_RAW):
        with Subscriber(publisher.endpoint, POSE_RAW, name="a"), Subscriber(publisher.endpoint, POSE_RAW, name="ab"):
            assert publisher.wait_for_subscribers(["a", "ab"], timeout_s=SOON_S)
            assert publisher.subscribers == {"a", "ab"}
            assert not publisher.wait_for_subscribers(["a", "c"], timeout_s=NEVER_S)
        wait_until(lambda: not publisher.subscribers)
        assert publisher.wait_for_subscribers([], timeout_s=0)


def test_conflate_gives_the_newest_and_counts_the_others(endpoint: str):
    with Publisher(endpoint) as publisher, Subscriber(publisher.endpoint, POSE_RAW, conflate=True) as subscriber:
        stamp = itertools.count()
        first = wait_until(lambda: publisher.publish(POSE_RAW, raw(next(stamp))) and subscriber.receive(0.01))
        last = next(stamp) + 1000
        for later in range(last - 1000, last + 1):
            publisher.publish(POSE_RAW, raw(later))
        stamps = stamps_until(subscriber, last)
        assert stamps == sorted(set(stamps))
        assert len(stamps) + subscriber.dropped[POSE_RAW] == last - first[1].stamp_ns
        assert subscriber.dropped[POSE_RAW] > 0


def test_a_conflating_subscriber_that_never_reads_holds_up_no_lossless_publisher(endpoint: str):
    with (
        Publisher(endpoint, reliable={"test"}) as publisher,
        Subscriber(publisher.endpoint, POSE_RAW, conflate=True) as subscriber,
    ):
        wait_until(lambda: publisher.publish(POSE_RAW, BIG) and subscriber.receive(0.01))
        for stamp in range(publishing.SEND_HIGH_WATER + 500):
            assert publisher.publish(POSE_RAW, raw(stamp), timeout_s=SOON_S)


@pytest.mark.usefixtures("small_buffers")
def test_what_does_not_fit_is_lost_and_counted(endpoint: str):
    with connected(endpoint, high_water=5) as (publisher, subscriber):
        for stamp in range(300):
            publisher.publish(POSE_RAW, dataclasses.replace(BIG, stamp_ns=stamp))
        later = itertools.count(300)
        stamps = []

        def a_later_message_comes() -> bool:
            publisher.publish(POSE_RAW, raw(next(later)))
            if received := subscriber.receive(0.01):
                stamps.append(received[1].stamp_ns)
            return bool(stamps) and stamps[-1] >= 300

        wait_until(a_later_message_comes)  # for a loss shows in what comes after it
        assert stamps == sorted(set(stamps))
        assert subscriber.dropped[POSE_RAW] == stamps[-1] + 1 - len(stamps) > 0


@pytest.mark.usefixtures("small_buffers")
def test_a_subscriber_that_never_reads_neither_blocks_nor_fills_its_publisher(endpoint: str):
    with connected(endpoint, high_water=5) as (publisher, subscriber):

        def publish() -> None:
            for stamp in range(500):
                publisher.publish(POSE_RAW, dataclasses.replace(BIG, stamp_ns=stamp))

        publishing = threading.Thread(target=publish, daemon=True)
        publishing.start()
        publishing.join(60)
        assert not publishing.is_alive(), "publish waits"
        # 5 messages there, 5 here, and what the kernel holds on the way: not the 80 MB that were published
        held = 0
        while subscriber.receive(NEVER_S):
            held += 1
        assert held < 200


def test_who_is_reliable_is_waited_for_and_nobody_else(endpoint: str):
    with (
        Publisher(endpoint, reliable={"slow"}) as publisher,
        Subscriber(publisher.endpoint, POSE_RAW, reliable=True, name="slow") as slow,
        Subscriber(publisher.endpoint, POSE_RAW, reliable=True, name="self-appointed"),
        Subscriber(publisher.endpoint, POSE_RAW, high_water=5, name="deaf"),
    ):
        assert publisher.wait_for_subscribers(["self-appointed", "deaf"], timeout_s=SOON_S)
        assert publisher.wait_for_subscribers(["slow"], timeout_s=SOON_S)
        received, waits = [], 0
        for stamp in range(300):
            message = dataclasses.replace(BIG, stamp_ns=stamp)
            while not publisher.publish(POSE_RAW, message, timeout_s=0):
                waits += 1
                got = slow.receive(SOON_S)
                assert got
                received.append(got[1].stamp_ns)
        received += stamps_until(slow, 299)
        assert waits > 0
        assert received == list(range(300))
        assert not slow.dropped


@pytest.mark.parametrize("host", ["0.0.0.0", "*", "192.168.1.5", "[::]", "example.org", "eth0", "127.0.0.1;10.0.0.5:1"])
def test_an_address_others_can_reach_needs_keys_or_to_be_named_clear_text(host: str):
    with pytest.raises(TransportError, match="can be reached from other machines: expected keys, got none"):
        Publisher(f"tcp://{host}:7101")
    with pytest.raises(TransportError, match="is another machine: expected keys, got none"):
        Subscriber("tcp://192.0.2.1:7101", POSE_RAW)
    Subscriber("tcp://192.0.2.1:7101", POSE_RAW, clear_text=True).close()
    Publisher("tcp://0.0.0.0:*", clear_text=True).close()


def test_a_folder_is_made_and_no_file_is_deleted_at_an_address_or_in_the_place_of_its_folder(tmp_path: Path):
    (tmp_path / "thesis").write_text("years of work")
    with pytest.raises(TransportError, match="expected no file there"):
        Publisher(f"ipc://{tmp_path}/thesis")
    with pytest.raises(TransportError, match=r"cannot make .*thesis"):
        Publisher(f"ipc://{tmp_path}/thesis/socket")
    assert (tmp_path / "thesis").read_text() == "years of work"
    with Publisher(f"ipc://{tmp_path}/new/folder/socket"):
        assert (tmp_path / "new" / "folder").stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize(
    "bad",
    ["", "7101", "tcp://", "tcp://127.0.0.1", "tcp://:1", "tcp://a:b", "tcp://127.0.0.1:65536", "udp://a:1", "ipc://"],
)
def test_a_malformed_address_is_refused(bad: str):
    expected = r"expected ipc://PATH or tcp://HOST:PORT, got "
    with pytest.raises(TransportError, match=expected):
        Publisher(bad)
    with pytest.raises(TransportError, match=expected):
        Subscriber(bad, POSE_RAW)


def test_an_address_is_not_taken_from_another_publisher(endpoint: str):
    with Publisher(endpoint) as publisher, pytest.raises(TransportError, match="cannot publish at"):
        Publisher(publisher.endpoint)
    with Publisher(publisher.endpoint):
        pass


def test_topics_are_checked(tmp_path: Path):
    path = f"ipc://{tmp_path}/socket"
    with pytest.raises(ValueError, match=r"expected one of pose/raw, .*, got 'pose/row'"):
        Subscriber(path, "pose/row")
    with pytest.raises(ValueError, match="conflate: expected one topic and no name"):
        Subscriber(path, [POSE_RAW, POSE_CLEAN], conflate=True)
    with pytest.raises(ValueError, match="conflate: expected one topic and no name"):
        Subscriber(path, POSE_RAW, conflate=True, name="test")
    with Publisher(path) as publisher:
        with pytest.raises(ValueError, match="pose/clean: expected PoseClean, got PoseRaw"):
            publisher.publish(POSE_CLEAN, raw())
        with pytest.raises(ValueError, match="topic: expected one of"):
            publisher.publish("pose/row", raw())
        with pytest.raises(ValueError, match=f"at most {MAX_FRAME} bytes"):
            publisher.publish(POSE_RAW, raw(joints=70_000))


def test_garbage_is_counted_by_cause(rogue: zmq.Socket[bytes]):
    with hearing(rogue) as subscriber:
        subscriber.socket.setsockopt(zmq.SUBSCRIBE, b"")
        wait_until(lambda: rogue.poll(0) and rogue.recv() == b"\1")
        for garbage in (b"", b"pose/raw", b"pose/raw\0", b"pose/raw\0\2\0\0", b"\xff\xfe\0" + bytes(20)):
            rogue.send(garbage)
        for wrong in (frame(0, topic=b"pose/row"), frame(0, version=VERSION + 1), frame(0, b"\0\1\0\0garbage")):
            rogue.send(wrong)
        rogue.send(frame(1, b""))
        rogue.send_multipart([frame(2), b"more"])
        rogue.send(frame(2))
        rogue.send(frame(2))
        assert subscriber.receive(SOON_S) == (POSE_RAW, raw())
        assert subscriber.receive(NEVER_S) is None
        counted = {"malformed": 4, "unknown topic": 2, "version": 1, "undecodable": 2, "multipart": 1, "repeated": 1}
        assert subscriber.refused == counted
        assert not subscriber.dropped


def test_sequence_numbers_wrap(rogue: zmq.Socket[bytes]):
    with hearing(rogue) as subscriber:
        for sequence in (2**32 - 3, 2**32 - 1, 0, 4):
            rogue.send(frame(sequence))
        for _ in range(4):
            assert subscriber.receive(SOON_S)
        assert subscriber.dropped == {POSE_RAW: 1 + 3}


def test_a_flood_of_garbage_does_not_outlast_the_timeout(rogue: zmq.Socket[bytes]):
    with hearing(rogue) as subscriber:
        for _ in range(10):
            rogue.send(b"pose/raw\0")
        wait_until(lambda: subscriber.socket.poll(0))
        assert subscriber.receive(0) is None
        assert subscriber.refused["malformed"] < 10


@pytest.mark.parametrize("size", [MAX_FRAME, MAX_RECEIVED])
def test_a_frame_too_large_is_counted_and_the_next_is_heard(size: int, rogue: zmq.Socket[bytes]):
    with hearing(rogue) as subscriber:
        rogue.send(frame(0, bytes(size)))
        sequence = itertools.count(1)
        wait_until(lambda: rogue.send(frame(next(sequence))) or subscriber.receive(0.01))
        assert subscriber.refused == {"too large": 1}


def test_messages_that_are_old_are_dropped_and_counted_but_not_the_end(rogue: zmq.Socket[bytes]):
    end = dataclasses.replace(raw(5), bodies=[], end_of_stream=True)
    with hearing(rogue, POSE_RAW, DIAGNOSTICS, lifespan_s=1.0) as subscriber:
        for sequence, (age, message) in enumerate([(60.0, raw(1)), (1.5, raw(2)), (0.0, raw(3)), (60.0, end)]):
            rogue.send(frame(sequence, encode(message), age_s=age))
        rogue.send(frame(0, encode(diagnostics()), topic=b"diagnostics", age_s=60.0))
        got = [subscriber.receive(SOON_S) for _ in range(3)]
        assert got == [(POSE_RAW, raw(3)), (POSE_RAW, end), (DIAGNOSTICS, diagnostics())]
        assert subscriber.late == {POSE_RAW: 2}
        assert not subscriber.dropped


def test_another_machines_clock_is_found_from_its_fastest_message():
    with Subscriber("tcp://192.0.2.1:7101", POSE_RAW, clear_text=True, lifespan_s=1.0) as subscriber:
        for apart_s in (-7e5, 7e5):
            start_ns = time.monotonic_ns() + round(apart_s * 1e9)
            publisher = round(abs(apart_s) + apart_s)
            assert subscriber._age_ns(publisher, start_ns) == 0
            assert abs(subscriber._age_ns(publisher, start_ns - 2 * 10**9) - 2e9) < 1e8
            assert subscriber._age_ns(publisher, start_ns + 10**9) == 0


@pytest.mark.parametrize("endpoint", ["ipc"], indirect=True)
def test_a_flood_of_subscriptions_is_cut_off_and_forgotten(endpoint: str):
    with (
        Publisher(endpoint) as publisher,
        Subscriber(publisher.endpoint, POSE_RAW, name="friend") as friend,
        zmq.Context() as context,
        context.socket(zmq.XSUB) as hostile,
    ):
        assert publisher.wait_for_subscribers(["friend"], timeout_s=SOON_S)
        hostile.setsockopt(zmq.LINGER, 0)
        hostile.setsockopt(zmq.RECONNECT_IVL, 100_000)
        hostile.connect(publisher.endpoint)
        heard = 0
        for number in range(50_000):
            hostile.send(b"\1" + b"%0900d" % number, zmq.NOBLOCK)
            if number % 500 == 0:
                publisher.publish(POSE_RAW, raw(number))
                heard += friend.receive(SOON_S) == (POSE_RAW, raw(number))
        assert heard == 100, "nobody else notices"
        wait_until(lambda: publisher.subscribers and publisher.refused["subscriptions"])
        wait_until(lambda: publisher.subscribers and len(publisher._subscriptions) == 2)


def test_what_a_subscriber_claims_of_itself_is_checked(endpoint: str):
    with (
        Publisher(endpoint, reliable={"x"}, clear_text=True) as publisher,
        Subscriber(publisher.endpoint, POSE_RAW, name="friend", clear_text=True) as friend,
        zmq.Context() as context,
        context.socket(zmq.XSUB) as hostile,
    ):
        assert publisher.wait_for_subscribers(["friend"], timeout_s=SOON_S)
        if endpoint.startswith("tcp"):
            port = int(publisher.endpoint.rpartition(":")[2])
            with socket.create_connection(("127.0.0.1", port)) as stranger:  # not even ZeroMQ
                stranger.sendall(b"GET / HTTP/1.1\r\n\r\n" + bytes(range(256)) * 100)
        hostile.setsockopt(zmq.LINGER, 0)
        hostile.connect(publisher.endpoint)
        for junk in (b"\xff", b"\xffx\0\0", b"\xffx\0zz\0pose/raw", b"\xff\xfe\0" + b"0" * 8 + b"\0", b"\xff" * 900):
            hostile.send(b"\1" + junk)
        for junk in (b"", b"\0\xffnobody", b"\2", b"\2" + bytes(12), b"\2" + b"\xff" * 20, b"hello"):
            hostile.send(junk)
        for stamp in range(50):
            publisher.publish(POSE_RAW, raw(stamp), timeout_s=0)
            assert friend.receive(SOON_S) == (POSE_RAW, raw(stamp))
        assert publisher.subscribers == {"friend"}


@pytest.fixture
def key_directories(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ...]:
    """Of a robot, of a guest on its list, and of one who is not."""
    directories = [tmp_path_factory.mktemp("keys") / name for name in ("robot", "guest", "stranger")]
    robot, guest, stranger = directories
    for directory in directories:
        create_keys(directory)
    for other in (guest, stranger):
        (other / "server.key").write_text((robot / "own.key").read_text())
    (robot / "clients" / "guest.key").write_text((guest / "own.key").read_text())
    return robot, guest, stranger


@pytest.mark.parametrize("at", ["tcp://127.0.0.1:*", "tcp://0.0.0.0:*", "ipc://{}/socket"])
def test_with_keys_only_the_listed_listen(at: str, key_directories: tuple[Path, ...], tmp_path: Path, monkeypatch):
    monkeypatch.setattr(subscribing, "REVIVE_S", 0.0)
    robot, guest, stranger = (load_keys(directory) for directory in key_directories)
    with Publisher(at.format(tmp_path), keys=robot) as publisher:
        reach = publisher.endpoint.replace("0.0.0.0", "127.0.0.1")
        with (
            Subscriber(reach, POSE_RAW, keys=robot, name="own") as own,
            Subscriber(reach, POSE_RAW, keys=guest, name="guest") as listed,
            Subscriber(reach, POSE_RAW, keys=stranger, name="stranger") as unlisted,
            Subscriber(reach, POSE_RAW, name="keyless") as keyless,
        ):
            assert publisher.wait_for_subscribers(["own", "guest"], timeout_s=SOON_S)
            for refused in (unlisted, keyless):
                wait_until(lambda refused=refused: refused.receive(0) or refused.refused["handshake"] > 1)
                assert refused.refused.keys() == {"handshake"}, "no frame was too large"
            publisher.publish(POSE_RAW, raw())
            assert own.receive(SOON_S) == (POSE_RAW, raw())
            assert listed.receive(SOON_S) == (POSE_RAW, raw())
            assert unlisted.receive(NEVER_S) is None
            assert keyless.receive(NEVER_S) is None
            assert publisher.subscribers == {"own", "guest"}


def test_nobody_is_let_in_when_keys_are_not_checked_any_more(key_directories: tuple[Path, ...]):
    robot, guest, stranger = (load_keys(directory) for directory in key_directories)
    with Publisher("tcp://127.0.0.1:*", keys=robot) as publisher:
        assert publisher._authenticator
        publisher.check()
        publisher._authenticator.stop()
        with (
            Subscriber(publisher.endpoint, POSE_RAW, keys=stranger, name="stranger") as unlisted,
            Subscriber(publisher.endpoint, POSE_RAW, keys=guest, name="guest"),
        ):
            assert not publisher.wait_for_subscribers(["stranger"], timeout_s=NEVER_S)
            publisher.publish(POSE_RAW, raw())
            assert unlisted.receive(NEVER_S) is None
            assert not publisher.subscribers
        with pytest.raises(RuntimeError, match="nobody is let in any more"):
            publisher.check()


def test_who_is_taken_off_the_list_is_put_out_and_who_is_added_let_in(key_directories: tuple[Path, ...], monkeypatch):
    monkeypatch.setattr(publishing, "CHECK_S", 0.0)
    directory = key_directories[0]
    robot, guest, late = (load_keys(directory) for directory in key_directories)
    with (
        Publisher("tcp://127.0.0.1:*", keys=robot) as publisher,
        Subscriber(publisher.endpoint, POSE_RAW, keys=robot, name="own") as own,
        Subscriber(publisher.endpoint, POSE_RAW, keys=guest, name="guest") as put_out,
    ):
        assert publisher.wait_for_subscribers(["own", "guest"], timeout_s=SOON_S)
        (directory / "clients" / "late.key").write_text((key_directories[2] / "own.key").read_text())
        with Subscriber(publisher.endpoint, POSE_RAW, keys=late, name="late") as added:
            assert publisher.wait_for_subscribers(["late"], timeout_s=SOON_S)
            publisher.check()
            assert publisher.subscribers == {"own", "guest", "late"}
            (directory / "clients" / "guest.key").unlink()
            publisher.publish(POSE_RAW, raw(6))
            assert publisher.refused["revoked keys"] == 1
            for subscriber in (own, added, put_out):
                assert subscriber.receive(NEVER_S) is None  # ZeroMQ subscribes again when it looks for messages
            wait_until(lambda: publisher.subscribers == {"own", "late"})
            publisher.publish(POSE_RAW, raw(7))
            assert own.receive(SOON_S) == (POSE_RAW, raw(7))
            assert put_out.receive(NEVER_S) is None


def test_each_publisher_may_have_a_key_of_its_own(key_directories: tuple[Path, ...]):
    robot, guest, _ = key_directories
    (guest / "server.key").unlink()
    (guest / "servers").mkdir()
    (guest / "servers" / "127.0.0.1.key").write_text((robot / "own.key").read_text())
    with Publisher("tcp://127.0.0.1:*", keys=load_keys(robot)) as publisher:
        with Subscriber(publisher.endpoint, POSE_RAW, keys=load_keys(guest), name="guest"):
            assert publisher.wait_for_subscribers(["guest"], timeout_s=SOON_S)
        with pytest.raises(TransportError, match=r"servers/192\.0\.2\.7\.key, got none"):
            Subscriber("tcp://192.0.2.7:1", POSE_RAW, keys=load_keys(guest))


def test_a_subscriber_with_keys_does_not_trust_an_impostor(key_directories: tuple[Path, ...]):
    _, guest, stranger = (load_keys(directory) for directory in key_directories)
    shutil.copy(guest.directory / "own.key", stranger.directory / "clients/guest.key")
    with (
        Publisher("tcp://127.0.0.1:*", keys=stranger) as publisher,
        Subscriber(publisher.endpoint, POSE_RAW, keys=guest, name="guest"),
    ):
        assert not publisher.wait_for_subscribers(["guest"], timeout_s=NEVER_S)


def test_a_source_has_one_publisher(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    paths = [f"ipc://{tmp_path}/{n}" for n in range(2)]
    with (
        Publisher(paths[0]) as first,
        Publisher(paths[1]) as second,
        Subscriber(paths, POSE_RAW, name="test") as subscriber,
    ):
        for publisher in (first, second):
            assert publisher.wait_for_subscribers(["test"], timeout_s=SOON_S)
        for stamp in range(10):
            first.publish(POSE_RAW, raw(stamp))
            assert subscriber.receive(SOON_S) == (POSE_RAW, raw(stamp))
            second.publish(POSE_RAW, raw(5_000_000 + stamp))
        assert subscriber.receive(NEVER_S) is None
        assert subscriber.refused == {"second publisher": 10}
        second.publish(POSE_RAW, dataclasses.replace(raw(1), source="another"))
        assert subscriber.receive(SOON_S), "under a name of its own it is heard"
        monkeypatch.setattr(delivery, "AWAY_S", 0.0)
        second.publish(POSE_RAW, raw(2))
        assert subscriber.receive(SOON_S) == (POSE_RAW, raw(2)), "the first is gone"


def test_subscribers_of_one_program_agree_on_whose_a_source_is(tmp_path: Path):
    paths, agreed = [f"ipc://{tmp_path}/{n}" for n in range(2)], delivery.Principals()
    with (
        Publisher(paths[0]) as owner,
        Publisher(paths[1]) as other,
        Subscriber(paths[0], POSE_RAW, name="test", principals=agreed) as near,
        Subscriber(paths[1], POSE_RAW, name="test", principals=agreed) as far,
    ):
        for publisher in (owner, other):
            assert publisher.wait_for_subscribers(["test"], timeout_s=SOON_S)
            publisher.publish(POSE_RAW, raw(1))
            assert near.receive(SOON_S if publisher is owner else 0) or publisher is other
        assert far.receive(NEVER_S) is None
        assert far.refused == {"second publisher": 1}


def test_a_tcp_address_of_this_machine_is_for_this_user_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def as_user(name: str) -> None:
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / name))
        (tmp_path / name).mkdir(exist_ok=True)

    as_user("me")
    with Publisher("tcp://127.0.0.1:*") as publisher, Subscriber(publisher.endpoint, POSE_RAW, name="mine") as mine:
        assert publisher.wait_for_subscribers(["mine"], timeout_s=SOON_S)
        as_user("you")
        with (
            Subscriber(publisher.endpoint, POSE_RAW, name="yours") as yours,
            Subscriber(publisher.endpoint, POSE_RAW, name="plain", clear_text=True) as plain,
        ):
            publisher.publish(POSE_RAW, raw(1))
            assert mine.receive(SOON_S) == (POSE_RAW, raw(1))
            for stranger in (yours, plain):
                assert stranger.receive(NEVER_S) is None
            assert publisher.subscribers == {"mine"}
    assert stat.S_IMODE((tmp_path / "me" / "steadypose" / "loopback" / "own.key_secret").stat().st_mode) == 0o600
