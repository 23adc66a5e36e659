"""The subscriber: receives messages from publishers."""

import math
import os
import struct
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import zmq

from steadypose.msgs import Closing
from steadypose.msgs.codec import DecodeError, decode, typestore
from steadypose.msgs.delivery import MAX_FRAME, PREFIX, VERSION, WRAP, Listener, Principals, Taken
from steadypose.msgs.publisher import KEEPALIVE, milliseconds
from steadypose.msgs.security import Keys, TransportError, check_private, is_local, loopback_keys, parse
from steadypose.msgs.topics import TOPICS
from steadypose.msgs.types import Diagnostics, Message

HIGH_WATER = 1000
"""Default number of unread messages that a subscriber's queue holds."""
MAX_RECEIVED = 2**26
"""Largest size of a frame that ZeroMQ receives, bytes. It closes the connection on a larger one."""
DRIFT = 1e-4
"""Upper bound of the relative drift of two machines' clocks, ratio. Any crystal oscillator is better."""
REVIVE_S = 0.5
"""Time without a reconnection attempt by ZeroMQ after which a lost connection is re-established here, seconds."""
SECOND = "second publisher"
"""Cause in `Subscriber.refused` of messages whose source is bound to another publisher."""
HANDSHAKE = "handshake"
"""Cause in `Subscriber.refused` of connections that do not come about, because keys do not fit or are missing."""
_PUBLISHERS = 256
_EVENT = struct.Struct("=HI")  # an event of ZeroMQ's monitor; zmq.utils.monitor could read it, but imports asyncio
_HANDSHAKES = (
    zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
)
_RETRIES = zmq.EVENT_CONNECT_DELAYED | zmq.EVENT_CONNECT_RETRIED | zmq.EVENT_CONNECTED


