"""The publisher: sends messages at an address."""

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
from steadypose.msgs.security import Keys, TransportError, is_local, loopback_keys, make_private, parse, refuse_used
from steadypose.msgs.topics import TOPICS, check_topic
from steadypose.msgs.types import Message

if TYPE_CHECKING:
    from zmq.auth.thread import ThreadAuthenticator

SEND_HIGH_WATER = 1000
"""Largest number of messages queued for a subscriber that does not keep up (ZeroMQ's high-water mark)."""
LINGER_MS = 1000
"""Longest time that `Publisher.close` waits for messages in flight, milliseconds."""
MAX_SUBSCRIPTIONS = 4096
"""Largest number of different subscriptions of all subscribers together. A connection that exceeds it is closed."""
MAX_NEW_SUBSCRIPTIONS = 256
"""Number of new subscriptions in a second at which a connection is closed."""
REBIND_S = 5.0
"""Longest time to wait for our own address, seconds. ZeroMQ releases it in a thread, soon after the socket closes."""
CHECK_S = 1.0
"""Interval between two enforcements of the list of keys while messages are published, seconds."""
_LOOK_S = 1.0
"""Interval between checks whether a subscriber still has to be waited for, seconds."""
_CUT = "subscriptions"
_DOMAIN = "steadypose"


class Resume(NamedTuple):
    """State of a stopped publisher, from which its successor continues."""

    id: int
    """the publisher's number, uint32"""
    sequence: Mapping[str, int]
    """by topic, the sequence number of the first message that not all reliable subscribers had acknowledged"""


