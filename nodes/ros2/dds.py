"""ROS 2's topics over plain DDS (Cyclone DDS), without ROS.

A ROS 2 topic is a DDS topic with a prefix in its name, a differently spelled type, and the type's hash in the writer's
user data. A ROS 2 node on a DDS middleware receives such a topic like any other. Type descriptions come from rosbags'
definitions. Messages are passed to Cyclone in serialised form, because serialisation in its Python package would take a
millisecond per message.

Fast DDS 3 (Kilted) announces descriptions of sequences that Cyclone rejects as invalid, so the two cannot communicate.
Fast DDS 2 (Jazzy) works.
"""

# pyright: reportMissingImports=false
# an optional extra that may not be installed

import os
import threading
from collections.abc import Callable
from functools import cache
from typing import Any

import cyclonedds.idl.types as idl
from cyclonedds.core import Listener, Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import make_idl_struct
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from rosbags.interfaces import Nodetype

from steadypose.nodes.ros2.definitions import DEPTH, Publish, ros_types

LOCALHOST = """<CycloneDDS><Domain>
<General><Interfaces><NetworkInterface address="127.0.0.1" multicast="false"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex><Peers><Peer address="127.0.0.1"/></Peers></Discovery>
</Domain></CycloneDDS>"""
"""Cyclone's configuration if ROS's discovery is limited to this machine, XML."""
_BASES = {"bool": bool, "string": str, "byte": idl.uint8, "char": idl.uint8}


class DdsConnection:
    """A participant in the ROS domain given by ``ROS_DOMAIN_ID``; implements `Connection`."""

    def __init__(self) -> None:
        variable = os.environ.get
        domain = int(variable("ROS_DOMAIN_ID") or 0)
        if variable("ROS_AUTOMATIC_DISCOVERY_RANGE") == "LOCALHOST" or variable("ROS_LOCALHOST_ONLY") == "1":
            _stay_here(domain)
        self._participant = DomainParticipant(domain)
        self._writers: dict[Publish, DataWriter] = {}
        self._readers: list[tuple[DataReader, Callable[[bytes], None]]] = []
        self._came = threading.Event()
        self._listener = _Wakes(self._came)

    def publisher(self, topic: str, kind: str, *, latched: bool = False) -> Publish:
        described = _described(kind)
        policies = [
            Policy.Reliability.Reliable(duration(milliseconds=100)),
            Policy.History.KeepLast(1 if latched else DEPTH),
            Policy.Userdata(f"typehash={ros_types().hash_rihs01(kind)};".encode()),
        ]
        if latched:
            policies.append(Policy.Durability.TransientLocal)
        writer = DataWriter(self._participant, Topic(self._participant, f"rt/{topic}", described), Qos(*policies))

        def publish(cdr: bytes) -> None:
            writer.write(_sample(described, cdr))

        self._writers[publish] = writer
        return publish

    def subscribe(
        self, topic: str, kind: str, heard: Callable[[bytes], None], *, latched: bool = False, depth: int = DEPTH
    ) -> None:
        durable = Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile
        reliable = Policy.Reliability.Reliable(duration(milliseconds=100)) if latched else Policy.Reliability.BestEffort
        qos = Qos(reliable, durable, Policy.History.KeepLast(depth))
        where = Topic(self._participant, f"rt/{topic}", _described(kind))
        self._readers.append((DataReader(self._participant, where, qos, self._listener), heard))

    def spin(self, timeout_s: float) -> None:
        self._came.wait(timeout_s)
        self._came.clear()
        for reader, heard in self._readers:
            for sample in reader.take(100):
                if (cdr := getattr(sample, "cdr", None)) is not None:
                    heard(cdr)

    def drop(self, publish: Publish) -> None:
        del self._writers[publish]

    def close(self) -> None:
        """Leave the domain. Cyclone deletes an entity when Python releases it, so the order matters."""
        self._writers.clear()
        self._readers.clear()
        del self._participant


@cache
def _stay_here(domain: int) -> Domain:
    """Restrict a domain to this machine, once per process."""
    return Domain(domain, LOCALHOST)


class _Wakes(Listener):
    """Sets an event when data has arrived."""

    def __init__(self, event: threading.Event) -> None:
        super().__init__()
        self._event = event

    def on_data_available(self, reader: DataReader) -> None:
        self._event.set()


def _sample(kind: Any, cdr: bytes) -> Any:
    """A message of a type that carries its serialised form."""
    sample = kind.__new__(kind)
    sample.cdr = bytes(cdr)
    return sample


@cache
def _described(name: str) -> Any:
    """Cyclone's description of a type, whose messages stay serialised."""
    kind = _struct(name)
    kind.serialize = lambda self, **_: self.cdr
    kind.deserialize = classmethod(lambda cls, data, **_: _sample(cls, data))
    return kind


@cache
def _struct(name: str) -> Any:
    package, _, short = name.split("/")
    fields = {field: _field(node) for field, node in ros_types().fielddefs[name][1]}
    return make_idl_struct(short, f"{package}::msg::dds_::{short}_", fields)


def _field(node: Any) -> Any:
    kind, what = node
    if kind == Nodetype.BASE:
        return _BASES.get(what[0]) or getattr(idl, what[0])
    if kind == Nodetype.NAME:
        return _struct(what)
    item, count = what
    if kind == Nodetype.ARRAY:
        return idl.array[_field(item), count]
    return idl.sequence[_field(item), count] if count else idl.sequence[_field(item)]
