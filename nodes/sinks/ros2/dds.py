"""Two ROS 2 topics of which the message packages are not on PyPI: ``/tf`` and ``/humans/bodies/tracked``.

rclpy can publish only types that were compiled, and PyPI has neither ``tf2_msgs`` nor ``hri_msgs``. But a ROS 2 topic
is a DDS topic with a prefix to its name, and Cyclone DDS makes types from Python classes: with these, any ROS 2 node
on the network hears them as it hears those of rclpy.

The classes are the definitions of the ROS packages, field by field.
"""

# pyright: reportMissingImports=false, reportGeneralTypeIssues=false, reportCallIssue=false
# an optional extra, which need not be installed

# without `from __future__ import annotations`: Cyclone reads the annotations of the classes as types
import os
from dataclasses import dataclass

import numpy as np
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, int32, sequence, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from steadypose.nodes.sinks.ros2.rep155 import Links
from steadypose.prior.body.kinematics import quaternions

QOS = Qos(Policy.Reliability.Reliable(duration(milliseconds=100)), Policy.History.KeepLast(100))
"""as tf2's own broadcaster"""

LOCALHOST = """<CycloneDDS><Domain>
<General><Interfaces><NetworkInterface address="127.0.0.1" multicast="false"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex><Peers><Peer address="127.0.0.1"/></Peers></Discovery>
</Domain></CycloneDDS>"""
"""Cyclone's configuration where ROS's discovery is limited to this machine"""


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Transform(IdlStruct, typename="geometry_msgs::msg::dds_::Transform_"):
    translation: Vector3
    rotation: Quaternion


@dataclass
class TransformStamped(IdlStruct, typename="geometry_msgs::msg::dds_::TransformStamped_"):
    header: Header
    child_frame_id: str
    transform: Transform


@dataclass
class TFMessage(IdlStruct, typename="tf2_msgs::msg::dds_::TFMessage_"):
    transforms: sequence[TransformStamped]


@dataclass
class IdsList(IdlStruct, typename="hri_msgs::msg::dds_::IdsList_"):
    header: Header
    ids: sequence[str]


class DdsOutput:
    """Publishes transforms and lists of bodies in a ROS domain.

    Args:
        domain: ``ROS_DOMAIN_ID``.
    """

    def __init__(self, domain: int) -> None:
        stay_here = (
            os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "") == "LOCALHOST"
            or os.environ.get("ROS_LOCALHOST_ONLY", "0") == "1"
        )
        configured = Domain(domain, LOCALHOST) if stay_here else None
        participant = DomainParticipant(domain)
        self._tf = DataWriter(participant, Topic(participant, "rt/tf", TFMessage), qos=QOS)
        self._tracked = DataWriter(participant, Topic(participant, "rt/humans/bodies/tracked", IdsList), qos=QOS)
        self._owned = [self._tf, self._tracked, participant, configured]

    def publish_transforms(self, transforms: list[TransformStamped]) -> None:
        self._tf.write(TFMessage(transforms))

    def publish_tracked(self, stamp_ns: int, frame_id: str, ids: list[str]) -> None:
        self._tracked.write(IdsList(Header(_time(stamp_ns), frame_id), ids))

    def close(self) -> None:
        """Leave the domain: Cyclone deletes what Python has let go of, which has to be in this order."""
        del self._tf, self._tracked
        while self._owned:
            del self._owned[0]


def body_transforms(stamp_ns: int, world: str, name: str, links: Links) -> list[TransformStamped]:
    """The links of one body: the ``body`` in the world, all others in the body, as REP-155 wants them.

    Args:
        stamp_ns: of capture.
        world: name of the world's frame.
        name: of the body, which ends the frames' names.
        links: where they are in the world.
    """
    root, heading = links["body"]
    origins = np.stack([origin for origin, _ in links.values()])
    turns = np.stack([turn for _, turn in links.values()])
    others = np.array([link != "body" for link in links])
    origins[others] = (origins[others] - root) @ heading
    turns[others] = heading.T @ turns[others]
    return [
        TransformStamped(
            Header(_time(stamp_ns), world if link == "body" else f"body_{name}"),
            f"{link}_{name}",
            Transform(Vector3(*origin), Quaternion(*quaternion)),
        )
        for link, origin, quaternion in zip(links, origins.tolist(), quaternions(turns).tolist(), strict=True)
    ]


def _time(stamp_ns: int) -> Time:
    return Time(*divmod(stamp_ns, 10**9))
