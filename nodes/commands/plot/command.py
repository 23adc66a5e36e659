"""``steadypose plot``: what happened in a recording, as one picture.

Panels that a recording has nothing for are left out, so that one of `pose/raw` alone is drawn too. One body is
drawn, the one seen the longest unless another is asked for; the way over the floor is that of all of them.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from steadypose.msgs.topics import POSE_CLEAN
from steadypose.nodes.commands.plot.errors import errors_of
from steadypose.nodes.commands.plot.history import read_history
from steadypose.nodes.commands.plot.overview import draw_by_joint, draw_path, draw_stick_figures, draw_summary
from steadypose.nodes.commands.plot.panels import panels_over_time

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STRIP = 2.8
TITLE = 0.45
"""inches: the strip of figures, and the title of a panel"""


class PlotError(ValueError):
    """What was asked for cannot be drawn. The text says why."""


def plot(
    recording: Annotated[Path, tyro.conf.Positional],
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE")] = None,
    body: int | None = None,
) -> None:
    """Draw what happened in a recording.

    Args:
        recording: rosbag2 directory, or one .mcap, with any of pose/raw, pose/clean, pose/world, pose/truth.
        output: picture to write: .png, .svg or .pdf; named after the recording, in this folder, if left out.
        body: id of the body to draw; the one seen the longest if left out.

    Raises:
        RecordingError: the recording cannot be read.
        PlotError: there is nothing to draw, no such body, or nowhere to write to.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    output = output or Path(f"{recording.resolve().stem}.png")
    if output.suffix not in (".png", ".svg", ".pdf"):
        raise PlotError(f"output: expected a name ending in .png, .svg or .pdf, got {output}")
    if not output.resolve().parent.is_dir():
        raise PlotError(f"output: {output.resolve().parent} is no directory; make it first")
    _refuse_others(recording)
    history = read_history(recording)
    chosen = history.longest() if body is None else body
    if chosen is None:
        raise PlotError(f"{recording}: expected bodies on a pose topic, found none; there is nothing to draw")
    bodies = sorted({found for tracks in history.tracks.values() for found in tracks})
    if chosen not in bodies:
        raise PlotError(f"body: expected one of {bodies}, got {chosen}")

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
    figure.savefig(output, dpi=110)
    print(f"wrote {output}")


def _refuse_others(path: Path) -> None:
    """Raises:
    PlotError: the path is not one recording, with what to draw instead.
    """
    if path.suffix in (".npz", ".csv"):
        raise PlotError(
            f"{path}: expected a recording, got {path.suffix}, which is arrays; clean it into one: "
            f"steadypose clean {path} {path.stem}, then plot {path.stem}"
        )
    if path.is_dir() and not any(path.glob("*.mcap")) and (inside := sorted({f.parent for f in path.glob("*/*.mcap")})):
        names = ", ".join(str(found) for found in inside[:4])
        raise PlotError(f"{path}: expected one recording, got a folder of {len(inside)}; name one, such as {names}")
