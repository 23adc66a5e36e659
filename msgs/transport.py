"""Messages between processes: ZeroMQ PUB/SUB over ipc on one machine and tcp across machines.

A publisher binds, subscribers connect, in any order; either may go and come back. One ZeroMQ frame is one message:

    topic, UTF-8 | 0 | version, uint8 | publisher, uint32 | sequence, uint32 | CDR

with little-endian integers. The publisher draws its number when it starts and counts its messages per topic, so
that a subscriber knows what it missed. Sockets are not thread-safe: use each in the thread that made it.
"""

from __future__ import annotations

import ipaddress
import math
import os
import socket as posix
import struct
import tempfile
import time
from collections import Counter, OrderedDict
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import zmq

from steadypose.msgs.codec import DecodeError, decode, encode, typestore
from steadypose.msgs.keys import Keys
from steadypose.msgs.topics import TOPICS, check_topic
from steadypose.msgs.types import Message

if TYPE_CHECKING:
    from typing_extensions import Self
    from zmq.auth.thread import ThreadAuthenticator

VERSION = 1
MAX_FRAME = 2**20
"""bytes; 100 people with 100 joints each are 160 kB"""
SEND_HIGH_WATER = 1000
"""messages held for each subscriber that does not keep up"""
HIGH_WATER = 1000
"""messages a subscriber holds unread, unless it says otherwise"""
LINGER_MS = 1000
"""how long `Publisher.close` waits for what is on its way"""

_PREFIX = struct.Struct("<BII")
# A subscriber sends its name as a subscription to what nobody publishes: no topic begins with this byte. It is also
# the last in order, and ZeroMQ subscribes in that order: whose name has arrived gets its topics.
_NAME = b"\xff"
_PUBLISHERS = 256
_FAILED_HANDSHAKES = (
    zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
)


class TransportError(ValueError):
    """An address that cannot, or must not, be used. The text says what to do."""


class Publisher:
    """Publishes messages at an address. A context manager.

    `publish` never waits: a subscriber that does not read loses what exceeds `SEND_HIGH_WATER`, and sees so from
    the sequence numbers. With `lossless` it waits instead, for as long as `publish` says, until the slowest
    subscriber has room.
    """

    def __init__(self, endpoint: str, *, keys: Keys | None = None, lossless: bool = False) -> None:
        """Bind `endpoint`: `ipc://` and a path, or `tcp://` and an address of this machine and a port.

        Raises:
            TransportError: if the address is malformed, in use, or reachable from outside and `keys` is None.
        """
        transport, host = _parse(endpoint)
        if transport == "tcp" and keys is None and not _is_loopback(host):
            raise TransportError(
                f"{endpoint} can be reached from other machines: expected keys, got none; "
                "make them with `steadypose keys`, or bind tcp://127.0.0.1"
            )
        typestore()
        self._sequence: Counter[str] = Counter()
        self._subscribers: set[str] = set()
        self._id = int.from_bytes(os.urandom(4), "little")
        self._lossless = lossless
        self._context = zmq.Context()
        self._authenticator = _authenticate(self._context, keys) if keys else None
        # XPUB, not PUB, because it receives the subscriptions
        self._socket = self._context.socket(zmq.XPUB)
        self._socket.setsockopt(zmq.XPUB_NODROP, lossless)
        self._socket.setsockopt(zmq.SNDHWM, SEND_HIGH_WATER)
        self._socket.setsockopt(zmq.LINGER, LINGER_MS)
        self._socket.setsockopt(zmq.MAXMSGSIZE, 1024)
        self._socket.setsockopt(zmq.IPV6, ":" in host)
        if keys:
            self._socket.curve_server = True
            self._socket.curve_secretkey = keys.secret
            self._socket.curve_publickey = keys.public
        try:
            if transport == "ipc":
                _refuse_used(endpoint)
            self._socket.bind(endpoint)
        except zmq.ZMQError as error:
            self.close()
            raise TransportError(f"cannot publish at {endpoint}: {error.strerror}") from error
        except TransportError:
            self.close()
            raise
        self.endpoint: str = self._socket.get_string(zmq.LAST_ENDPOINT)
        """as bound: a port given as `*` is a number here"""

    def publish(self, topic: str, message: Message, timeout_s: float = math.inf) -> bool:
        """Send a message to all who subscribe to its topic.

        Args:
            timeout_s: how long to wait if the publisher is lossless and a subscriber has no room.

        Returns:
            whether it was sent; False only if it was waited for in vain, and then nobody got it.

        Raises:
            ValueError: if the message is not of the topic's type, or encodes to more than `MAX_FRAME` bytes.
        """
        check_topic(topic, message)
        frame = topic.encode() + b"\0" + _PREFIX.pack(VERSION, self._id, self._sequence[topic]) + encode(message)
        if len(frame) > MAX_FRAME:
            raise ValueError(f"{topic}: expected a message of at most {MAX_FRAME} bytes, got {len(frame)}")
        self._note_subscriptions()
        if self._lossless:
            self._socket.sndtimeo = _milliseconds(timeout_s)
        try:
            self._socket.send(frame)
        except zmq.Again:
            return False
        self._sequence[topic] = (self._sequence[topic] + 1) % 2**32
        return True

    @property
    def subscribers(self) -> frozenset[str]:
        """The names of the subscribers that are connected and get what is published from now on."""
        self._note_subscriptions()
        return frozenset(self._subscribers)

    def wait_for_subscribers(self, names: Iterable[str], *, timeout_s: float) -> bool:
        """Wait until the subscribers of these names are there; False if `timeout_s` passed before."""
        wanted = frozenset(names)
        deadline = time.monotonic() + timeout_s
        while not wanted <= self.subscribers:
            left = deadline - time.monotonic()
            if left <= 0:
                return False
            self._socket.poll(_milliseconds(left))
        return True

    def _note_subscriptions(self) -> None:
        while True:
            try:
                frame = self._socket.recv(zmq.NOBLOCK)
            except zmq.Again:
                return
            change, prefix = frame[:1], frame[1:]
            if prefix.startswith(_NAME):
                name = prefix.removeprefix(_NAME).decode(errors="replace")
                if change == b"\1":
                    self._subscribers.add(name)
                elif change == b"\0":
                    self._subscribers.discard(name)

    def close(self) -> None:
        """Stop, once what was published is on its way, or after `LINGER_MS`."""
        self._socket.close()
        if self._authenticator:
            self._authenticator.stop()
        self._context.term()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


