"""What `steadypose complete` did, in a picture: which joints were given when, the motion as stick figures, the way."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.types import JOINTS, JointState
from steadypose.nodes.commands.completing import Done
from steadypose.nodes.sinks.drawing import ALL_BONES, STATE_COLOURS, facing
from steadypose.prior.timing.rate import FPS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FIGURES = 16
_GIVEN, _COMPLETED = STATE_COLOURS[JointState.SEEN], STATE_COLOURS[JointState.IMPUTED]


def draw(done: Done, title: str, path: Path) -> None:
    """Write the picture of the longest stretch of a recording that was completed."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib.collections import LineCollection
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure

    stretch, completed = max(done.stretches, key=lambda pair: len(pair[0].given))
    joints, known = completed.positions, completed.known
    there = np.flatnonzero(np.isfinite(joints).all(axis=(1, 2)))
    figure = Figure(figsize=(15, 9), layout="constrained")
    figure.suptitle(f"{title} · body {stretch.body} · given in green, completed in orange", fontsize=13, weight="bold")
    grid = figure.add_gridspec(2, 2, height_ratios=[1, 1.2], width_ratios=[2.2, 1])
    sticks = figure.add_subplot(grid[0, :])
    chosen = there[np.linspace(0, len(there) - 1, min(FIGURES, len(there))).round().astype(int)]
    front = next((f for row in chosen if (f := facing(joints[row])) is not None), np.array([1.0, 0.0, 0.0]))
    across = np.array([-front[1], front[0], 0.0])
    for place, row in enumerate(chosen):
        beside = joints[row] - joints[row, 0]
        flat = np.stack([place + beside @ across, beside[:, 2]], axis=1)
        colours = [_GIVEN if known[row, list(ends)].all() else _COMPLETED for ends in ALL_BONES]
        sticks.add_collection(LineCollection(list(flat[ALL_BONES]), colors=colours, linewidths=2.0))
        sticks.text(place, -1.13, f"{row / FPS:.1f} s", ha="center", fontsize=8)
    sticks.set(aspect="equal", xlim=(-0.6, FIGURES - 0.4), ylim=(-1.2, 0.85))
    sticks.axis("off")
    which = figure.add_subplot(grid[1, 0])
    shown = np.where(np.isfinite(joints[..., 0]), np.where(known, 1, 2), 0)
    which.imshow(
        shown.T, aspect="auto", interpolation="nearest", vmin=0, vmax=2,
        cmap=ListedColormap(["white", _GIVEN, _COMPLETED]), extent=(0.0, len(shown) / FPS, 21.5, -0.5),
    )  # fmt: skip
    which.set_yticks(range(len(JOINTS)), JOINTS, fontsize=7)
    which.set(title="which joints were given when", xlabel="seconds")
    way = figure.add_subplot(grid[1, 1])
    _draw_way(way, joints[:, 0], known[:, 0])
    figure.savefig(path, dpi=110)


def _draw_way(axis: Axes, root: NDArray[np.float64], given: NDArray[np.bool_]) -> None:
    for mask, colour in ((given, _GIVEN), (~given, _COMPLETED)):
        axis.plot(root[mask, 0], root[mask, 1], ".", color=colour, markersize=3)
    axis.set(title="the pelvis from above, m", aspect="equal")
    axis.grid(alpha=0.25)