class Subscriber(Closing):
    """Receives messages from publishers. A context manager.

    Unusable input is counted and raises nothing. `dropped` counts, by topic, published messages that did not arrive (or
    were replaced by newer ones, with `conflate`). `late` counts messages that arrived after their lifespan. `refused`
    counts, by cause, frames that were not valid messages.
    """

    def __init__(
        self,
        endpoints: str | Iterable[str],
        topics: str | Iterable[str],
        *,
        conflate: bool = False,
        reliable: bool = False,
        context: int = 0,
        lifespan_s: float = math.inf,
        high_water: int = HIGH_WATER,
        keys: Keys | None = None,
        clear_text: bool = False,
        name: str = "",
        principals: Principals | None = None,
    ) -> None:
        """Connect to `endpoints`, now or as soon as a publisher binds them, and subscribe to `topics`.

        Args:
            endpoints: one address or several.
            topics: one topic or several.
            conflate: whether to keep only the newest message, for a display or a control loop that needs the state
                rather than the history. It requires a single topic and no name, because ZeroMQ then keeps one message
                and one subscription per publisher; open a subscriber for each topic.
            reliable: whether to miss no pose of a publisher that names this subscriber. The publisher waits while this
                subscriber is behind, and resends the messages that its predecessor of this name had not acknowledged.
            context: number of earlier messages to be resent as well.
            lifespan_s: age since sending at which a message is dropped, seconds, so that a program that was suspended
                does not take old poses for new ones. Diagnostics and the end of a stream are never dropped for age.
            high_water: largest number of unread messages, beyond which the newest are lost; 0: unlimited.
            keys: keys for publishers that require them. A local tcp address without keys uses those of this user
                (`security.loopback_keys`).
            clear_text: whether to subscribe at a tcp address without keys.
            principals: binding of sources to publishers, to be shared by several subscribers.
            name: this subscriber's name in `Publisher.subscribers`; without one it is not listed there.

        Raises:
            TransportError: if an address is malformed, or another machine's and `keys` is None, or if others could
                publish there.
            ValueError: if a topic does not exist, for `conflate` with several topics or a name, for `reliable`
                without one.
        """
        self._endpoints = [endpoints] if isinstance(endpoints, str) else list(endpoints)
        topics = [topics] if isinstance(topics, str) else list(topics)
        if unknown := [topic for topic in topics if topic not in TOPICS]:
            raise ValueError(f"topic: expected one of {', '.join(TOPICS)}, got {unknown[0]!r}")
        if conflate and (len(topics) != 1 or name):
            raise ValueError(f"conflate: expected one topic and no name, got {topics} and {name!r}")
        if reliable and not name:
            raise ValueError("reliable: expected a name, by which publishers know whom to wait for; got none")
        if not lifespan_s > 0:
            raise ValueError(f"lifespan_s: expected more than 0, got {lifespan_s}")
        for endpoint in self._endpoints:
            _check(endpoint, keys, clear_text)
        typestore()
        self.dropped: Counter[str] = Counter()
        self.late: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self.addresses = ", ".join(self._endpoints)
        """where it subscribes, to be named in reports"""
        self._principals = principals or Principals()
        self._connection = self if len(self._endpoints) == 1 else None
        self._lifespan_ns = lifespan_s * 1e9
        self._local = all(map(is_local, self._endpoints))
        self._expected: OrderedDict[tuple[int, str], int] = OrderedDict()
        self._offsets: OrderedDict[int, tuple[int, int]] = OrderedDict()  # by publisher: clock offset, and when found
        news = [topic for topic in topics if TOPICS[topic] is Diagnostics]
        waited_for = tuple(topic for topic in topics if topic not in news) if reliable else ()
        self._listener = Listener(name, int.from_bytes(os.urandom(4), "little"), waited_for, context)
        self._for_me = self._listener.subscription() + b"\0"
        self._untaken: deque[Taken] = deque()
        self._taken: OrderedDict[tuple[int, str], Taken] = OrderedDict()
        self._lost: dict[str, float] = {}
        self._shut_out: set[str] = set()  # endpoints whose last handshake failed
        self._looked = 0.0
        self._context = zmq.Context()
        # XSUB, unlike SUB, can send acknowledgements
        self.socket = self._context.socket(zmq.XSUB if reliable else zmq.SUB)
        """socket to register in a `zmq.Poller`; read it only by `receive`"""
        limits = {zmq.RCVHWM: high_water, zmq.MAXMSGSIZE: MAX_RECEIVED, zmq.LINGER: 0}
        for option, value in (KEEPALIVE | limits | {zmq.CONFLATE: conflate}).items():
            self.socket.setsockopt(option, value)
        self._keys, self._clear_text = keys, clear_text
        self._monitor = self.socket.get_monitor_socket(_HANDSHAKES | zmq.EVENT_DISCONNECTED | _RETRIES)
        try:
            prefixes = [topic.encode() + b"\0" for topic in topics] + ([self._listener.subscription()] if name else [])
            for prefix in prefixes:
                if reliable:
                    self.socket.send(b"\1" + prefix)
                else:
                    self.socket.setsockopt(zmq.SUBSCRIBE, prefix)
            for endpoint in self._endpoints:
                self._connect(endpoint)
        except zmq.ZMQError as error:
            self.close()
            raise TransportError(f"cannot subscribe at {self.addresses}: {error.strerror}") from error
        except ValueError:
            self.close()
            raise

    def _connect(self, endpoint: str) -> None:
        self.socket.setsockopt(zmq.IPV6, "[" in endpoint)
        keys = self._keys
        if keys is None and not self._clear_text and parse(endpoint)[0] == "tcp":
            keys = loopback_keys()
        if keys:
            self.socket.curve_publickey = keys.public
            self.socket.curve_secretkey = keys.secret
            self.socket.curve_serverkey = keys.server_at(endpoint)
        else:
            self.socket.curve_server = False  # resets the keys of the address before
        self.socket.connect(endpoint)

    def receive(self, timeout_s: float, *, taken: bool = True) -> tuple[str, Message] | None:
        """The next topic and message, or None if none arrives within `timeout_s`.

        Args:
            timeout_s: longest time to wait, seconds.
            taken: whether a reliable subscriber acknowledges the message at once. If False, call `take` later.
        """
        received = self._receive(timeout_s)
        if taken and self._untaken:
            self.take(len(self._untaken))
        return received

    @property
    def pending(self) -> bool:
        """Whether frames wait to be read. `receive` with a timeout of 0 returns None for one that it refuses."""
        return bool(self.socket.poll(0))

    def arrived(self, topic: str) -> int:
        """Number of messages of a topic published up to the newest received one, including lost ones."""
        return sum(following for (_, of), following in self._expected.items() if of == topic)

    def take(self, number: int) -> None:
        """Acknowledge the oldest `number` messages to their publishers. With 0, only send a sign of life."""
        news = {(taken.publisher, taken.topic): taken for taken in (self._untaken.popleft() for _ in range(number))}
        for key, taken in news.items():
            _remember(self._taken, key, taken)
        for taken in news.values() if number else self._taken.values():
            self._send(taken)

    def _send(self, taken: Taken) -> None:
        with suppress(zmq.Again):  # a publisher that does not listen gets it again later
            self.socket.send(taken.frame(), zmq.NOBLOCK)

    def _receive(self, timeout_s: float) -> tuple[str, Message] | None:
        deadline = time.monotonic() + timeout_s
        while True:
            now = time.monotonic()
            left = max(0.0, deadline - now)
            if now - self._looked > REVIVE_S:
                self._note_connections(now)
            if not self.socket.poll(milliseconds(min(left, REVIVE_S))):
                if time.monotonic() >= deadline:
                    self._note_connections(time.monotonic())
                    return None
                continue
            parts = self.socket.recv_multipart()
            received = self._read(parts[0]) if len(parts) == 1 else self._refuse("multipart")
            if received or left == 0:
                return received

    def _read(self, frame: bytes) -> tuple[str, Message] | None:
        frame = frame.removeprefix(self._for_me)
        if len(frame) > MAX_FRAME:
            return self._refuse("too large")
        end = frame.find(b"\0")
        if end < 0 or len(frame) < end + 1 + PREFIX.size:
            return self._refuse("malformed")
        topic = frame[:end].decode(errors="replace")
        version, publisher, sequence, sent_ns = PREFIX.unpack_from(frame, end + 1)
        if topic not in TOPICS:
            return self._refuse("unknown topic")
        if version != VERSION:
            return self._refuse("version")
        if not self._count(publisher, topic, sequence):
            if known := self._taken.get((publisher, topic)):  # the publisher resumed from an older acknowledgement
                return self._send(known)
            return self._refuse("repeated")
        late = self._age_ns(publisher, sent_ns) > self._lifespan_ns
        taken = Taken(self._listener.instance, publisher, (sequence + 1) % WRAP, topic)
        try:
            message = decode(topic, memoryview(frame)[end + 1 + PREFIX.size :])
        except DecodeError:
            self._pass_over(taken)
            return self._refuse("undecodable")
        if not isinstance(message, Diagnostics) and not self._principals.admits(
            topic, message.source, publisher, self._connection, ended=message.end_of_stream
        ):
            self._pass_over(taken)
            return self._refuse(SECOND)
        if topic in self._listener.reliable:
            self._untaken.append(taken)
        if late and not isinstance(message, Diagnostics) and not message.end_of_stream:
            self.late[topic] += 1
            return None
        return topic, message

    def _pass_over(self, refused: Taken) -> None:
        """Acknowledge a refused message together with the one before it, because nothing else will acknowledge it."""
        if refused.topic not in self._listener.reliable:
            return
        for index in reversed(range(len(self._untaken))):
            taken = self._untaken[index]
            if (taken.publisher, taken.topic) == (refused.publisher, refused.topic):
                self._untaken[index] = refused
                return
        self._taken[refused.publisher, refused.topic] = refused
        self._send(refused)

    def _count(self, publisher: int, topic: str, sequence: int) -> bool:
        """Count the messages missing before `sequence`; False if it is not newer than the last one."""
        missed = (sequence - self._expected.get((publisher, topic), sequence)) % WRAP
        if missed >= WRAP // 2:
            return False
        if missed:
            self.dropped[topic] += missed
        _remember(self._expected, (publisher, topic), (sequence + 1) % WRAP)
        if topic in self._listener.reliable and (publisher, topic) not in self._taken:
            self._taken[publisher, topic] = Taken(self._listener.instance, publisher, sequence, topic)
        return True

    def _age_ns(self, publisher: int, sent_ns: int) -> int:
        """Time since a message was sent, nanoseconds.

        Processes on one machine share a monotonic clock. The offset to another machine's clock is estimated from the
        fastest message so far, whose travel time is assumed to be zero.
        """
        now = time.monotonic_ns()
        apart = now - sent_ns
        if self._local:
            return apart
        fastest, found_ns = self._offsets.get(publisher, (apart, now))
        fastest = min(apart, fastest + round((now - found_ns) * DRIFT))
        _remember(self._offsets, publisher, (fastest, now))
        return apart - fastest

    def _refuse(self, cause: str) -> None:
        self.refused[cause] += 1

    def _note_connections(self, now: float) -> None:
        """Count refused connections, and reconnect if ZeroMQ has given up, as it does after too large a frame."""
        self._looked = now
        while self._monitor.poll(0):
            description, at = self._monitor.recv_multipart()
            event, _ = _EVENT.unpack(description)
            endpoint = at.decode(errors="replace")
            if event & _HANDSHAKES:
                self._refuse(HANDSHAKE)
                self._shut_out.add(endpoint)
            elif event & _RETRIES:
                self._lost.pop(endpoint, None)
                self._shut_out.discard(endpoint)
            else:
                self._lost[endpoint] = now
        for endpoint in [endpoint for endpoint, at in self._lost.items() if now - at > REVIVE_S]:
            del self._lost[endpoint]
            if endpoint not in self._shut_out:
                self._refuse("too large")
            for given in [given for given in self._endpoints if given == endpoint] or self._endpoints:
                self.socket.disconnect(given)
                self._connect(given)

    def close(self) -> None:
        self.socket.disable_monitor()
        self._monitor.close(0)
        self.socket.close()
        self._context.term()


def _remember(table: OrderedDict[Any, Any], key: object, value: object) -> None:
    """Store a value as the newest, and drop the oldest beyond the limit."""
    table[key] = value
    table.move_to_end(key)
    if len(table) > _PUBLISHERS:
        table.popitem(last=False)


def _check(endpoint: str, keys: Keys | None, clear_text: bool) -> None:
    transport, path = parse(endpoint)
    if keys is None and not clear_text and not is_local(endpoint):
        remedy = "make them with `steadypose keys`, or set clear_text"
        raise TransportError(f"{endpoint} is another machine: expected keys, got none; {remedy}")
    if transport == "ipc" and not path.startswith("@"):
        check_private(Path(path).absolute().parent)
