"""``steadypose evaluate``: the studies of the bench, each with its baselines."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro


def evaluate(
    protocol: Literal[
        "all",
        "fidelity",
        "kinect_vicon",
        "mediapipe",
        "rotations",
        "noisy_joints",
        "hidden_joints",
        "reconstruction",
        "interpolation",
        "completion",
        "hgvae",
        "world",
        "contacts",
        "humor",
        "camera_rates",
        "ablations",
        "streaming",
    ],
    split: Literal["val", "test"] = "val",
    quick: bool = False,
    mocap: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    data: Path = Path("data/prepared.npz"),
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
) -> None:
    """Measure the prior against its tuned baselines: choose on the split 'val', report 'test'.

    Figures, tables and pictures of 'test' go to benchmarks/results, if what is measured is committed; others go to the
    folder that --out names, or nowhere. Every reading of 'test' is a line of benchmarks/results/test-readings.csv.

    Args:
        protocol: what to measure, or 'all'.
        split: of the prepared motion that is scored. Kinect, MediaPipe and force plates have none.
        quick: a few clips and points, to see that all works.
        mocap: folder with ui_prmd.npz, mediapipe_pose.npz and contacts_grf.npz, for the protocols with these sensors;
            without it, they are left out of 'all'.
        data: prepared motion, as 'steadypose prepare' wrote it; without it, people of the project's own simulator
            stand in.
        out: folder to write to.
    """
    from steadypose.benchmarks.evaluate import evaluate as run  # torch, after the arguments are known to be right

    run(protocol, split=split, quick=quick, mocap=mocap, data=data, out=out)
