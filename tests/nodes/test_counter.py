"""Behind a counter, where no sensor sees legs: of feet nothing is invented, in no form in which poses go out."""

from typing import TypeVar

import numpy as np
import pytest

import steadypose
from steadypose.msgs.topics import POSE_RAW
from steadypose.msgs.types import CONTACTS, EventKind, Phase, PoseRaw, PoseWorld
from steadypose.nodes.driving import stream
from steadypose.nodes.graph.launch import bundled
from steadypose.nodes.graph.prior_node import make_prior
from steadypose.nodes.graph.trajectory_node import make_trajectory
from steadypose.nodes.sources.recording import open_recording
from steadypose.prior.body.layouts import SKELETONS
from steadypose.prior.body.skeleton import J
from steadypose.prior.events.detector import EventDetector

Kind = TypeVar("Kind", PoseRaw, PoseWorld)
LEGS = CONTACTS[:6]
FRAMES = 150


def recorded(name: str, kind: type[Kind]) -> list[Kind]:
    return [message for _, message in open_recording(bundled("sim_data", name)) if isinstance(message, kind)]


def behind_counter(name: str) -> list[PoseWorld]:
    """What is published of a bundled stream without legs."""
    raws = recorded(name, PoseRaw)
    for raw in raws:
        hidden = SKELETONS[raw.skeleton].to_canonical[[J[leg] for leg in LEGS]].any(axis=0)
        for body in raw.bodies:
            body.positions[hidden] = np.nan
    published = stream([(POSE_RAW, raw) for raw in raws], make_prior({}), make_trajectory({}))
    return [message for _, message in published if isinstance(message, PoseWorld) and message.bodies]


def postures(name: str, worlds: list[PoseWorld]) -> list[tuple[str, float]]:
    """When somebody sits or stands, in seconds, with a calibrated sensor."""
    sensor, detector = recorded(name, PoseRaw)[0].sensor_pose.position, EventDetector()
    return [
        (event.kind.name, event.since_ns / 1e9)
        for world in worlds
        for event in detector.update(world, sensor, calibrated=True)
        if event.kind in (EventKind.STANDS, EventKind.SITS) and event.phase == Phase.BEGINS
    ]


@pytest.mark.parametrize(("first", "last"), [(60, 75), (30, 130)])
def test_a_foot_keeps_its_contacts_for_a_while_and_has_them_when_it_is_seen_again(first: int, last: int) -> None:
    walk = steadypose.sample("walk_turn")
    joints = walk.positions[:FRAMES].copy()
    joints[first:last, [J[name] for name in LEGS]] = np.nan
    poses = steadypose.clean(joints, stamp_ns=walk.stamp_ns[:FRAMES])
    unknown = np.isnan(poses["contacts"][:, CONTACTS.index("left_foot")])
    assert not unknown[: first + 59].any()
    assert unknown[first + 62 : last].all()
    assert not unknown[last:].any()
    assert np.isfinite(poses.contacts["left_wrist"]).all()


@pytest.mark.slow
def test_who_sits_down_and_rises_is_said_to_within_half_a_second() -> None:
    """Guessed feet neither pass for certain nor lower the floor, above which the hips' height is measured."""
    worlds = behind_counter("sit_rise")
    assert max(abs(world.ground_plane[3]) for world in worlds) < 0.001
    found, expected = postures("sit_rise", worlds), postures("sit_rise", recorded("sit_rise", PoseWorld))
    assert [kind for kind, _ in found] == [kind for kind, _ in expected] == ["STANDS", *["SITS", "STANDS"] * 2]
    assert [at for _, at in found] == pytest.approx([at for _, at in expected], abs=0.5)
