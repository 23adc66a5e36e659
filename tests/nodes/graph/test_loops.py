"""What an installation compiles is what the nodes run."""

from __future__ import annotations

import sys
from pathlib import Path

from numba.core.dispatcher import Dispatcher

from steadypose.nodes.graph import trajectory_node
from steadypose.nodes.graph.loops import _locked, compile_from_the_beginning, compile_from_the_end


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
