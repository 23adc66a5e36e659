"""``steadypose plot``: what happened in a recording, as one picture, or as a video.

Panels that a recording has nothing for are left out, so that one of `pose/raw` alone is drawn too. One body is
drawn, the one seen the longest unless another is asked for; the trajectory over the floor is that of all of them.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from steadypose.msgs.topics import POSE_CLEAN
from steadypose.nodes.commands.plot_history import History, PlotError, body_of, errors_of, history_of_path
from steadypose.nodes.commands.plot_panels import (
    draw_by_joint,
    draw_path,
    draw_stick_figures,
    draw_summary,
    panels_over_time,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def plot(
    recording: Annotated[Path, tyro.conf.Positional],
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE")] = None,
    body: int | None = None,
    video: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    over: Annotated[Path | None, tyro.conf.arg(metavar="VIDEO")] = None,
) -> None:
    """Draw what happened in a recording.

    Args:
        recording: rosbag2 directory, or one .mcap, with any of pose/raw, pose/clean, pose/world, pose/truth; or an .npz
            or .csv, as `clean` reads and writes them.
        output: picture to write: .png, .svg or .pdf; named after the recording, in this folder, if left out.
        body: id of the body to draw; the one seen the longest if left out.
        video: moving picture to write instead, .gif or .mp4 (the latter by OpenCV, which the extra 'oak' brings): raw
            beside clean beside world, as far as the recording has them.
        over: the video that was cleaned, as in 'steadypose clean walk.mp4 walk': with --video, raw (which an .npz
            lacks) and clean are drawn over its images. A camera of the field of view that 'clean' takes is assumed.

    Raises:
        RecordingError: the recording cannot be read.
        PlotError: there is nothing to draw, no such body, or nowhere to write to.
    """
    import matplotlib  # first of all: what is not installed is said before anything else

    matplotlib.use("Agg")
    _refuse_folder(recording)
    if over is not None and video is None:
        raise PlotError("over: expected a video to write as well: --video FILE.mp4")
    if video is not None:
        from steadypose.nodes.commands.plot_video import VIDEOS, write_overlay, write_video

        check_picture(video, VIDEOS)
        if over is not None:
            frames = write_overlay(recording, over, video, body)
        else:
            frames = write_video(history_of_path(recording), video, body)
        print(f"wrote {video}: {frames} frames")
        return
    output = output or Path(f"{recording.resolve().stem}.png")
    check_picture(output)
    save(draw(history_of_path(recording), body), output)
    print(f"wrote {output}")


def _refuse_folder(path: Path) -> None:
    """Raises:
    PlotError: the path is a folder of recordings, with which there are.
    """
    if path.is_dir() and not any(path.glob("*.mcap")) and (inside := sorted({f.parent for f in path.glob("*/*.mcap")})):
        names = ", ".join(str(found) for found in inside[:4])
        raise PlotError(f"{path}: expected one recording, got a folder of {len(inside)}; name one, such as {names}")


STRIP = 2.8
TITLE = 0.45
"""inches: the strip of figures, and the title of a panel"""
PICTURES = (".png", ".svg", ".pdf")


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
