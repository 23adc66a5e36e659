"""``steadypose evaluate``: the protocols of the bench, each with its peers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro


def evaluate(
    protocol: Literal[
        "all", "kinect_vicon", "noisy_joints", "hidden_joints", "reconstruction", "hgvae", "world", "streaming"
    ],
    quick: bool = False,
    mocap: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    data: Path = Path("data/prepared.npz"),
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
) -> None:
    """Measure the prior against its tuned peers; figures, tables and pictures go to benchmarks/results.

    Args:
        protocol: what to measure, or 'all'.
        quick: a few clips and points, to see that all works; writes nothing, unless told where.
        mocap: folder with ui_prmd.npz, for the Kinect beside Vicon; without it, that protocol is left out of 'all'.
        data: prepared motion, as 'steadypose prepare' wrote it; without it, people of the project's own simulator
            stand in.
        out: folder to write to.
    """
    from steadypose.benchmarks.evaluate import evaluate as run

    run(protocol, quick=quick, mocap=mocap, data=data, out=out)
