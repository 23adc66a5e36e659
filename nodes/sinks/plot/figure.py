"""The figures: of a recording, of a completion, and of the residuals of a fit."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.topics import POSE_CLEAN
from steadypose.msgs.types import JOINTS, JointState
from steadypose.nodes.settings import as_text
from steadypose.nodes.sinks.drawing import ALL_BONES, STATE_COLOURS
from steadypose.nodes.sinks.plot.history import History, PlotError, body_of, errors_of
from steadypose.nodes.sinks.plot.panels import (
    draw_bones,
    draw_by_joint,
    draw_path,
    draw_stick_figures,
    draw_summary,
    panels_over_time,
    side_by_side,
)
from steadypose.prior.arrays import Floats
from steadypose.prior.timing.rate import FPS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from steadypose.prior.complete.stream import Completion

STRIP, TITLE = 2.8, 0.45  # heights of the strip of stick figures and of a panel's title, inches
IMAGES = (".png", ".svg", ".pdf")


def check_image(output: Path, endings: tuple[str, ...] = IMAGES) -> None:
    """Raise PlotError if an output's suffix is not one of ``endings``, or its folder does not exist."""
    if output.suffix not in endings:
        raise PlotError(f"output: expected a name ending in {', '.join(endings[:-1])} or {endings[-1]}, got {output}")
    if not output.resolve().parent.is_dir():
        raise PlotError(f"output: {output.resolve().parent} is no directory; make it first")


def save(figure: Figure, output: Path) -> None:
    """Write a figure to a file; raises as `check_image`."""
    check_image(output)
    figure.savefig(output, dpi=110)


def draw(history: History, body: int | None = None) -> Figure:
    """Draw one body of a recording, and the paths of all bodies over the floor. Raises PlotError as in `body_of`."""
    from matplotlib.figure import Figure

    chosen, bodies = body_of(history, body), history.bodies
    errors = errors_of(history, chosen)
    panels = panels_over_time(history, chosen, errors)
    heights = [panel.height + TITLE for panel in panels]
    body_height = max(sum(heights), 9.0)
    figure = Figure(figsize=(16, STRIP + body_height), layout="constrained")
    title = f"{as_text(history.name)} · {history.origin} · body {chosen}, one of {len(bodies)}"
    figure.suptitle(title, fontsize=14, weight="bold")
    rows = figure.add_gridspec(2, 1, height_ratios=[STRIP, body_height])
    draw_stick_figures(figure.add_subplot(rows[0]), history, chosen)
    columns = rows[1].subgridspec(1, 2, width_ratios=[2.2, 1])
    over_time = columns[0].subgridspec(len(panels), 1, height_ratios=heights)
    first: Axes | None = None
    for row, panel in enumerate(panels):
        ax = figure.add_subplot(over_time[row], sharex=first)
        first = first or ax
        panel.draw(ax)
        ax.set_title(panel.title, loc="left", fontsize=10, weight="bold")
        ax.margins(x=0)
        ax.grid(alpha=0.25)
        ax.tick_params(labelbottom=row == len(panels) - 1)
        if row == len(panels) - 1:
            ax.set_xlabel("time, s")
    beside = columns[1].subgridspec(3, 1, height_ratios=[2, 2, 1.2])
    draw_path(figure.add_subplot(beside[0]), history, chosen)
    draw_by_joint(figure.add_subplot(beside[1]), history.track(POSE_CLEAN, chosen), errors)
    draw_summary(figure.add_subplot(beside[2]), history, chosen, errors)
    return figure


FIGURES = 16
_GIVEN, _COMPLETED = STATE_COLOURS[JointState.SEEN], STATE_COLOURS[JointState.IMPUTED]


def draw_completion(completion: Completion, title: str) -> Figure:
    """Draw the longest completed stretch: which joints were given when, stick figures, and the trajectory."""
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure

    stretch, completed = max(completion.done, key=lambda pair: len(pair[0].given))
    joints, known = completed.positions, completed.known
    there = np.flatnonzero(np.isfinite(joints).all(axis=(1, 2)))
    figure = Figure(figsize=(15, 9), layout="constrained")
    title = f"{as_text(title)} · body {stretch.body} · given in green, completed in orange"
    figure.suptitle(title, fontsize=13, weight="bold")
    grid = figure.add_gridspec(2, 2, height_ratios=[1, 1.2], width_ratios=[2.2, 1])
    sticks = figure.add_subplot(grid[0, :])
    chosen = there[np.linspace(0, len(there) - 1, min(FIGURES, len(there))).round().astype(int)]
    for row, flat in zip(chosen, *side_by_side(sticks, chosen / FPS, joints[chosen]), strict=True):
        colours = [_GIVEN if known[row, list(ends)].all() else _COMPLETED for ends in ALL_BONES]
        draw_bones(sticks, flat, ALL_BONES, colours, width=2.0)
    which = figure.add_subplot(grid[1, 0])
    shown = np.where(np.isfinite(joints[..., 0]), np.where(known, 1, 2), 0)
    which.imshow(
        shown.T, aspect="auto", interpolation="nearest", vmin=0, vmax=2,
        cmap=ListedColormap(["white", _GIVEN, _COMPLETED]), extent=(0.0, len(shown) / FPS, 21.5, -0.5),
    )  # fmt: skip
    which.set_yticks(range(len(JOINTS)), JOINTS, fontsize=7)
    which.set(title="given and completed joints", xlabel="time, s")
    above = figure.add_subplot(grid[1, 1])
    for mask, colour in ((known[:, 0], _GIVEN), (~known[:, 0], _COMPLETED)):
        above.plot(joints[mask, 0, 0], joints[mask, 0, 1], ".", color=colour, markersize=3)
    above.set(title="pelvis from above, world, m", xlabel="x", ylabel="y", aspect="equal")
    above.grid(alpha=0.25)
    return figure


def draw_misfit(fits: Sequence[tuple[int, NDArray[np.int64], Floats, Any]], unit: str) -> Figure:
    """Draw the distances between fitted and observed joints, in ``unit``.

    Each of ``fits`` has a body's id, stamps (T,) in nanoseconds, and distances (T, 22); its fourth entry is not used.
    """
    from matplotlib.colors import PowerNorm
    from matplotlib.figure import Figure

    shown = fits[:6]
    figure = Figure(figsize=(9, 1.2 + 2.6 * len(shown)), layout="constrained")
    for axis, (body, stamps, misfit, _) in zip(figure.subplots(len(shown), 1, squeeze=False)[:, 0], shown, strict=True):
        seconds = (stamps[[0, -1]] - fits[0][1][0]) * 1e-9
        image = axis.imshow(
            misfit.T, aspect="auto", interpolation="nearest", extent=(*seconds, len(JOINTS) - 0.5, -0.5), cmap="magma",
            norm=PowerNorm(0.5, vmin=0.0),  # an outlier must not hide the other residuals
        )  # fmt: skip
        axis.set_yticks(range(len(JOINTS)), JOINTS, fontsize=6)
        axis.set(title=f"body {body}: distance between fitted and observed joints (white: not observed)")
        axis.set_xlabel("time, s")
        figure.colorbar(image, ax=axis, label=f"distance, {unit}")
    return figure
