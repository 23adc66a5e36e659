"""What the start of a node takes, and leaves behind."""

from __future__ import annotations

import subprocess
import sys

import pytest

SPARED = ("asyncio", "scipy.linalg", "scipy.sparse", "scipy.spatial", "torch", "tyro", "rich", "mcap")
SCRIPT = """
import gc, sys
from steadypose.nodes.commands import node
from steadypose.nodes.graph.node import Node

def run(self):
    print(gc.isenabled(), gc.get_freeze_count() > 50_000, *(m for m in sys.argv[2:] if m in sys.modules))

Node.run = run
node.node([sys.argv[1]])
"""


@pytest.mark.parametrize("name", ["prior", "trajectory"])
def test_a_node_loads_nothing_that_its_work_does_without_and_counts_no_garbage_of_its_start(name: str) -> None:
    command = [sys.executable, "-c", SCRIPT, name, *SPARED]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "True True\n"


def test_who_has_compiled_starts_anew_once_with_what_is_now_on_disk() -> None:
    script = """
print("starts")
from steadypose.nodes.graph.process import startup
from steadypose.prior import loop_cache
with startup():
    loop_cache.saved.add("a loop")
print("works")
"""
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert run.stdout == "starts\nstarts\nworks\n"
