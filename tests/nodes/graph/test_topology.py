import dataclasses
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from steadypose.msgs.topics import DIAGNOSTICS, POSE_WORLD, TOPICS
from steadypose.nodes.extras import EXTRAS
from steadypose.nodes.graph import topology
from steadypose.nodes.graph.launch import Launch, in_launch_file
from steadypose.nodes.graph.node import Node
from steadypose.nodes.graph.topology import NODES, POSE_NODES, NodeDeclaration, load, publishers
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sources.registry import SOURCES, InputSettings, open_input
from steadypose.nodes.sources.source import LiveSource, SourceContext


@pytest.mark.parametrize("name", NODES)
def test_a_declaration_names_what_exists(name: str) -> None:
    declared = NODES[name]
    node = load(declared.node)
    assert issubclass(node, Node)
    assert node.name == name
    if declared.settings:
        assert dataclasses.is_dataclass(load(declared.settings))
        assert declared.section
    assert declared.extra in {"", *EXTRAS}
    assert not declared.preflight or callable(load(declared.preflight))
    for publisher, topics in declared.subscribes.items():
        assert set(topics) <= {*NODES[publisher].publishes, DIAGNOSTICS}, f"{name} of {publisher}"


def test_every_topic_has_publishers() -> None:
    assert all(publishers(topic) for topic in TOPICS)
    assert publishers(DIAGNOSTICS) == list(POSE_NODES)


@pytest.mark.parametrize("name", SOURCES)
def test_a_declaration_of_a_source_names_what_exists(name: str) -> None:
    (opens, extra), settings = SOURCES[name], getattr(InputSettings(), name)
    assert not extra or extra in EXTRAS
    if name == "recording":
        assert settings == ""
    else:
        assert dataclasses.is_dataclass(settings)
        # a class, or a function that chooses one
        assert not isinstance(opens, type) or issubclass(opens, LiveSource)


def test_reading_a_launch_file_takes_none_of_the_nodes_libraries() -> None:
    code = (
        "import sys; import steadypose.nodes.sources.pose_input, steadypose.nodes.commands.node; "
        "from steadypose.nodes.graph.launch import Launch; "
        "[Launch.read(name) for name in ('replay', 'oak', 'webcam', 'server', 'two_cameras', 'ros2')]; "
        "print(*({'torch', 'numba', 'cv2', 'depthai', 'rclpy', 'rerun', 'matplotlib'} & sys.modules.keys()))"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.split() == []


@pytest.fixture
def package(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """An installed package, ``acme``."""
    before = dict(NODES)
    module = ModuleType("acme")
    monkeypatch.setitem(sys.modules, "acme", module)
    yield module
    topology._NODES.clear()
    topology._NODES.update(before)


def read(path: Path, text: str) -> Launch:
    path.write_text(text)
    return Launch.read(path)


def test_a_node_of_another_package_is_one_of_the_graph(package: Any, tmp_path: Path) -> None:
    package.ROBOT = NodeDeclaration("acme:RobotNode", subscribes={"trajectory": (POSE_WORLD,)}, section="robot")
    text = 'nodes = ["pose_input", "trajectory", "robot"]\nplugins = {robot = "acme:ROBOT"}\n[robot]\nspeed = 2'
    launch = read(tmp_path / "a.toml", text)
    assert launch.table("robot") == {"speed": 2}
    assert launch.reliable_subscribers("trajectory") == {"robot"}
    assert read(tmp_path / "a.toml", text) == launch
    assert list(NODES)[-1] == "robot"
    assert in_launch_file(tmp_path / "a.toml", ["robot.speed=3"]) == ["robot.speed=3"]


def test_a_source_of_another_package_gets_its_options(package: Any, tmp_path: Path) -> None:
    given = []

    def opens(options: dict[str, Any], context: SourceContext) -> object:
        given.append((options, context.calibration))
        return source

    source = object()
    package.opens = opens
    launch = read(tmp_path / "a.toml", '[input]\nsource = "acme:opens"\noptions = {port = 7}')
    settings = launch.settings(InputSettings)
    assert open_input(launch) is source
    assert given == [({"port": 7}, settings.calibration)]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('plugins = {robot = "acme:ROBOT"}', "robot: acme:ROBOT cannot be imported: .*install its package"),
        ('plugins = {robot = "nobody:ROBOT"}', "cannot be imported: No module named 'nobody'"),
        ('plugins = {robot = "acme"}', "expected module:name, got 'acme'"),
        ('plugins = {robot = "acme:TEXT"}', "expected a NodeDeclaration, got str"),
        ('plugins = {prior = "acme:OTHER"}', "there is a node of that name already"),
        ('[input]\nsource = "acme:opens"', r"\[input\] source: acme:opens cannot be imported"),
    ],
)
def test_what_is_no_plugin_is_said(package: Any, tmp_path: Path, text: str, said: str) -> None:
    package.TEXT, package.OTHER = "text", NodeDeclaration("acme:Node")
    with pytest.raises(LaunchError, match=said):
        open_input(read(tmp_path / "a.toml", text))