class Subscriber:
    """Receives messages from publishers. A context manager.

    What cannot be used is counted, never raised: `dropped` counts by topic the messages that were published and
    did not arrive (or, with `conflate`, were overtaken), `refused` by cause the frames that were not messages.
    """

    def __init__(
        self,
        endpoints: str | Iterable[str],
        topics: str | Iterable[str],
        *,
        conflate: bool = False,
        high_water: int = HIGH_WATER,
        keys: Keys | None = None,
        name: str = "",
    ) -> None:
        """Connect to `endpoints`, now or as soon as a publisher is there, and subscribe to `topics`.

        Args:
            conflate: keep the newest message alone: for a picture or a control loop that wants the state, not the
                history. For one topic and without a name, because ZeroMQ then keeps one message of each publisher,
                and one subscription to it; open a subscriber for each topic.
            high_water: messages held unread, beyond which the newest are lost; 0 holds all there is memory for.
            keys: for publishers that have them.
            name: what `Publisher.subscribers` calls this subscriber; without one it is not among them.

        Raises:
            TransportError: if an address is malformed.
            ValueError: if a topic does not exist, or for `conflate` with several topics or a name.
        """
        endpoints = [endpoints] if isinstance(endpoints, str) else list(endpoints)
        topics = [topics] if isinstance(topics, str) else list(topics)
        for topic in topics:
            if topic not in TOPICS:
                raise ValueError(f"topic: expected one of {', '.join(TOPICS)}, got {topic!r}")
        if conflate and (len(topics) != 1 or name):
            raise ValueError(f"conflate: expected one topic and no name, got {topics} and {name!r}")
        for endpoint in endpoints:
            _parse(endpoint)
        typestore()
        self.dropped: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self._expected: OrderedDict[tuple[int, str], int] = OrderedDict()
        self._context = zmq.Context()
        self.socket = self._context.socket(zmq.SUB)
        """for a `zmq.Poller`; read it with `receive` alone"""
        self.socket.setsockopt(zmq.CONFLATE, conflate)
        self.socket.setsockopt(zmq.RCVHWM, high_water)
        self.socket.setsockopt(zmq.MAXMSGSIZE, MAX_FRAME)
        self.socket.setsockopt(zmq.LINGER, 0)
        # A publisher whose machine vanished is noticed in 15 s, and connected to again when it is back. Not by
        # ZeroMQ's heartbeats: they abort the process of a subscriber that is behind (libzmq issue 3937).
        self.socket.setsockopt(zmq.TCP_KEEPALIVE, 1)
        self.socket.setsockopt(zmq.TCP_KEEPALIVE_IDLE, 5)
        self.socket.setsockopt(zmq.TCP_KEEPALIVE_INTVL, 5)
        self.socket.setsockopt(zmq.TCP_KEEPALIVE_CNT, 2)
        if keys:
            self.socket.curve_publickey = keys.public
            self.socket.curve_secretkey = keys.secret
            self.socket.curve_serverkey = keys.server
        self._monitor = self.socket.get_monitor_socket(_FAILED_HANDSHAKES)
        try:
            for topic in topics:
                self.socket.setsockopt(zmq.SUBSCRIBE, topic.encode() + b"\0")
            if name:
                self.socket.setsockopt(zmq.SUBSCRIBE, _NAME + name.encode())
            for endpoint in endpoints:
                self.socket.setsockopt(zmq.IPV6, "[" in endpoint)
                self.socket.connect(endpoint)
        except zmq.ZMQError as error:
            self.close()
            raise TransportError(f"cannot subscribe at {', '.join(endpoints)}: {error.strerror}") from error

    def receive(self, timeout_s: float) -> tuple[str, Message] | None:
        """The next message and its topic, or None if none came in `timeout_s`."""
        deadline = time.monotonic() + timeout_s
        while True:
            left = max(0.0, deadline - time.monotonic())
            if not self.socket.poll(_milliseconds(left)):
                self._note_handshakes()
                return None
            parts = self.socket.recv_multipart()
            received = self._read(parts[0]) if len(parts) == 1 else self._refuse("multipart")
            if received or left == 0:
                return received

    def _read(self, frame: bytes) -> tuple[str, Message] | None:
        end = frame.find(b"\0")
        if end < 0 or len(frame) < end + 1 + _PREFIX.size:
            return self._refuse("malformed")
        topic = frame[:end].decode(errors="replace")
        version, publisher, sequence = _PREFIX.unpack_from(frame, end + 1)
        if topic not in TOPICS:
            return self._refuse("unknown topic")
        if version != VERSION:
            return self._refuse("version")
        if not self._count(publisher, topic, sequence):
            return self._refuse("repeated")
        try:
            return topic, decode(topic, memoryview(frame)[end + 1 + _PREFIX.size :])
        except DecodeError:
            return self._refuse("undecodable")

    def _count(self, publisher: int, topic: str, sequence: int) -> bool:
        """Count what is missing before `sequence`; False if it is no later than what came before."""
        missed = (sequence - self._expected.get((publisher, topic), sequence)) % 2**32
        if missed >= 2**31:
            return False
        if missed:
            self.dropped[topic] += missed
        self._expected[publisher, topic] = (sequence + 1) % 2**32
        self._expected.move_to_end((publisher, topic))
        if len(self._expected) > _PUBLISHERS:
            self._expected.popitem(last=False)
        return True

    def _refuse(self, cause: str) -> None:
        self.refused[cause] += 1

    def _note_handshakes(self) -> None:
        while self._monitor.poll(0):
            self._monitor.recv_multipart()
            self._refuse("handshake")

    def close(self) -> None:
        self.socket.disable_monitor()
        self._monitor.close(0)
        self.socket.close()
        self._context.term()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


