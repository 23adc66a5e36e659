import subprocess
import sys
from pathlib import Path

import pytest
from numba.core.dispatcher import Dispatcher

from steadypose.nodes.graph import trajectory_node
from steadypose.nodes.graph.loops import _locked, compile_from_the_beginning, compile_from_the_end

pytestmark = pytest.mark.slow

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


def kinds() -> dict[str, int]:
    """Of every compiled function of the prior, for how many kinds of arguments it is loaded."""
    found = [value for name, module in list(sys.modules.items()) if name.startswith("steadypose.prior.")
             for value in vars(module).values() if isinstance(value, Dispatcher)]  # fmt: skip
    return {f"{f.py_func.__module__}.{f.py_func.__qualname__}": len(f.signatures) for f in found}


def test_the_second_process_compiles_nothing_that_the_first_would_not() -> None:
    assert trajectory_node.TrajectoryNode.name == "trajectory"  # its loops are loaded with it
    compile_from_the_beginning()
    loaded = kinds()
    compile_from_the_end()
    assert {name: number for name, number in kinds().items() if number != loaded.get(name)} == {}


def test_one_that_compiles_for_ever_is_not_waited_for(tmp_path: Path) -> None:
    with open(tmp_path / "lock", "w") as theirs, open(tmp_path / "lock", "w") as ours:
        assert _locked(theirs, 0.2)
        assert not _locked(ours, 0.2)
    with open(tmp_path / "lock", "w") as ours:
        assert _locked(ours, 0.2)
