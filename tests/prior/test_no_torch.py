"""What runs needs no torch: a whole stream, through both pipelines, in a process where there is none."""

import subprocess
import sys
from pathlib import Path

import numpy as np
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
import steadypose.nodes.commands.completing
import steadypose.nodes.commands.doctor.command
import steadypose.nodes.commands.plot
import steadypose.nodes.commands.run
import steadypose.nodes.commands.simulate
import steadypose.nodes.graph.prior_node
import steadypose.nodes.graph.trajectory_node
from steadypose.nodes.cli import main

sys.argv = ["steadypose", "clean", *sys.argv[1:], "--set", 'correct.sensor="kinect_v2"']
main()
"""


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


def test_only_training_mentions_torch() -> None:
    allowed = {
        "network",
        "train",
        "windows",
        "completion",
        "faults",
        "train_completion",
        "train_faults",
        "train_occlusion",
    }
    allowed |= {"graph", "skeleton_conv", "torch_kinematics", "torch_weights", "training", "distributed"}
    allowed |= {
        "state",
        "rollout",
        "initial",
        "motion",
        "energy",
        "observations",
        "solve",
        "lift",
        "smpl",
    }  # of HuMoR and fit
    allowed |= {"torch_features", "modules", "export"}  # of ONNX
    allowed |= {"optimise"}  # of offline completion, with an extra
    files = [*(PACKAGE / "prior").rglob("*.py"), *(PACKAGE / "nodes" / "graph").rglob("*.py")]
    found = {file.stem for file in files if "import torch" in file.read_text()}
    assert found - allowed == {"dataset"}  # of motion, for training
