"""Publishing messages at an address."""

from __future__ import annotations

import errno
import math
import os
import socket as posix
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import zmq

from steadypose.msgs import Closing
from steadypose.msgs.codec import check_size, encode, typestore
from steadypose.msgs.delivery import MAX_FRAME, PREFIX, VERSION, Deliveries, Listener, read_subscription, read_taken
from steadypose.msgs.security import (
    ClientList,
    Keys,
    TransportError,
    is_local,
    loopback_keys,
    make_private,
    parse,
    refuse_used,
)
from steadypose.msgs.topics import TOPICS, check_topic
from steadypose.msgs.types import Message

if TYPE_CHECKING:
    from zmq.auth.thread import ThreadAuthenticator

SEND_HIGH_WATER = 1000
"""messages held for each subscriber that does not keep up"""
LINGER_MS = 1000
"""how long `Publisher.close` waits for what is on its way"""
MAX_SUBSCRIPTIONS = 4096
"""different ones, of all subscribers together; who goes beyond is disconnected"""
MAX_NEW_SUBSCRIPTIONS = 256
"""of one connection in a second"""
REBIND_S = 5.0
"""how long to wait for an address of our own: ZeroMQ gives it back in a thread, soon after the socket was closed"""

_LOOK_S = 1.0
"""between two looks at who is waited for"""
_CUT = "subscriptions"
_DOMAIN = "steadypose"


class Resume(NamedTuple):
    """Where a publisher ended that another one continues."""

    id: int
    """its number, uint32"""
    sequence: Mapping[str, int]
    """of each topic, the sequence of the first message that not all reliable subscribers had taken"""


