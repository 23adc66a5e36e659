"""``steadypose plot --video``: a video of a body side by side as raw, clean and world poses.

Left and right have different colours. Joints that are not observed in a frame are drawn faintly.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from steadypose.msgs.topics import POSE_CLEAN, POSE_RAW, POSE_WORLD
from steadypose.msgs.types import OBSERVED
from steadypose.nodes.extras import how_to_install
from steadypose.nodes.sinks.drawing import (
    ALL_BONES,
    CONTACT_COLOUR,
    CONTACT_INDICES,
    FAINT,
    LEFT_COLOUR,
    MIDDLE_COLOUR,
    RIGHT_COLOUR,
    SIDES,
    bones,
    facing,
)
from steadypose.nodes.sinks.plot.history import History, PlotError, Track, body_of
from steadypose.nodes.sinks.plot.panels import draw_bones
from steadypose.prior.arrays import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes

VIDEOS = (".gif", ".mp4")
FPS = 15  # frame rate of the video, Hz. Half of the poses' rate is smooth enough.
PANEL_INCHES, STAGE_WIDTH, DPI = (2.3, 3.4), 1.6, 80
"""Size of a panel in inches; relative width of the world's panel; resolution in dots per inch."""
GHOST, FLOOR = "#cfcfcf", "#e6e6e6"
SIDE_COLOURS = (LEFT_COLOUR, RIGHT_COLOUR, MIDDLE_COLOUR)
ELEVATION = 0.22  # angle by which the view looks down, radians
TURNED = 0.5  # angle by which the view is rotated from the front, radians
TALL = 1.8  # height of the space shown above the floor, metres
PATH_FRAMES = 150  # length of the drawn path over the floor, frames
SHADES = (1.0, 0.8, 0.6, 0.45, 0.3, 0.15)
"""Opacities on white of each colour in a GIF's palette. They are few, and the same in all frames, to avoid flicker."""


def write_overlay(recording: Path, video: Path, path: Path, body: int | None = None) -> int:
    """Write a video's cleaned skeletons over its images, in the format of the suffix; returns the number of frames.

    Raises PlotError if OpenCV is not installed, or as `overlay.overlaid`.
    """
    try:
        from steadypose.nodes.sinks.plot.overlay import overlaid
    except ModuleNotFoundError as error:
        raise PlotError(f"over: {how_to_install([error.name or ''], 'oak')}") from error
    frames, fps = overlaid(recording, video, body)
    return _write_gif(frames, path, fps, shades=False) if path.suffix == ".gif" else _write_mp4(frames, path, fps)


def write_video(history: History, path: Path, body: int | None = None) -> int:
    """Write the video of one body at about `FPS`, in the format of the suffix; returns the number of frames.

    Raises PlotError if there is nothing to draw, no such body or, for an .mp4, OpenCV is not installed.
    """
    chosen = body_of(history, body)
    lead = next(t for topic in (POSE_CLEAN, POSE_WORLD, POSE_RAW) if (t := history.track(topic, chosen)) is not None)
    period = max(float(np.median(np.diff(lead.time))), 1e-3) if len(lead.time) > 1 else 1.0 / FPS
    step = max(round(1.0 / FPS / period), 1)
    frames = _frames(history, chosen, lead, step)
    count = (_write_gif if path.suffix == ".gif" else _write_mp4)(frames, path, 1.0 / (step * period))
    if not count:
        raise PlotError(f"{history.name}: expected frames in which body {chosen} is seen, found none")
    return count


def seen_from(front: Floats) -> Floats:
    """(3, 2) matrix that projects the world's points, (..., 3) metres, to the image's right and up, (..., 2) metres.

    The viewer is in the direction ``front`` (3,), a horizontal unit vector, rotated by `TURNED`.
    """
    cos, sin = np.cos(TURNED), np.sin(TURNED)
    toward = np.array([cos * front[0] - sin * front[1], sin * front[0] + cos * front[1], 0.0])
    up = np.cos(ELEVATION) * np.array([0.0, 0.0, 1.0]) - np.sin(ELEVATION) * toward
    return np.stack([[-toward[1], toward[0], 0.0], up], axis=1)


