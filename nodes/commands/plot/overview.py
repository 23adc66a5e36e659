"""What stands above and beside the panels over time: stick figures, the way over the floor, each joint, a summary."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.topics import POSE_CLEAN, POSE_RAW, POSE_TRUTH, POSE_WORLD
from steadypose.msgs.types import CONTACTS, JOINTS, JointState
from steadypose.nodes.commands.plot.errors import TrackError, nan_mean
from steadypose.nodes.commands.plot.history import History, Track
from steadypose.nodes.commands.plot.panels import AXIS_COLOURS, TOPIC_COLOURS, corrections, with_gaps
from steadypose.nodes.sinks.drawing import (
    ALL_BONES,
    CLEAN_COLOUR,
    CONTACT_INDICES,
    RAW_COLOUR,
    STATE_COLOURS,
    TRUTH_COLOUR,
    WORLD_COLOUR,
    bone_states,
    bones,
    facing,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LATE_RATIO = 1.5
"""times the usual interval from which on a frame counts as late"""
FIGURES = 12
CONTACT_PROBABILITY = 0.5


def draw_stick_figures(ax: Axes, history: History, body: int) -> None:
    """Stick figures at even times, seen from the front: what came in behind what came out."""
    clean = history.track(POSE_CLEAN, body)
    track = next(
        t for topic in (POSE_CLEAN, POSE_WORLD, POSE_RAW, POSE_TRUTH) if (t := history.track(topic, body)) is not None
    )
    raw_bones = bones(history.observable)
    chosen = np.linspace(0, len(track.time) - 1, min(FIGURES, len(track.time))).round().astype(int)
    front = next((f for row in chosen if (f := facing(track.positions[row])) is not None), np.array([1.0, 0.0, 0.0]))
    across = np.array([-front[1], front[0], 0.0])

    def flat(points: NDArray[np.float64], pelvis: NDArray[np.float64], place: float) -> NDArray[np.float64]:
        return np.stack([place + (points - pelvis) @ across, points[:, 2] - pelvis[2]], axis=1)

    for place, row in enumerate(chosen):
        points = track.positions[row]
        pelvis = points[0] if np.isfinite(points[0]).all() else np.nanmean(points, axis=0)
        if clean is not None:
            _sticks(ax, flat(clean.raw[row], pelvis, place), raw_bones, RAW_COLOUR, width=5.0, alpha=0.55)
            colours = [STATE_COLOURS[JointState(state)] for state in bone_states(clean.state[row])]
            _sticks(ax, flat(points, pelvis, place), ALL_BONES, colours, width=2.0)
        else:
            _sticks(ax, flat(points, pelvis, place), raw_bones, RAW_COLOUR, width=2.5)
        ax.text(place, -1.13, f"{track.time[row]:.1f} s", ha="center", fontsize=8)
    ax.set_aspect("equal")
    ax.set_xlim(-0.6, FIGURES - 0.4)
    ax.set_ylim(-1.2, 0.85)
    ax.axis("off")


def _sticks(
    ax: Axes,
    points: NDArray[np.float64],
    pairs: NDArray[np.intp],
    colours: str | list[str],
    *,
    width: float,
    alpha: float = 1.0,
) -> None:
    from matplotlib.collections import LineCollection

    lines = points[pairs]
    shown = np.isfinite(lines).all(axis=(1, 2))
    picked = colours if isinstance(colours, str) else [colours[bone] for bone in np.flatnonzero(shown)]
    ax.add_collection(
        LineCollection(list(lines[shown]), colors=picked, linewidths=width, alpha=alpha, capstyle="round")
    )


def draw_path(ax: Axes, history: History, body: int) -> None:
    """The way over the floor from above, feet where they stood."""
    ax.set_title("from above, m", loc="left", fontsize=10, weight="bold")
    topic = next(t for t in (POSE_WORLD, POSE_CLEAN, POSE_RAW, POSE_TRUTH) if t in history.tracks)
    for person in history.tracks.get(POSE_TRUTH, {}).values():
        _, way = with_gaps(person.time, person.positions[:, 0, :2])
        ax.plot(*way.T, color=TRUTH_COLOUR, linewidth=3, alpha=0.35)
    for other, track in history.tracks[topic].items():
        pelvis = track.positions[:, 0, :2]
        _, way = with_gaps(track.time, pelvis)
        ax.plot(*way.T, color=WORLD_COLOUR if other == body else RAW_COLOUR, linewidth=1.5)
        seen = np.flatnonzero(np.isfinite(pelvis[:, 0]))
        if len(seen):
            ax.annotate(f"{other}", tuple(pelvis[seen[0]]), fontsize=8, textcoords="offset points", xytext=(4, 4))
            ax.plot(*pelvis[seen[0]], "o", color="black", markersize=4)
    world = history.track(POSE_WORLD, body)
    if world is not None:
        for side, colour in (("left", AXIS_COLOURS["y"]), ("right", AXIS_COLOURS["x"])):
            places = [row for row, name in enumerate(CONTACTS) if name in (f"{side}_ankle", f"{side}_foot")]
            touching = world.contacts[:, places] > CONTACT_PROBABILITY
            spots = world.positions[:, CONTACT_INDICES[places], :2][touching]
            ax.plot(*spots.T, ".", color=colour, markersize=3, alpha=0.5, label=f"{side} foot down", zorder=0)
    handles, _ = ax.get_legend_handles_labels()
    if handles:
        ax.legend(loc="best", fontsize=7, markerscale=3)
    ax.set_aspect("equal", adjustable="datalim")
    ax.grid(alpha=0.25)


def draw_by_joint(ax: Axes, clean: Track | None, errors: dict[str, TrackError]) -> None:
    """Each joint's mean distance from the truth or, where that is unknown, from what the sensor said."""
    if errors:
        title = "by joint: mean distance from the truth, cm"
        bars = {topic.removeprefix("pose/"): (error.by_joint, TOPIC_COLOURS[topic]) for topic, error in errors.items()}
    elif clean is not None:
        title = "by joint: mean correction, cm"
        bars = {"correction": (nan_mean(corrections(clean), axis=0), CLEAN_COLOUR)}
    else:
        ax.axis("off")
        return
    width = 0.8 / len(bars)
    for place, (label, (metres, colour)) in enumerate(bars.items()):
        ax.barh(np.arange(len(JOINTS)) + place * width, metres * 100, height=width, color=colour, label=label)
    ax.set_title(title, loc="left", fontsize=10, weight="bold")
    ax.set_yticks(np.arange(len(JOINTS)) + 0.4 - width / 2, JOINTS, fontsize=7)
    ax.invert_yaxis()
    ax.grid(axis="x", alpha=0.25)
    if errors:
        ax.legend(loc="lower right", fontsize=7)


