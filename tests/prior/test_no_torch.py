import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tests.helpers.bodies import PERIOD_NS, waving

from steadypose import PACKAGE

SCRIPT = """
import sys
from importlib.abc import MetaPathFinder


class NoTorch(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("torch", "roma"):
            raise ModuleNotFoundError(f"no {name} here", name=name)


sys.meta_path.insert(0, NoTorch())
import steadypose.nodes.commands.complete
import steadypose.nodes.commands.doctor
import steadypose.nodes.commands.run
import steadypose.nodes.commands.small
import steadypose.nodes.graph.prior_node
import steadypose.nodes.graph.trajectory_node
from steadypose.nodes.cli import main

sys.argv = ["steadypose", "clean", *sys.argv[1:], "--set", 'correct.sensor="kinect_v2"']
main()
"""


@pytest.mark.slow
def test_a_stream_is_cleaned_without_torch(tmp_path: Path) -> None:
    positions = waving(60)
    positions[20:40, 20] = np.nan  # a hidden wrist: completed, imputed
    stamps = 10**18 + np.arange(60) * PERIOD_NS
    np.savez(tmp_path / "in.npz", positions=positions, skeleton="smpl22", stamp_ns=stamps)
    arguments = [sys.executable, "-c", SCRIPT, str(tmp_path / "in.npz"), str(tmp_path / "out.npz")]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[-2000:]
    cleaned = np.load(tmp_path / "out.npz")
    assert np.isfinite(cleaned["world_positions"][10:]).all()
    assert np.isfinite(cleaned["anomaly"][10:]).all()


def test_torch_is_imported_by_fits_and_training_alone() -> None:
    running = [path for room in ("msgs", "prior", "nodes") for path in (PACKAGE / room).rglob("*.py")]
    at_the_top = re.compile(r"^(import|from) (torch|roma)", re.M)
    importing = [path.relative_to(PACKAGE) for path in running if at_the_top.search(path.read_text())]
    assert {str(path.parent) for path in importing} == {"prior/fit"}
