"""The VMC sink: one person as OSC over UDP, for avatars in Unity, Unreal and others (Virtual Motion Capture)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from steadypose.msgs.types import PoseWorld, WorldBody
from steadypose.nodes.graph.clock import Clock
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.sinks.datagrams import DatagramNode, DatagramSettings, Followed
from steadypose.prior.arrays import Floats
from steadypose.prior.body.avatars import VRM
from steadypose.prior.body.kinematics import global_rotations, rotation_matrices
from steadypose.prior.body.skeleton import PARENTS

BONES = tuple(name[0].upper() + name[1:] for name in VRM)
"""(22,) as the protocol and Unity call them"""
_A_BUNDLE = 11  # bones, so that a datagram is not taken apart on its way


@dataclass(frozen=True)
class VmcSettings(DatagramSettings):
    """``[vmc]``: one person's pose for avatars, by the VMC protocol."""

    section = "vmc"

    port: int = 39539
    """to which UDP port: 39539 is what programs that play an avatar listen at"""


def unity(body: WorldBody) -> tuple[Floats, Floats]:
    """Where each bone is in its parent's frame, and how it is turned, in Unity's axes: x right, y up, z forward.

    Unity's are left-handed: positions are mirrored, and with them the sense of every turn.

    Returns:
        (22, 3) metres, the hips' in the world, and (22, 4) xyzw.
    """
    rotations = np.asarray(body.rotations, dtype=np.float64)
    world = global_rotations(rotation_matrices(rotations))
    positions = np.asarray(body.positions, dtype=np.float64)
    parents = list(PARENTS[1:])
    local = (positions[1:] - positions[parents])[:, None] @ world[parents]
    places = np.concatenate([positions[:1], local[:, 0]])
    return places[:, [1, 2, 0]] * (-1.0, 1.0, 1.0), rotations[:, [1, 2, 0, 3]] * (1.0, -1.0, -1.0, 1.0)


class VmcNode(DatagramNode):
    """Sends the pose of one person at a time, until they are gone."""

    name = "vmc"

    def __init__(self, launch: Launch, clock: Clock | None = None) -> None:
        super().__init__(launch, clock)
        self._settings = launch.settings(VmcSettings)
        self._followed = Followed()
        self._first_ns: int | None = None

    def datagrams(self, world: PoseWorld) -> list[bytes]:
        self._first_ns = world.stamp_ns if self._first_ns is None else self._first_ns
        return osc_bundles((world.stamp_ns - self._first_ns) / 1e9, self._followed.update(world))


def osc_bundles(time_s: float, body: WorldBody | None) -> list[bytes]:
    """A moment as OSC bundles: whether somebody is there, the time in seconds, and the bones of who is."""
    from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
    from pythonosc.osc_message_builder import build_msg

    messages = [build_msg("/VMC/Ext/OK", [int(body is not None)]), build_msg("/VMC/Ext/T", [time_s])]
    if body is not None:
        messages.append(build_msg("/VMC/Ext/Root/Pos", ["root", 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]))
        for name, place, turn in zip(BONES, *unity(body), strict=True):
            messages.append(build_msg("/VMC/Ext/Bone/Pos", [name, *place.tolist(), *turn.tolist()]))
    bundles = []
    for start in range(0, len(messages), _A_BUNDLE):
        bundle = OscBundleBuilder(IMMEDIATELY)
        for message in messages[start : start + _A_BUNDLE]:
            bundle.add_content(message)
        bundles.append(bundle.build().dgram)
    return bundles