def draw_summary(ax: Axes, history: History, body: int, errors: dict[str, TrackError]) -> None:
    ax.axis("off")
    lines = []
    for topic, stamps in history.stamps.items():
        if len(stamps) > 1:
            steps = np.diff(stamps)
            usual = np.median(steps)
            late = int((steps > LATE_RATIO * usual).sum())
            rate = (len(stamps) - 1) / (stamps[-1] - stamps[0]) if stamps[-1] > stamps[0] else np.nan
            longest = f"longest {steps.max() * 1e3:.0f} ms"
            lines.append(f"{topic:<10} {len(stamps):>5} frames {rate:5.1f} Hz {late:>3} late, {longest}")
    clean = history.track(POSE_CLEAN, body)
    if clean is not None:
        shares = [f"{state.name.lower()} {(clean.state == state).mean():.1%}" for state in JointState]
        lines += ["", f"joints of body {body}:", "  " + "  ".join(shares)]
    for key, name in (("jitter_mm", "from frame to frame"), ("slow_error_mm", "slow")):
        if found := history.sensor.get(key):
            lines.append(f"sensor's error, {name}: {np.median(found):.1f} mm along an axis")
    for topic, error in errors.items():
        mean, p95 = 100 * error.mean.mean(), 100 * np.percentile(error.mean, 95)
        lines.append(f"error {topic:<10} mean {mean:5.1f}  p95 {p95:5.1f} cm")
    if errors and not history.calibrated:
        lines.append("(the camera's place is unknown: moved to where it fits best)")
    silence = "nothing dropped or refused" if history.reported else "no diagnostics were recorded"
    lines += ["", "dropped and refused:" if history.dropped_or_refused else silence]
    lines += [f"  {count:>6}  {cause}" for cause, count in history.dropped_or_refused.most_common(14)]
    ax.text(-0.2, 1, "\n".join(lines), va="top", family="monospace", fontsize=8, transform=ax.transAxes)