class Publisher(Closing):
    """Publishes messages at an address. A context manager.

    `publish` waits only for subscribers that are named in `reliable` and request it. Any other subscriber that does not
    read loses the messages beyond `SEND_HIGH_WATER`, and detects the loss by sequence numbers.

    Attributes:
        endpoint: the bound address; a port given as `*` is replaced by its number.
        deliveries: what its reliable subscribers have acknowledged.
        refused: number of connections closed by the publisher, by cause.
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
        """Bind `endpoint`.

        Args:
            endpoint: `ipc://PATH`, or `tcp://HOST:PORT` with an address of this machine.
            keys: keys whose holders may subscribe; the list of clients is reread while this runs. Without keys, a tcp
                address of this machine is open to this user's programs only, by `security.loopback_keys`.
            reliable: names of the subscribers to wait for.
            clear_text: whether a tcp address may do without keys, and is open to anyone who can reach it.
            resume: state of this address's previous publisher, whose sequence numbers are continued. Subscribers ignore
                messages that they already have.

        Raises:
            TransportError: the address is malformed, in use, or reachable from outside while `keys` is None.
        """
        transport, host = parse(endpoint)
        if keys is None and not clear_text and not is_local(endpoint):
            remedy = "make them with `steadypose keys`, or bind tcp://127.0.0.1"
            raise TransportError(f"{endpoint} can be reached from other machines: expected keys, got none; {remedy}")
        if keys is None and transport == "tcp" and not clear_text:
            keys = loopback_keys()
        typestore()
        self.refused: Counter[str] = Counter()
        self._keys = keys
        self._clients = keys.clients() if keys else set()
        self.deliveries = Deliveries(reliable, resume.sequence if resume else {})
        self._listeners: set[Listener] = set()
        self._subscriptions: set[bytes] = set()
        self._new_subscriptions: Counter[int] = Counter()
        self._new_since = self._checked_at = time.monotonic()
        self.id = resume.id if resume else int.from_bytes(os.urandom(4), "little")
        """random number that identifies this publisher on the resumed topics (all topics, if nothing is resumed)"""
        self._new_id = int.from_bytes(os.urandom(4), "little")  # so that topics not resumed do not look like repeats
        self._resumed = frozenset(resume.sequence) if resume else frozenset(TOPICS)
        self._context = zmq.Context()
        self._authenticator = _authenticate(self._context, keys) if keys else None
        try:
            if transport == "ipc":
                make_private(Path(host).parent)
                refuse_used(Path(host))
            self._socket = self._bind(endpoint)
        except (zmq.ZMQError, TransportError) as error:
            self._end()
            if isinstance(error, TransportError):
                raise
            raise TransportError(f"cannot publish at {endpoint}: {error.strerror}") from error
        self.endpoint: str = self._socket.get_string(zmq.LAST_ENDPOINT)

    def _bind(self, endpoint: str) -> zmq.Socket[bytes]:
        # XPUB, unlike PUB, receives the subscriptions
        socket = self._context.socket(zmq.XPUB)
        try:
            limits = {zmq.SNDHWM: SEND_HIGH_WATER, zmq.LINGER: LINGER_MS, zmq.MAXMSGSIZE: 1024}
            for option, value in (KEEPALIVE | limits | {zmq.IPV6: "[" in endpoint}).items():
                socket.setsockopt(option, value)
            if self._keys:
                socket.curve_server = True
                socket.curve_secretkey = self._keys.secret
                socket.curve_publickey = self._keys.public
                # without this, a connection made while no thread checks keys would be accepted
                socket.setsockopt(zmq.ZAP_DOMAIN, _DOMAIN.encode())
                socket.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)
            socket.bind(endpoint)
        except zmq.ZMQError:
            socket.close(0)
            raise
        return socket

    def publish(self, topic: str, message: Message, timeout_s: float = math.inf) -> bool:
        """Send a message to all subscribers of its topic.

        Args:
            timeout_s: longest time to wait for reliable subscribers that are behind, seconds.

        Returns:
            True if it was sent. False if a reliable subscriber stayed behind; then no subscriber received it.

        Raises:
            ValueError: the message is not of the topic's type, encodes to more than `MAX_FRAME` bytes, or holds more
                bodies, events or values than `msgs.codec` allows.
            RuntimeError, TransportError: as `check`.
        """
        if time.monotonic() - self._checked_at > CHECK_S:
            self.check()
        check_topic(topic, message)
        payload = encode(message)
        check_size(topic, payload)
        size = len(topic) + 1 + PREFIX.size + len(payload)
        if size > MAX_FRAME:
            raise ValueError(f"{topic}: expected a message of at most {MAX_FRAME} bytes, got {size}")
        if not self._wait(lambda: not self.deliveries.waited_for(topic), timeout_s):
            return False
        id, sequence = self._id_of(topic), self.deliveries.sequence[topic]
        frame = topic.encode() + b"\0" + PREFIX.pack(VERSION, id, sequence, time.monotonic_ns()) + payload
        self._socket.send(frame)
        self.deliveries.sent(topic, frame)
        return True

    def _id_of(self, topic: str) -> int:
        return self.id if topic in self._resumed else self._new_id

    def is_taken(self, topic: str, sequence: int, timeout_s: float = 0.0) -> bool:
        """Whether all reliable subscribers of a topic acknowledge a message within ``timeout_s`` seconds."""
        return self._wait(lambda: self.deliveries.is_taken(topic, sequence), timeout_s)

    @property
    def subscribers(self) -> frozenset[str]:
        """Names of the connected subscribers. They receive every message published from now on."""
        self._note_subscribers()
        return frozenset(listener.name for listener in self._listeners)

    def wait_for_subscribers(self, names: Iterable[str], *, timeout_s: float) -> bool:
        """Wait until the named subscribers are connected; False if that takes longer than `timeout_s`."""
        wanted = frozenset(names)
        return self._wait(lambda: wanted <= {listener.name for listener in self._listeners}, timeout_s)

    def _wait(self, until: Callable[[], bool], timeout_s: float) -> bool:
        """Process subscribers' frames until a condition holds; False if it does not within ``timeout_s``."""
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
        """Enforce the list of keys, as `publish` does once a second; a publisher that is silent for longer calls it.

        If a key was removed since the last call, or a flood of subscriptions was not stopped otherwise, all connections
        are closed, and permitted subscribers reconnect.

        Raises:
            RuntimeError: the thread that checks keys has ended and no new subscriber is accepted; create another
                publisher.
            TransportError: another process took the address meanwhile.
        """
        self._checked_at = time.monotonic()
        self._note_subscribers()
        if self._authenticator and not self._authenticator.is_alive():
            raise RuntimeError("the thread that checks keys has ended; nobody is let in any more")
        before, self._clients = self._clients, self._keys.clients() if self._keys else set()
        if not before <= self._clients:
            self._begin_anew("revoked keys")
        if len(self._subscriptions) > 2 * MAX_SUBSCRIPTIONS:
            self._begin_anew(_CUT)

    def _begin_anew(self, cause: str) -> None:
        """Disconnect all subscribers; permitted ones reconnect."""
        self.refused[cause] += 1
        self._socket.close(0)
        self._listeners.clear()
        self.deliveries.leave_all()
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
        for _ in range(SEND_HIGH_WATER):  # bounded, so that a flood of frames cannot block publishing
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
                    self.deliveries.leave(listener)
            elif taken := read_taken(frame, TOPICS):
                if taken.publisher == self._id_of(taken.topic):
                    self.deliveries.take(taken)
            else:
                self._note_new(received)

    def _note_subscription(self, prefix: bytes, received: zmq.Frame) -> None:
        self._subscriptions.add(prefix)
        self._note_new(received)
        if listener := read_subscription(prefix):
            self._listeners.add(listener)
            for frame in self.deliveries.join(listener):
                self._socket.send(prefix + b"\0" + frame)

    def _note_new(self, received: zmq.Frame) -> None:
        """Count a connection's subscriptions, and close a connection that has too many."""
        now = time.monotonic()
        if now - self._new_since > 1.0:
            self._new_subscriptions.clear()
            self._new_since = now
        try:
            connection = int(received.get(zmq.SRCFD))  # type: ignore[arg-type]
        except zmq.ZMQError:  # peers with version 1 of the protocol cannot be told apart; `check` limits them
            return
        self._new_subscriptions[connection] += 1
        too_many = len(self._subscriptions) > MAX_SUBSCRIPTIONS
        if too_many or self._new_subscriptions[connection] == MAX_NEW_SUBSCRIPTIONS:
            self.refused[_CUT] += 1
            with suppress(OSError), posix.socket(fileno=os.dup(connection)) as end:
                end.shutdown(posix.SHUT_RDWR)  # ZeroMQ sees it disconnect, and drops its subscriptions

    def close(self) -> None:
        """Stop once all published messages are sent, or after `LINGER_MS`."""
        self._socket.close()
        self._end()

    def _end(self) -> None:
        if self._authenticator:
            self._authenticator.stop()
        self._context.term()


KEEPALIVE = {zmq.TCP_KEEPALIVE: 1, zmq.TCP_KEEPALIVE_IDLE: 5, zmq.TCP_KEEPALIVE_INTVL: 5, zmq.TCP_KEEPALIVE_CNT: 2}
"""Socket options by which a vanished machine is detected within 15 s.

ZeroMQ's own heartbeats would abort the process of a subscriber that is behind (libzmq issue 3937)."""


def milliseconds(seconds: float) -> int:
    """A timeout for ZeroMQ, milliseconds; -1 waits forever."""
    return -1 if math.isinf(seconds) else math.ceil(seconds * 1000)


def _authenticate(context: zmq.Context[zmq.Socket[bytes]], keys: Keys) -> ThreadAuthenticator:
    from zmq.auth.thread import ThreadAuthenticator  # imported late: it imports asyncio, which nothing else needs

    class KeyList:
        def callback(self, domain: str, key: bytes) -> bool:
            return key in keys.clients()

    authenticator = ThreadAuthenticator(context)
    authenticator.start()
    authenticator.configure_curve_callback(_DOMAIN, KeyList())
    return authenticator
