import dataclasses
from collections import Counter, defaultdict
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import VirtualClock, listeners, running, until, walk
from tests.helpers.msg_strategies import clean

from steadypose.msgs.security import create_keys
from steadypose.msgs.subscriber import HANDSHAKE
from steadypose.msgs.topics import POSE_CLEAN, POSE_RAW, POSE_WORLD
from steadypose.msgs.transport import Publisher, Subscriber
from steadypose.msgs.types import Pose, PoseRaw, PoseWorld
from steadypose.nodes.checks.problem import from_values
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.prior_node import PriorNode
from steadypose.nodes.graph.trajectory_node import TrajectoryNode
from steadypose.nodes.settings import LaunchError

FRAMES = 25


def kiosk(name: str, bodies: int, ahead_ns: int) -> list[PoseRaw]:
    """A kiosk's stream, its clock so far ahead."""
    return [dataclasses.replace(m, source=name, stamp_ns=m.stamp_ns + ahead_ns) for m in walk(FRAMES, bodies)]


@pytest.mark.parametrize("secret", [False, True])
def test_two_kiosks_and_a_server(make_launch, tmp_path: Path, clock: VirtualClock, secret: bool) -> None:
    streams = {"door": kiosk("door", 1, 0), "desk": kiosk("desk", 2, 3_600_000_000_000)}
    # kiosks and server have the same keys
    keys = create_keys(tmp_path / "keys") if secret else None
    answers: dict[str, list[PoseWorld]] = defaultdict(list)
    with ExitStack() as stack:
        door, desk = (stack.enter_context(Publisher("tcp://127.0.0.1:*", keys=keys)) for _ in streams)
        launch = make_launch(
            nodes='["prior", "trajectory"]',
            server__clients=str([door.endpoint, desk.endpoint]),
            transport__lossless="false",
            transport__queue=100,
            transport__keys=tmp_path / "keys" if secret else "",
        )
        prior, trajectory = PriorNode(launch, clock), TrajectoryNode(launch, clock)
        stack.enter_context(running(prior, trajectory))
        heard = Subscriber(launch.transport.endpoint("trajectory"), POSE_WORLD, keys=keys, name="test")
        subscriber = stack.enter_context(heard)
        for publisher in (door, desk):
            assert publisher.wait_for_subscribers({"prior"}, timeout_s=20)
        until(lambda: clock.sleep(33_333_333) or {"trajectory"} <= listeners(prior))
        until(lambda: clock.sleep(33_333_333) or {"test"} <= listeners(trajectory))
        for k in range(FRAMES):
            clock.time_ns += 33_333_333
            for publisher, name in ((door, "door"), (desk, "desk")):
                publisher.publish(POSE_RAW, streams[name][k])
            until(lambda k=k: len(prior.health.compute_ns) == 2 * (k + 1))

        def answered() -> bool:
            while received := subscriber.receive(0):
                assert isinstance(received[1], PoseWorld)
                answers[received[1].source].append(received[1])
            return len(answers) == 2 and all(len(found) >= FRAMES - 6 for found in answers.values())

        until(answered)
        assert door.subscribers == {"prior"}, "what a client says of itself is no matter of the trajectory's"
    assert prior.status()["streams"] == "2"
    for name, bodies in (("door", 1), ("desk", 2)):
        captured = {round(m.stamp_ns / 1e6) for m in streams[name]}
        assert {round(m.stamp_ns / 1e6) for m in answers[name]} <= captured, "stamps are of its own clock"
        assert {body.id for m in answers[name] for body in m.bodies} == set(range(bodies))
        assert all(len(m.bodies) == bodies for m in answers[name])


def test_what_is_garbled_or_lacks_keys_is_reported_with_the_address(make_launch, clock: VirtualClock) -> None:
    node = TrajectoryNode(make_launch(nodes='["trajectory"]'), clock)
    door, desk = (
        SimpleNamespace(addresses=f"tcp://{name}:7111", dropped=Counter(), late=Counter(), refused=Counter[str]())
        for name in ("door", "desk")
    )
    node._subscribers = [door, desk]  # type: ignore[list-item]
    door.refused.update(undecodable=2)
    desk.refused.update({HANDSHAKE: 1})
    found = from_values(node.diagnostics().values)
    assert "(undecodable: 2 from tcp://door:7111)" in found["not_a_message"]
    assert "no connection to tcp://desk:7111: expected CurveZMQ keys" in found["keys"]
    assert not from_values(node.diagnostics().values), "until it happens again"


def test_counts_of_a_client_that_came_back_under_another_name_stay(make_launch: Callable[..., Launch]) -> None:
    node = TrajectoryNode(
        make_launch(nodes='["trajectory"]', server__clients='["tcp://127.0.0.1:1"]', transport__lossless="false")
    )
    for name in ("door", "desk", "hall"):
        node.handle(POSE_CLEAN, dataclasses.replace(clean(), source=name, sensor_pose=Pose(np.zeros(3), np.zeros(4))))
    assert node.status()["refused.sensor_pose_invalid"] == "3"


def test_what_a_server_cannot_be_and_its_launch_file_goes_with_the_kiosks(make_launch: Callable[..., Launch]) -> None:
    of = {"server__clients": '["tcp://127.0.0.1:1"]', "transport__lossless": "false"}
    for wrong, expected in (
        ({"nodes": '["pose_input", "prior"]'}, "have their own pose_input"),
        ({"nodes": '["prior"]', "transport__lossless": "true"}, "lossless = false"),
    ):
        with pytest.raises(LaunchError, match=expected):
            make_launch(**(of | wrong))
    server, own = Launch.read("server"), Launch.read("kiosk")
    assert own.transport.endpoint("pose_input") in server.addresses("pose_input")
    assert own.nodes == ["pose_input"]