class Publisher(Closing):
    """Publishes messages at an address. A context manager.

    `publish` waits only for subscribers that are named in `reliable` and request it; any other that does not read loses
    what exceeds `SEND_HIGH_WATER`, and detects that by the sequence numbers.

    Attributes:
        endpoint: as bound: a port given as `*` is a number here.
        refused: connections that were closed, by cause.
    """

    def __init__(
        self,
        endpoint: str,
        *,
        keys: Keys | None = None,
        reliable: Collection[str] = (),
        clear_text: bool = False,
        resume: Resume | None = None,
    ) -> None:
        """Bind `endpoint`: `ipc://` and a path, or `tcp://` and an address of this machine and a port.

        Args:
            keys: whose holders may subscribe; the list is reread while this runs. A tcp address of this machine without
                keys is for programs of this user alone, which find `keys.loopback_keys`.
            reliable: names of the subscribers to wait for.
            clear_text: whether a tcp address may do without keys, for whoever can reach it.
            resume: the publisher of this address that was there before, whose messages are counted on: who has some of
                them already takes no notice.

        Raises:
            TransportError: if the address is malformed, in use, or reachable from outside and `keys` is None.
        """
        transport, host = parse(endpoint)
        if keys is None and not clear_text and not is_local(endpoint):
            raise TransportError(
                f"{endpoint} can be reached from other machines: expected keys, got none; "
                "make them with `steadypose keys`, or bind tcp://127.0.0.1"
            )
        if keys is None and transport == "tcp" and not clear_text:
            keys = loopback_keys()
        typestore()
        self.refused: Counter[str] = Counter()
        self._keys = keys
        self._clients = ClientList(keys) if keys else None
        self._deliveries = Deliveries(reliable, resume.sequence if resume else {})
        self._listeners: set[Listener] = set()
        self._subscriptions: set[bytes] = set()
        self._new_subscriptions: Counter[int] = Counter()
        self._new_since = time.monotonic()
        self.id = resume.id if resume else int.from_bytes(os.urandom(4), "little")
        """of the topics that a publisher of this address may resume; drawn at random"""
        self._new_id = int.from_bytes(os.urandom(4), "little")  # what is not resumed is not to be taken for repeated
        self._resumed = frozenset(resume.sequence) if resume else frozenset(TOPICS)
        self._context = zmq.Context()
        self._authenticator = _authenticate(self._context, self._clients) if self._clients else None
        try:
            if transport == "ipc":
                make_private(Path(host).parent)
                refuse_used(Path(host))
            self._socket = self._bind(endpoint)
        except zmq.ZMQError as error:
            self._end()
            raise TransportError(f"cannot publish at {endpoint}: {error.strerror}") from error
        except TransportError:
            self._end()
            raise
        self.endpoint: str = self._socket.get_string(zmq.LAST_ENDPOINT)

    def _bind(self, endpoint: str) -> zmq.Socket[bytes]:
        # XPUB, not PUB, because it receives the subscriptions
        socket = self._context.socket(zmq.XPUB)
        try:
            socket.setsockopt(zmq.SNDHWM, SEND_HIGH_WATER)
            socket.setsockopt(zmq.LINGER, LINGER_MS)
            socket.setsockopt(zmq.MAXMSGSIZE, 1024)
            socket.setsockopt(zmq.IPV6, "[" in endpoint)
            # a subscriber whose machine vanished is noticed in 15 s
            for option, value in KEEPALIVE.items():
                socket.setsockopt(option, value)
            if self._keys:
                socket.curve_server = True
                socket.curve_secretkey = self._keys.secret
                socket.curve_publickey = self._keys.public
                # without this, whoever comes while nobody checks keys is let in
                socket.setsockopt(zmq.ZAP_DOMAIN, _DOMAIN.encode())
                socket.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)
            socket.bind(endpoint)
        except zmq.ZMQError:
            socket.close(0)
            raise
        return socket

    def publish(self, topic: str, message: Message, timeout_s: float = math.inf) -> bool:
        """Send a message to all who subscribe to its topic.

        Args:
            timeout_s: how long to wait for a reliable subscriber that is behind.

        Returns:
            whether it was sent; False if a reliable subscriber stayed behind, and then no subscriber got it.

        Raises:
            ValueError: if the message is not of the topic's type, encodes to more than `MAX_FRAME` bytes, or holds more
                than `msgs.codec` allows.
        """
        check_topic(topic, message)
        payload = encode(message)
        check_size(topic, payload)
        size = len(topic) + 1 + PREFIX.size + len(payload)
        if size > MAX_FRAME:
            raise ValueError(f"{topic}: expected a message of at most {MAX_FRAME} bytes, got {size}")
        if not self._wait(lambda: not self._deliveries.waited_for(topic), timeout_s):
            return False
        id, sequence = self._id_of(topic), self._deliveries.sequence[topic]
        frame = topic.encode() + b"\0" + PREFIX.pack(VERSION, id, sequence, time.monotonic_ns()) + payload
        self._socket.send(frame)
        self._deliveries.sent(topic, frame)
        return True

    def _id_of(self, topic: str) -> int:
        return self.id if topic in self._resumed else self._new_id

    def sequence(self, topic: str) -> int:
        """Of the next message of a topic."""
        return self._deliveries.sequence[topic]

    def waited_for(self, topic: str) -> frozenset[str]:
        """The names of the reliable subscribers for whom the next message of a topic waits."""
        return self._deliveries.waited_for(topic)

    def silent(self, for_s: float) -> frozenset[str]:
        """The names of reliable subscribers that have not read for so long, though there is something to read."""
        return self._deliveries.silent(for_s)

    def is_taken(self, topic: str, sequence: int, timeout_s: float = 0.0) -> bool:
        """Whether all reliable subscribers of a topic have taken a message; waits until they have, or for so long."""
        return self._wait(lambda: self._deliveries.is_taken(topic, sequence), timeout_s)

    @property
    def subscribers(self) -> frozenset[str]:
        """The names of the subscribers that are connected and get what is published from now on."""
        self._note_subscribers()
        return frozenset(listener.name for listener in self._listeners)

    def wait_for_subscribers(self, names: Iterable[str], *, timeout_s: float) -> bool:
        """Wait until the subscribers of these names are there; False if `timeout_s` passed before."""
        wanted = frozenset(names)
        return self._wait(lambda: wanted <= {listener.name for listener in self._listeners}, timeout_s)

    def _wait(self, until: Callable[[], bool], timeout_s: float) -> bool:
        """Take what subscribers say until a condition holds; False if it does not in time."""
        deadline = time.monotonic() + timeout_s
        while True:
            self._note_subscribers()
            if until():
                return True
            left = deadline - time.monotonic()
            if left <= 0:
                return False
            self._socket.poll(milliseconds(min(left, _LOOK_S)))

    def check(self) -> None:
        """Enforce the list of keys; to be called about once a second.

        If a key was removed since the last call, or a flood of subscriptions got past `_note_new`, all connections are
        closed; permitted subscribers reconnect.

        Raises:
            RuntimeError: keys are no longer checked, and no new subscriber is accepted: make another publisher.
            TransportError: the address was taken by another process meanwhile.
        """
        self._note_subscribers()
        if self._authenticator and not self._authenticator.is_alive():
            raise RuntimeError("the thread that checks keys has ended; nobody is let in any more")
        if self._clients and self._clients.revoked():
            self._begin_anew("revoked keys")
        if len(self._subscriptions) > 2 * MAX_SUBSCRIPTIONS:
            self._begin_anew(_CUT)

    def _begin_anew(self, cause: str) -> None:
        """Disconnect all subscribers; permitted ones reconnect."""
        self.refused[cause] += 1
        self._socket.close(0)
        self._listeners.clear()
        self._deliveries.leave_all()
        self._subscriptions.clear()
        deadline = time.monotonic() + REBIND_S
        while True:
            try:
                self._socket = self._bind(self.endpoint)
                return
            except zmq.ZMQError as error:
                if error.errno != errno.EADDRINUSE or time.monotonic() > deadline:
                    raise TransportError(f"cannot publish at {self.endpoint} again: {error.strerror}") from error
            time.sleep(0.01)

    def _note_subscribers(self) -> None:
        for _ in range(SEND_HIGH_WATER):  # whoever floods this is not to keep it from publishing
            try:
                received = self._socket.recv(zmq.NOBLOCK, copy=False)
            except zmq.Again:
                return
            frame = received.bytes
            if frame[:1] == b"\1":
                self._note_subscription(frame[1:], received)
            elif frame[:1] == b"\0":
                self._subscriptions.discard(frame[1:])
                if listener := read_subscription(frame[1:]):
                    self._listeners.discard(listener)
                    self._deliveries.leave(listener)
            elif taken := read_taken(frame, TOPICS):
                if taken.publisher == self._id_of(taken.topic):
                    self._deliveries.take(taken)
            else:
                self._note_new(received)

    def _note_subscription(self, prefix: bytes, received: zmq.Frame) -> None:
        self._subscriptions.add(prefix)
        self._note_new(received)
        if listener := read_subscription(prefix):
            self._listeners.add(listener)
            for frame in self._deliveries.join(listener):
                self._socket.send(prefix + b"\0" + frame)

    def _note_new(self, received: zmq.Frame) -> None:
        """Count what a connection asks for, and close one that asks for too much."""
        now = time.monotonic()
        if now - self._new_since > 1.0:
            self._new_subscriptions.clear()
            self._new_since = now
        try:
            connection = int(received.get(zmq.SRCFD))  # type: ignore[arg-type]
        except (
            zmq.ZMQError
        ):  # who speaks the first version of the protocol cannot be distinguished from others; see `check`
            return
        self._new_subscriptions[connection] += 1
        too_many = len(self._subscriptions) > MAX_SUBSCRIPTIONS
        if too_many or self._new_subscriptions[connection] == MAX_NEW_SUBSCRIPTIONS:
            self.refused[_CUT] += 1
            with suppress(OSError), posix.socket(fileno=os.dup(connection)) as end:
                end.shutdown(posix.SHUT_RDWR)  # ZeroMQ sees it leave, and forgets what it asked for

    def close(self) -> None:
        """Stop, once what was published is on its way, or after `LINGER_MS`."""
        self._socket.close()
        self._end()

    def _end(self) -> None:
        if self._authenticator:
            self._authenticator.stop()
        self._context.term()


KEEPALIVE = {
    zmq.TCP_KEEPALIVE: 1,
    zmq.TCP_KEEPALIVE_IDLE: 5,
    zmq.TCP_KEEPALIVE_INTVL: 5,
    zmq.TCP_KEEPALIVE_CNT: 2,
}
"""so that whose machine vanished is noticed in 15 s. Not by ZeroMQ's heartbeats: they abort the process of a subscriber
that is behind (libzmq issue 3937)."""


def milliseconds(seconds: float) -> int:
    """For ZeroMQ; -1 is for ever."""
    return -1 if math.isinf(seconds) else math.ceil(seconds * 1000)


def _authenticate(context: zmq.Context[zmq.Socket[bytes]], clients: ClientList) -> ThreadAuthenticator:
    from zmq.auth.thread import ThreadAuthenticator  # brings asyncio, which nobody else here needs

    class KeyList:
        def callback(self, domain: str, key: bytes) -> bool:
            return clients.allows(key)

    authenticator = ThreadAuthenticator(context)
    authenticator.start()
    authenticator.configure_curve_callback(_DOMAIN, KeyList())
    return authenticator