def local_directory() -> Path:
    """Where ipc sockets live unless a launch file says otherwise: private to the user, gone after a reboot."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    return Path(runtime) / "steadypose" if runtime else Path(tempfile.gettempdir()) / f"steadypose-{os.getuid()}"


def local_address(node: str) -> str:
    """Where ``node`` (``pose_input``, ``prior``, ``trajectory``) publishes unless a launch file says otherwise."""
    return f"ipc://{local_directory() / node}"


def _milliseconds(seconds: float) -> int:
    return -1 if math.isinf(seconds) else math.ceil(seconds * 1000)


def _parse(endpoint: str) -> tuple[str, str]:
    transport, _, address = endpoint.partition("://")
    host, _, port = address.rpartition(":")
    if (transport == "ipc" and address) or (transport == "tcp" and host and (port.isdecimal() or port == "*")):
        return transport, host.strip("[]")
    raise TransportError(f"address: expected ipc://PATH or tcp://HOST:PORT, got {endpoint!r}")


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _refuse_used(endpoint: str) -> None:
    # ZeroMQ would take the path from a publisher that is still there, and neither would notice
    with posix.socket(posix.AF_UNIX) as probe:
        try:
            probe.connect(endpoint.removeprefix("ipc://"))
        except OSError:
            return
    raise TransportError(f"cannot publish at {endpoint}: another publisher is there; stop it or choose another path")


def _authenticate(context: zmq.Context[zmq.Socket[bytes]], keys: Keys) -> ThreadAuthenticator:
    from zmq.auth.thread import ThreadAuthenticator  # brings asyncio, which nobody else here needs

    class KeyList:
        def callback(self, domain: str, key: bytes) -> bool:
            return key in keys.clients

    authenticator = ThreadAuthenticator(context)
    authenticator.start()
    authenticator.configure_curve_callback("*", KeyList())
    return authenticator
