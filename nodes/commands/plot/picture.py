"""The picture of what happened in a recording: a strip of figures, panels over time, the way, and a summary."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from steadypose.msgs.topics import POSE_CLEAN
from steadypose.nodes.commands.plot.errors import errors_of
from steadypose.nodes.commands.plot.history import History
from steadypose.nodes.commands.plot.overview import draw_by_joint, draw_path, draw_stick_figures, draw_summary
from steadypose.nodes.commands.plot.panels import panels_over_time

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STRIP = 2.8
TITLE = 0.45
"""inches: the strip of figures, and the title of a panel"""
PICTURES = (".png", ".svg", ".pdf")


class PlotError(ValueError):
    """What was asked for cannot be drawn. The text says why."""


def body_of(history: History, body: int | None) -> int:
    """The body to draw: the one asked for, or the one seen the longest.

    Raises:
        PlotError: there is none, or no such.
    """
    chosen = history.longest() if body is None else body
    if chosen is None:
        raise PlotError(f"{history.name}: expected bodies on a pose topic, found none; there is nothing to draw")
    if chosen not in history.bodies:
        raise PlotError(f"body: expected one of {history.bodies}, got {chosen}")
    return chosen


def check_picture(output: Path, endings: tuple[str, ...] = PICTURES) -> None:
    """Raises:
    PlotError: this is no name for a picture, or its folder is not there.
    """
    if output.suffix not in endings:
        raise PlotError(f"output: expected a name ending in {', '.join(endings[:-1])} or {endings[-1]}, got {output}")
    if not output.resolve().parent.is_dir():
        raise PlotError(f"output: {output.resolve().parent} is no directory; make it first")


def save(figure: Figure, output: Path) -> None:
    """Write a picture; raises as `check_picture`."""
    check_picture(output)
    figure.savefig(output, dpi=110)


def draw(history: History, body: int | None = None) -> Figure:
    """Draw one body, and the way over the floor of all.

    Raises:
        PlotError: as `body_of`.
    """
    from matplotlib.figure import Figure

    chosen, bodies = body_of(history, body), history.bodies
    errors = errors_of(history, chosen)
    panels = panels_over_time(history, chosen, errors)
    heights = [panel.height + TITLE for panel in panels]
    body_height = max(sum(heights), 9.0)
    figure = Figure(figsize=(16, STRIP + body_height), layout="constrained")
    figure.suptitle(f"{history.name} · {history.origin} · body {chosen} of {len(bodies)}", fontsize=14, weight="bold")
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
            ax.set_xlabel("seconds of capture")
    beside = columns[1].subgridspec(3, 1, height_ratios=[2, 2, 1.2])
    draw_path(figure.add_subplot(beside[0]), history, chosen)
    draw_by_joint(figure.add_subplot(beside[1]), history.track(POSE_CLEAN, chosen), errors)
    draw_summary(figure.add_subplot(beside[2]), history, chosen, errors)
    return figure
