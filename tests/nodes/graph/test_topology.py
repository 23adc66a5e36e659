"""The declarations of the nodes and of the sources name what exists, and agree with each other."""

from __future__ import annotations

import dataclasses
import sys

import pytest

from steadypose.msgs.topics import DIAGNOSTICS, TOPICS
from steadypose.nodes.extras import EXTRAS
from steadypose.nodes.graph.node import Node
from steadypose.nodes.graph.topology import NODES, POSE_NODES, load, publishers
from steadypose.nodes.sources.registry import SOURCES, InputSettings
from steadypose.nodes.sources.source import LiveSource


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
    if declared.preflight:
        assert callable(load(declared.preflight))


@pytest.mark.parametrize("name", SOURCES)
def test_a_declaration_of_a_source_names_what_exists(name: str) -> None:
    declared, settings = SOURCES[name], getattr(InputSettings(), name)
    assert not declared.extra or declared.extra in EXTRAS
    if name == "recording":
        assert settings == ""
    else:
        assert dataclasses.is_dataclass(settings)
        # a class, or a function that chooses one
        assert not isinstance(declared.opens, type) or issubclass(declared.opens, LiveSource)


def test_a_node_subscribes_to_what_another_publishes() -> None:
    for name, declared in NODES.items():
        for publisher, topics in declared.subscribes.items():
            assert set(topics) <= {*NODES[publisher].publishes, DIAGNOSTICS}, f"{name} of {publisher}"


def test_every_topic_has_publishers() -> None:
    for topic in TOPICS:
        assert publishers(topic), topic
    assert publishers(DIAGNOSTICS) == list(POSE_NODES)


def test_reading_a_launch_file_takes_none_of_the_nodes_libraries() -> None:
    import subprocess

    code = (
        "import sys; import steadypose.nodes.sources.pose_input; from steadypose.nodes.graph.launch import Launch; "
        "[Launch.read(name) for name in ('replay', 'oak', 'webcam', 'server', 'two_cameras', 'ros2')]; "
        "print(*({'torch', 'numba', 'cv2', 'depthai', 'rclpy', 'rerun', 'matplotlib'} & sys.modules.keys()))"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.split() == []
