import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from conftest import until

from steadypose.nodes.graph.launch import Launch, tomllib
from steadypose.prior.clean.settings import PriorSettings

PACKAGE = Path(__file__).parents[2] / "ros2/steadypose_ros"
PROGRAM = Path(sys.executable).parent / "steadypose"
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("ros")]


@pytest.fixture
def graph(ros: None) -> Iterator[Any]:
    import rclpy
    from rclpy.context import Context
    from rclpy.executors import SingleThreadedExecutor

    context = Context()
    rclpy.init(context=context)
    node = rclpy.create_node("looks", context=context)
    executor = SingleThreadedExecutor(context=context)  # the node knows it by a weak reference alone
    executor.add_node(node)
    yield node
    node.destroy_node()
    context.shutdown()


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts the package's node with parameters, in the namespace /fleet/robot."""
    started: list[subprocess.Popen[str]] = []

    def node(**parameters: str) -> subprocess.Popen[str]:
        given = [it for name, value in parameters.items() for it in ("-p", f"{name.replace('__', '.')}:={value}")]
        command = [sys.executable, "-m", "steadypose_ros.node", "--ros-args", "-r", "__ns:=/fleet/robot", *given]
        environment = os.environ | {"PYTHONPATH": str(PACKAGE)}
        # nowhere near a checkout
        started.append(subprocess.Popen(command, env=environment, cwd=tmp_path, stderr=subprocess.PIPE, text=True))
        return started[-1]

    yield node
    for it in started:
        it.kill()
        it.wait()


def call(graph: Any, kind: Any, name: str, request: Any) -> Any:
    client = graph.create_client(kind, f"/fleet/robot/steadypose/{name}")
    assert client.wait_for_service(30)
    future = client.call_async(request)
    graph.executor.spin_until_future_complete(future, 60)
    return future.result()


def state(graph: Any) -> str:
    from lifecycle_msgs.srv import GetState

    return call(graph, GetState, "get_state", GetState.Request()).current_state.label


def change(graph: Any, transition: str) -> bool:
    from lifecycle_msgs.msg import Transition
    from lifecycle_msgs.srv import ChangeState

    wanted = Transition(id=getattr(Transition, f"TRANSITION_{transition.upper()}"))
    return call(graph, ChangeState, "change_state", ChangeState.Request(transition=wanted)).success


def test_a_lifecycle_starts_and_ends_the_program(graph: Any, start: Callable[..., Any], tmp_path: Path):
    launch = tmp_path / "mine.toml"
    launch.write_text('nodes = ["pose_input", "ros2_bridge"]\n[transport]\nlossless = false\n')
    recording = Path(__file__).parents[2] / "sim_data/walk_turn"
    process = start(
        launch=str(launch), command=str(PROGRAM), autostart="false", input__recording=str(recording),
        input__loop="true", transport__directory=str(tmp_path / "sockets"),
    )  # fmt: skip

    def topics() -> set[str]:
        return {name for name, _ in graph.get_topic_names_and_types() if graph.count_publishers(name)}

    assert state(graph) == "unconfigured"
    # names may be heard of later than services
    until(lambda: ("steadypose", "/fleet/robot") in graph.get_node_names_and_namespaces(), timeout_s=30)
    assert change(graph, "configure")
    assert change(graph, "activate")
    until(lambda: {"/fleet/robot/steadypose/pose_raw", "/diagnostics"} <= topics(), timeout_s=60)
    assert state(graph) == "active"
    assert change(graph, "deactivate")
    assert state(graph) == "inactive"
    until(lambda: "/fleet/robot/steadypose/pose_raw" not in topics(), timeout_s=30)
    assert change(graph, "activate"), "and again"
    until(lambda: "/fleet/robot/steadypose/pose_raw" in topics(), timeout_s=60)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=60)
    until(lambda: "/fleet/robot/steadypose/pose_raw" not in topics(), timeout_s=30)


def test_a_program_that_ends_leaves_the_node_inactive(graph: Any, start: Callable[..., subprocess.Popen[str]]) -> None:
    process = start(command=str(PROGRAM), prior__dealy="2")
    until(lambda: state(graph) == "inactive", timeout_s=60)
    process.send_signal(signal.SIGINT)
    errors = process.communicate(timeout=60)[1]
    assert "delay" in errors, "what steadypose says of a setting that it does not know"
    assert "ended, with status 2" in errors


def test_a_program_that_is_not_there_is_named(graph: Any, start: Callable[..., subprocess.Popen[str]]) -> None:
    process = start(command="/nowhere/steadypose")
    assert state(graph) == "unconfigured"
    assert not change(graph, "configure")
    process.send_signal(signal.SIGINT)
    assert "expected steadypose's program, got '/nowhere/steadypose'" in process.communicate(timeout=60)[1]


def test_parameters_become_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(PACKAGE)
    from steadypose_ros.node import OWN, arguments  # pyright: ignore[reportMissingImports]

    given = {"input.source": 'a "b" é', "prior.delay": 2, "input.rate": 1e-5, "input.loop": True, "nodes": ["prior"]}
    command = arguments(OWN | given | {"use_sim_time": True, "qos_overrides./tf.depth": 3}, "/fleet/robot")
    assert command[:3] == ["steadypose", "run", "ros2"]
    assert command[3::2] == ["--set"] * 6
    sets = {name: tomllib.loads(f"v = {value}")["v"] for name, _, value in (it.partition("=") for it in command[4::2])}
    assert sets == given | {"ros2.namespace": "fleet/robot"}
    settings = [it for it in command[4::2] if it.startswith(("ros2.", "prior."))]
    assert Launch.read("ros2", settings).settings(PriorSettings).delay == 2
    assert arguments(OWN | {"ros2.namespace": "other"}, "/robot")[4:] == ['ros2.namespace="other"']


def test_the_package_says_the_same_everywhere() -> None:
    package = ElementTree.parse(PACKAGE / "package.xml")
    messages = ElementTree.parse(PACKAGE.parents[1] / "msgs/package.xml")
    version = package.findtext("version")
    assert version == messages.findtext("version")
    assert f'version="{version}"' in (PACKAGE / "setup.py").read_text()
    needs = {it.text for it in package.iterfind("exec_depend")}
    from steadypose.nodes.sinks.ros2 import messages

    source = Path(messages.__file__).read_text()
    used = {part.rsplit('"', 1)[-1] for part in source.split("/msg/")[:-1]}
    assert "geometry_msgs" in used
    assert used | {"steadypose_msgs"} <= needs