def _frames(history: History, body: int, lead: Track, step: int) -> Iterator[NDArray[np.uint8]]:
    """RGB images (H, W, 3) of every ``step``-th row of the leading track."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    raw, clean, world = (history.track(topic, body) for topic in (POSE_RAW, POSE_CLEAN, POSE_WORLD))
    view = seen_from(next((f for row in lead.positions if (f := facing(row)) is not None), np.array([1.0, 0.0, 0.0])))
    draws: dict[str, Callable[[Axes, int], None]] = {}
    if clean is not None:
        if np.isfinite(clean.raw).any():
            shown = bones(history.observable)
            draws["raw"] = _follower(clean, view, lambda ax, row: _raw(ax, view, clean, row, shown))
        draws["clean"] = _follower(clean, view, lambda ax, row: _sticks(ax, view, clean, row))
    elif raw is not None and world is None:
        draws["raw"] = _follower(raw, view, lambda ax, row: _sticks(ax, view, raw, row, bones(history.observable)))
    if world is not None:
        at = np.searchsorted(world.time, lead.time - 1e-6).clip(0, len(world.time) - 1)
        draws["world"] = _stage(world, at, view)
    width, height = PANEL_INCHES
    widths = [STAGE_WIDTH if title == "world" else 1.0 for title in draws]
    figure = Figure(figsize=(width * sum(widths), height), dpi=DPI)
    axes = figure.subplots(1, len(draws), squeeze=False, width_ratios=widths)[0]
    figure.subplots_adjust(0.0, 0.085, 1.0, 0.93, wspace=0.0)
    for number, title in enumerate(draws):
        middle = (sum(widths[:number]) + widths[number] / 2) / sum(widths)
        figure.text(middle, 0.985, title, ha="center", va="top", fontsize=11, weight="bold")
    canvas = FigureCanvasAgg(figure)
    states = clean is not None or world is not None
    faint = Line2D([], [], color=MIDDLE_COLOUR, lw=3, alpha=FAINT, label="faint: not observed")
    handles = [
        Line2D([], [], color=c, lw=3, label=side) for side, c in (("left", LEFT_COLOUR), ("right", RIGHT_COLOUR))
    ]
    handles += [faint] if states else []
    if world is not None:
        handles.append(Line2D([], [], color=CONTACT_COLOUR, marker="o", lw=0, label="contact"))
    figure.legend(handles=handles, loc="lower center", ncols=4, frameon=False, fontsize=9, borderaxespad=0.1)
    for row in range(0, len(lead.time), step):
        for ax, draw in zip(axes, draws.values(), strict=True):
            ax.clear()
            draw(ax, row)
            ax.set_aspect("equal", adjustable="box")
            ax.axis("off")
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _follower(track: Track, view: Floats, draw: Callable[[Axes, int], None]) -> Callable[[Axes, int], None]:
    """A function that draws a panel filled by the body, which stays in its middle."""
    middle = _smooth(np.nanmean(np.where(np.isfinite(track.positions), track.positions, np.nan), axis=1))
    low, high = np.nanpercentile(track.positions[..., 2], (1, 99)) if len(track.time) else (0.0, 1.8)
    middle[:, 2] = (low + high) / 2
    half = 0.58 * max(float(high - low), 0.5)

    def panel(ax: Axes, row: int) -> None:
        draw(ax, row)
        centre = middle[row] @ view
        aspect = PANEL_INCHES[0] / (0.845 * PANEL_INCHES[1])
        ax.set_xlim(centre[0] - half * aspect, centre[0] + half * aspect)
        ax.set_ylim(centre[1] - half, centre[1] + half)

    return panel


def _stage(world: Track, at: NDArray[np.intp], view: Floats) -> Callable[[Axes, int], None]:
    """A function that draws the body at its position on the floor, with its path."""
    floor = float(np.nanpercentile(world.positions[..., 2].min(axis=1), 5))
    root = world.positions[:, 0] * [1.0, 1.0, 0.0] + [0.0, 0.0, floor]
    low, high = np.nanmin(root[:, :2], axis=0) - 0.4, np.nanmax(root[:, :2], axis=0) + 0.4
    across, along = (np.linspace(low[axis], high[axis], 7) for axis in (0, 1))
    lines = [np.array([[x, low[1], floor], [x, high[1], floor]]) for x in across]
    lines += [np.array([[low[0], y, floor], [high[0], y, floor]]) for y in along]
    corners = [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (floor, floor + TALL)]
    corners = np.array(corners) @ view
    (left, bottom), (right, top) = corners.min(axis=0), corners.max(axis=0)

    def panel(ax: Axes, row: int) -> None:
        from matplotlib.collections import LineCollection

        here = int(at[row])
        ax.add_collection(LineCollection([line @ view for line in lines], colors=FLOOR, linewidths=0.8))
        ax.plot(*(root[max(here - PATH_FRAMES, 0) : here + 1] @ view).T, color=MIDDLE_COLOUR, lw=1.2, alpha=FAINT)
        _sticks(ax, view, world, here)
        loaded = world.positions[here, CONTACT_INDICES[world.contacts[here] > 0.5]]
        ax.plot(*(loaded @ view).T, "o", color=CONTACT_COLOUR, markersize=4, markeredgewidth=0)
        ax.set_xlim(left, right)
        ax.set_ylim(bottom, top)

    return panel


def _raw(ax: Axes, view: Floats, clean: Track, row: int, shown: NDArray[np.intp]) -> None:
    draw_bones(ax, clean.positions[row] @ view, ALL_BONES, GHOST, width=2.0)
    draw_bones(ax, clean.raw[row] @ view, shown, _sides(shown), width=3.0)


def _sticks(ax: Axes, view: Floats, track: Track, row: int, shown: NDArray[np.intp] = ALL_BONES) -> None:
    opacity = np.ones(len(shown))
    if track.state.size:
        observed = np.isin(track.state[row], OBSERVED)
        opacity = np.where(observed[shown].all(axis=1), 1.0, FAINT)
    draw_bones(ax, track.positions[row] @ view, shown, _sides(shown), width=3.0, alpha=opacity)


def _sides(shown: NDArray[np.intp]) -> list[str]:
    return [SIDE_COLOURS[side] for side in SIDES[shown[:, 1]]]


def _smooth(path: Floats, frames: int = 15) -> Floats:
    """(T, 3) path with gaps filled, averaged over ``frames``, so that a view that follows it does not shake."""
    rows = np.arange(len(path))
    filled = np.zeros_like(path)
    for axis in range(path.shape[1]):
        known = np.isfinite(path[:, axis])
        filled[:, axis] = np.interp(rows, rows[known], path[known, axis]) if known.any() else 0.0
    return uniform_filter1d(filled, frames, axis=0, mode="nearest")


def _palette() -> list[int]:
    """A palette as a list of red, green and blue, 0 to 255, of each colour in turn."""
    from matplotlib.colors import to_rgb

    colours = [np.array(to_rgb(name)) for name in (*SIDE_COLOURS, CONTACT_COLOUR, "black")]
    shades = [1.0 - shade * (1.0 - colour) for colour in colours for shade in SHADES]
    return np.round(255 * np.array([np.ones(3), *shades])).astype(int).ravel().tolist()


def _write_gif(frames: Iterator[NDArray[np.uint8]], path: Path, fps: float, *, shades: bool = True) -> int:
    """Write a GIF with the palette of `SHADES`, or with one of each image. Returns the number of frames."""
    from PIL import Image

    images = [Image.fromarray(frame) for frame in frames]
    if not images:
        return 0
    if shades:
        palette = Image.new("P", (1, 1))
        palette.putpalette(_palette())
        images = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    first, *rest = images
    first.save(path, save_all=True, append_images=rest, duration=round(1000 / fps), loop=0, optimize=True)
    return len(images)


def _write_mp4(frames: Iterator[NDArray[np.uint8]], path: Path, fps: float) -> int:
    try:
        import cv2
    except ImportError as error:
        raise PlotError(f"{path}: {how_to_install(['cv2'], 'oak')}; or write a .gif") from error
    writer: Any = None
    count = 0
    for frame in frames:
        image = frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2, ::-1]
        if writer is None:
            codec = cv2.VideoWriter.fourcc(*"vp09")  # plays in browsers; pip's OpenCV has no H.264
            writer = cv2.VideoWriter(str(path), codec, fps, image.shape[1::-1])
            if not writer.isOpened():
                raise PlotError(f"{path}: this OpenCV cannot write VP9; write a .gif")
        writer.write(np.ascontiguousarray(image))
        count += 1
    if writer is not None:
        writer.release()
    return count
