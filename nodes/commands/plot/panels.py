"""The panels over time."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.topics import POSE_CLEAN, POSE_RAW, POSE_TRUTH, POSE_WORLD
from steadypose.msgs.types import CONTACTS, JOINTS, JointState, Tracking
from steadypose.nodes.commands.plot.errors import TrackError, nan_mean
from steadypose.nodes.commands.plot.history import History, Track
from steadypose.nodes.sinks.drawing import (
    ALARM_COLOUR,
    CLEAN_COLOUR,
    RAW_COLOUR,
    STATE_COLOURS,
    TRUTH_COLOUR,
    WORLD_COLOUR,
)
from steadypose.prior.body.skeleton import J

if TYPE_CHECKING:
    from matplotlib.axes import Axes

GAP_S = 0.2
"""a line is not drawn across a longer gap"""
JOINTS_SHOWN = 3
TOPIC_COLOURS = {
    POSE_TRUTH: TRUTH_COLOUR,
    POSE_RAW: RAW_COLOUR,
    POSE_CLEAN: CLEAN_COLOUR,
    POSE_WORLD: WORLD_COLOUR,
}
AXIS_COLOURS = {"x": "#882255", "y": "#44aa99", "z": "#332288"}


class Panel(NamedTuple):
    title: str
    height: float
    draw: Callable[[Axes], None]


def panels_over_time(history: History, body: int, errors: dict[str, TrackError]) -> list[Panel]:
    """The panels over time that this recording has something for."""
    raw, clean, world = (history.track(topic, body) for topic in (POSE_RAW, POSE_CLEAN, POSE_WORLD))
    panels: list[Panel] = []
    if clean is not None:
        for joint in busiest_joints(clean):
            panels.append(
                Panel(f"{JOINTS[joint]} from the pelvis, m", 1.25, lambda ax, j=joint: _draw_joint(ax, clean, j))
            )
        panels.append(Panel("where each joint comes from", 3.0, lambda ax: _draw_states(ax, clean)))
        panels.append(Panel("standard deviation, cm", 0.8, lambda ax: _draw_sigma(ax, clean)))
        if np.isfinite(clean.anomaly).any():
            panels.append(Panel("anomaly score", 0.8, lambda ax: _draw_anomaly(ax, clean)))
    elif raw is not None:
        for joint in (J["left_wrist"], J["right_wrist"], J["left_ankle"]):
            panels.append(Panel(f"{JOINTS[joint]}, world, m", 1.25, lambda ax, j=joint: _draw_raw_joint(ax, raw, j)))
        panels.append(Panel("joints the sensor gave", 3.0, lambda ax: _draw_observed(ax, raw, history.observable)))
    if world is not None:
        panels.append(Panel("contacts", 1.0, lambda ax: _draw_contacts(ax, world)))
    if errors:
        panels.append(
            Panel(
                "distance of a joint from the truth, cm (mean of those given)",
                1.25,
                lambda ax: _draw_errors(ax, errors),
            )
        )
    panels.append(Panel("from frame to frame, ms", 1.0, lambda ax: _draw_intervals(ax, history)))
    return panels


def busiest_joints(clean: Track) -> list[int]:
    """The joints to show: of hands, feet and head those most often missing, then most corrected."""
    limbs = [J[name] for name in ("left_wrist", "right_wrist", "left_ankle", "right_ankle", "head")]
    missing = (clean.state == JointState.IMPUTED).mean(axis=0).round(2)
    correction = np.nan_to_num(nan_mean(corrections(clean), axis=0))
    return sorted(limbs, key=lambda joint: (-missing[joint], -correction[joint]))[:JOINTS_SHOWN]


def corrections(clean: Track) -> NDArray[np.float64]:
    """(T, 22) metres between input and output; NaN where there was no input."""
    return np.linalg.norm(clean.positions - clean.raw, axis=2)


def with_gaps(time: NDArray[np.float64], *columns: NDArray) -> list[NDArray]:
    """Time and columns with a NaN wherever nothing came for a while, so that no line bridges it."""
    gaps = np.flatnonzero(np.diff(time) > GAP_S) + 1
    return [
        np.insert(time, gaps, np.nan),
        *(np.insert(column.astype(float), gaps, np.nan, axis=0) for column in columns),
    ]


def _draw_joint(ax: Axes, clean: Track, joint: int) -> None:
    pelvis = clean.positions[:, :1]
    time, before, after = with_gaps(clean.time, (clean.raw - pelvis)[:, joint], (clean.positions - pelvis)[:, joint])
    for axis, (name, colour) in enumerate(AXIS_COLOURS.items()):
        ax.plot(time, before[:, axis], ".", color=colour, markersize=2.5, alpha=0.35, label=f"{name} raw")
        ax.plot(time, after[:, axis], color=colour, linewidth=1.3, label=f"{name} clean")
    ax.legend(loc="upper right", ncols=6, fontsize=7, markerscale=3, handlelength=1.2)
    low, high = np.nanmin(after), np.nanmax(after)
    ax.set_ylim(low - 0.25, high + 0.45)


def _draw_raw_joint(ax: Axes, raw: Track, joint: int) -> None:
    for axis, (name, colour) in enumerate(AXIS_COLOURS.items()):
        ax.plot(raw.time, raw.positions[:, joint, axis], ".", color=colour, markersize=3, label=name)
    ax.legend(loc="upper right", ncols=3, fontsize=7)


def _draw_states(ax: Axes, clean: Track) -> None:
    _draw_cells(ax, clean.time, clean.state, {state.name.lower(): colour for state, colour in STATE_COLOURS.items()})
    ax.set_yticks(range(len(JOINTS)), JOINTS, fontsize=6)


def _draw_observed(ax: Axes, raw: Track, observable: NDArray[np.bool_]) -> None:
    seen = np.isfinite(raw.positions[:, observable, 0])
    colours = {"missing": STATE_COLOURS[JointState.UNKNOWN], "given": STATE_COLOURS[JointState.SEEN]}
    _draw_cells(ax, raw.time, seen.astype(np.uint8), colours)
    names = [JOINTS[joint] for joint in np.flatnonzero(observable)]
    ax.set_yticks(range(len(names)), names, fontsize=6)


def _draw_cells(ax: Axes, time: NDArray[np.float64], cells: NDArray[np.uint8], colours: dict[str, str]) -> None:
    """A row for each column of ``cells`` (T, N), of the colour that is its value's place in ``colours``; white where
    nothing came."""
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    time, values = with_gaps(time, cells)
    hole = np.isnan(time)
    time[hole] = time[np.flatnonzero(hole) - 1] + 1 / 30
    edges = np.append(time, time[-1] + 1 / 30)
    palette = ListedColormap(list(colours.values()))
    ax.pcolormesh(
        edges, np.arange(values.shape[1] + 1) - 0.5, values.T, cmap=palette, vmin=-0.5, vmax=len(colours) - 0.5
    )
    ax.invert_yaxis()
    handles = [Patch(color=colour, label=label) for label, colour in colours.items()]
    ax.legend(handles=handles, loc="lower right", bbox_to_anchor=(1, 1), ncols=len(handles), fontsize=7, frameon=False)


def _draw_sigma(ax: Axes, clean: Track) -> None:
    time, middle, worst = with_gaps(clean.time, np.median(clean.sigma, axis=1) * 100, clean.sigma.max(axis=1) * 100)
    ax.plot(time, worst, color=STATE_COLOURS[JointState.IMPUTED], linewidth=1, label="worst joint")
    ax.plot(time, middle, color=CLEAN_COLOUR, linewidth=1, label="median joint")
    ax.legend(loc="upper right", ncols=2, fontsize=7)
    ax.set_ylim(bottom=0)


def _draw_anomaly(ax: Axes, clean: Track) -> None:
    time, score = with_gaps(clean.time, clean.anomaly)
    ax.plot(time, score, color=CLEAN_COLOUR, linewidth=1)
    ax.plot(clean.time[clean.flag], clean.anomaly[clean.flag], ".", color=ALARM_COLOUR, markersize=4, label="flagged")
    if clean.flag.any():
        ax.legend(loc="upper right", fontsize=7)


def _draw_contacts(ax: Axes, world: Track) -> None:
    time, contacts, tracking = with_gaps(world.time, world.contacts, world.tracking)
    for row in range(len(CONTACTS)):
        ax.fill_between(time, row, row + 0.85 * np.clip(contacts[:, row], 0, 1), color=WORLD_COLOUR, linewidth=0)
    for state, colour in ((Tracking.COASTING, STATE_COLOURS[JointState.IMPUTED]), (Tracking.LOST, ALARM_COLOUR)):
        here = tracking == state
        if here.any():
            label = state.name.lower()
            ax.fill_between(time, 0, len(CONTACTS), where=here, color=colour, alpha=0.2, linewidth=0, label=label)
            ax.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, fontsize=7, frameon=False)
    ax.set_yticks(np.arange(len(CONTACTS)) + 0.4, CONTACTS, fontsize=6)
    ax.set_ylim(len(CONTACTS), 0)


def _draw_errors(ax: Axes, errors: dict[str, TrackError]) -> None:
    for topic, error in errors.items():
        time, distance = with_gaps(error.time, error.mean * 100)
        label = f"{topic.removeprefix('pose/')}: mean {error.mean.mean() * 100:.1f} cm"
        ax.plot(time, distance, color=TOPIC_COLOURS[topic], linewidth=1.2, label=label)
    ax.legend(loc="upper right", ncols=3, fontsize=7)
    ax.set_ylim(0, 1.4 * max(np.percentile(error.mean, 99) * 100 for error in errors.values()))


def _draw_intervals(ax: Axes, history: History) -> None:
    for topic, colour in TOPIC_COLOURS.items():
        stamps = history.stamps.get(topic, np.zeros(0))
        if len(stamps) > 1:
            ax.plot(
                stamps[1:], np.diff(stamps) * 1e3, ".", color=colour, markersize=3, label=topic.removeprefix("pose/")
            )
    ax.legend(loc="upper right", ncols=3, fontsize=7, markerscale=3)
    ax.set_yscale("log")
    ax.set_yticks([10, 30, 100, 300, 1000], ["10", "30", "100", "300", "1000"])
    ax.minorticks_off()
