"""The panels of a recording's figure: plots over time, stick figures, trajectory, joints, and a summary."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.topics import POSE_CLEAN, POSE_RAW, POSE_TRUTH, POSE_WORLD
from steadypose.msgs.types import CONTACTS, JOINTS, JointState, Tracking
from steadypose.nodes.sinks.drawing import (
    ALARM_COLOUR,
    ALL_BONES,
    CLEAN_COLOUR,
    CONTACT_INDICES,
    FAINT,
    RAW_COLOUR,
    STATE_COLOURS,
    TRUTH_COLOUR,
    WORLD_COLOUR,
    bone_states,
    bones,
    facing,
)
from steadypose.nodes.sinks.plot.history import History, Track, TrackError, nan_mean
from steadypose.prior.arrays import Floats
from steadypose.prior.body.skeleton import J

if TYPE_CHECKING:
    from matplotlib.axes import Axes

GAP_S = 0.2  # longest gap that a plotted line bridges, seconds
JOINTS_SHOWN = 3
TOPIC_COLOURS = {POSE_TRUTH: TRUTH_COLOUR, POSE_RAW: RAW_COLOUR, POSE_CLEAN: CLEAN_COLOUR, POSE_WORLD: WORLD_COLOUR}
AXIS_COLOURS = {"x": "#882255", "y": "#44aa99", "z": "#332288"}


class Panel(NamedTuple):
    title: str
    height: float
    draw: Callable[[Axes], None]


def panels_over_time(history: History, body: int, errors: dict[str, TrackError]) -> list[Panel]:
    """The panels over time for which the recording has data."""
    raw, clean, world = (history.track(topic, body) for topic in (POSE_RAW, POSE_CLEAN, POSE_WORLD))
    panels: list[Panel] = []
    if clean is not None:
        for joint in busiest_joints(clean):
            title = f"{JOINTS[joint]} relative to the pelvis, m"
            panels.append(Panel(title, 1.25, lambda ax, j=joint: _draw_joint(ax, clean, j)))
        panels.append(Panel("state of each joint", 3.0, lambda ax: _draw_states(ax, clean)))
        panels.append(Panel("standard deviation, cm", 0.8, lambda ax: _draw_sigma(ax, clean)))
        if np.isfinite(clean.anomaly).any():
            panels.append(Panel("anomaly score", 0.8, lambda ax: _draw_anomaly(ax, clean)))
    elif raw is not None:
        for joint in (J["left_wrist"], J["right_wrist"], J["left_ankle"]):
            panels.append(Panel(f"{JOINTS[joint]}, world, m", 1.25, lambda ax, j=joint: _draw_raw_joint(ax, raw, j)))
        panels.append(Panel("observed joints", 3.0, lambda ax: _draw_observed(ax, raw, history.observable)))
    if world is not None:
        panels.append(Panel("contacts", 1.0, lambda ax: draw_contacts(ax, world)))
    if errors:
        panels.append(Panel("position error, cm, mean over joints", 1.25, lambda ax: _draw_errors(ax, errors)))
    panels.append(Panel("interval between frames, ms", 1.0, lambda ax: _draw_intervals(ax, history)))
    return panels


def busiest_joints(clean: Track) -> list[int]:
    """The joints to show: those of hands, feet and head that are missing most often, then those corrected most."""
    limbs = [J[name] for name in ("left_wrist", "right_wrist", "left_ankle", "right_ankle", "head")]
    missing = (clean.state == JointState.IMPUTED).mean(axis=0).round(2)
    correction = np.nan_to_num(nan_mean(corrections(clean), axis=0))
    return sorted(limbs, key=lambda joint: (-missing[joint], -correction[joint]))[:JOINTS_SHOWN]


def corrections(clean: Track) -> NDArray[np.float64]:
    """(T, 22) distances between input and output, metres; NaN where there was no input."""
    return np.linalg.norm(clean.positions - clean.raw, axis=2)


def with_gaps(time: NDArray[np.float64], *columns: NDArray) -> list[NDArray]:
    """Time and columns with a NaN inserted in each longer gap, so that no line bridges it."""
    gaps = np.flatnonzero(np.diff(time) > GAP_S) + 1
    return [np.insert(column.astype(float), gaps, np.nan, axis=0) for column in (time, *columns)]


def _draw_joint(ax: Axes, clean: Track, joint: int) -> None:
    pelvis = clean.positions[:, :1]
    time, before, after = with_gaps(clean.time, (clean.raw - pelvis)[:, joint], (clean.positions - pelvis)[:, joint])
    for axis, (name, colour) in enumerate(AXIS_COLOURS.items()):
        if np.isfinite(before).any():
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
    colours = {"missing": STATE_COLOURS[JointState.UNKNOWN], "observed": STATE_COLOURS[JointState.SEEN]}
    _draw_cells(ax, raw.time, seen.astype(np.uint8), colours)
    names = [JOINTS[joint] for joint in np.flatnonzero(observable)]
    ax.set_yticks(range(len(names)), names, fontsize=6)


def _draw_cells(ax: Axes, time: NDArray[np.float64], cells: NDArray[np.uint8], colours: dict[str, str]) -> None:
    """Draw ``cells`` (T, N) as N rows, coloured by their values as indices into ``colours``; white in gaps."""
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    time, values = with_gaps(time, cells)
    hole = np.isnan(time)
    time[hole] = time[np.flatnonzero(hole) - 1] + 1 / 30
    edges = np.append(time, time[-1] + 1 / 30)
    palette, rows = ListedColormap(list(colours.values())), np.arange(values.shape[1] + 1) - 0.5
    ax.pcolormesh(edges, rows, values.T, cmap=palette, vmin=-0.5, vmax=len(colours) - 0.5)
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


def draw_contacts(ax: Axes, world: Track) -> None:
    """Draw the probability of each contact, grey where it is unknown, and when the root is not observed."""
    time, contacts, tracking = with_gaps(world.time, world.contacts, world.tracking)
    for row in range(len(CONTACTS)):
        ax.fill_between(time, row, row + 0.85 * np.clip(contacts[:, row], 0, 1), color=WORLD_COLOUR, linewidth=0)
    unknown = np.isnan(contacts)
    rows = np.flatnonzero((unknown[1:] & unknown[:-1]).any(axis=0)).tolist()  # a gap of the track is one NaN
    for row in rows:
        grey, label = STATE_COLOURS[JointState.UNKNOWN], "unknown" if row == rows[0] else None
        ax.fill_between(time, row, row + 0.85, where=unknown[:, row], color=grey, alpha=0.3, linewidth=0, label=label)
    for state, colour in ((Tracking.COASTING, STATE_COLOURS[JointState.IMPUTED]), (Tracking.LOST, ALARM_COLOUR)):
        here = tracking == state
        if here.any():
            label = state.name.lower()
            ax.fill_between(time, 0, len(CONTACTS), where=here, color=colour, alpha=0.2, linewidth=0, label=label)
    if ax.get_legend_handles_labels()[0]:
        ax.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=3, fontsize=7, frameon=False)
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
            label = topic.removeprefix("pose/")
            ax.plot(stamps[1:], np.diff(stamps) * 1e3, ".", color=colour, markersize=3, label=label)
    if ax.get_legend_handles_labels()[0]:
        ax.legend(loc="upper right", ncols=3, fontsize=7, markerscale=3)
    ax.set_yscale("log")
    ax.set_yticks([10, 30, 100, 300, 1000], ["10", "30", "100", "300", "1000"])
    ax.minorticks_off()


GAP_RATIO = 1.5  # interval between frames, relative to the median, above which it counts as a gap, ratio
FIGURES = 12
CONTACT_PROBABILITY = 0.5


def draw_stick_figures(ax: Axes, history: History, body: int) -> None:
    """Draw stick figures at regular times, seen from the front, with the input behind the output; bones to joints that
    the sensor lacks are faint."""
    from matplotlib.lines import Line2D

    clean = history.track(POSE_CLEAN, body)
    found = ((topic, history.track(topic, body)) for topic in (POSE_CLEAN, POSE_WORLD, POSE_RAW, POSE_TRUTH))
    topic, track = next((topic, track) for topic, track in found if track is not None)
    lines = {topic.removeprefix("pose/"): RAW_COLOUR}
    if clean is not None:
        lines = {"raw": RAW_COLOUR} if np.isfinite(clean.raw).any() else {}
        lines |= {f"clean: {state.name.lower()}": STATE_COLOURS[state] for state in JointState if state in clean.state}
    handles = [Line2D([], [], color=colour, lw=3, label=label) for label, colour in lines.items()]
    ax.legend(handles=handles, loc="upper left", bbox_to_anchor=(0, 1.12), ncols=5, fontsize=8, frameon=False)
    raw_bones = bones(history.observable)
    opacity = np.where(history.observable[ALL_BONES].all(axis=1), 1.0, FAINT)
    chosen = np.linspace(0, len(track.time) - 1, min(FIGURES, len(track.time))).round().astype(int)
    if clean is None:
        (figures,) = side_by_side(ax, track.time[chosen], track.positions[chosen])
        for points in figures:
            draw_bones(ax, points, raw_bones, RAW_COLOUR, width=2.5)
        return
    figures, behind = side_by_side(ax, track.time[chosen], track.positions[chosen], clean.raw[chosen])
    for row, points, raw in zip(chosen, figures, behind, strict=True):
        draw_bones(ax, raw, raw_bones, RAW_COLOUR, width=5.0, alpha=0.55)
        colours = [STATE_COLOURS[JointState(state)] for state in bone_states(clean.state[row])]
        draw_bones(ax, points, ALL_BONES, colours, width=2.0, alpha=opacity)


def side_by_side(ax: Axes, seconds: Floats, joints: Floats, *others: Floats) -> list[Floats]:
    """Arrange N figures, joints (N, 22, 3) metres, world, in a row, seen from the front, labelled with their times.

    Returns coordinates (N, 22, 2) in the axes for ``joints``, and for each of ``others``, which share their places.
    """
    front = next((f for points in joints if (f := facing(points)) is not None), np.array([1.0, 0.0, 0.0]))
    across = np.array([-front[1], front[0], 0.0])
    pelvis = joints[:, :1]
    pelvis = np.where(np.isfinite(pelvis).all(axis=-1, keepdims=True), pelvis, nan_mean(joints, axis=1)[:, None])
    for place, second in enumerate(seconds):
        ax.text(place, -1.27, f"{second:.1f} s", ha="center", fontsize=8)
    ax.set(aspect="equal", xlim=(-0.6, max(FIGURES, len(joints)) - 0.4), ylim=(-1.34, 0.85))
    ax.axis("off")
    centred = [points - pelvis for points in (joints, *others)]
    places = np.arange(len(joints))[:, None]
    return [np.stack([places + points @ across, points[..., 2]], axis=-1) for points in centred]


def draw_bones(
    ax: Axes, points: Floats, pairs: NDArray[np.intp], colours: str | list[str], *, width: float, alpha: Any = 1.0
) -> None:
    """Draw the bones ``pairs`` (B, 2) whose ends among points (J, 2) are finite.

    ``colours`` and ``alpha`` are single values, or one per bone.
    """
    from matplotlib.collections import LineCollection

    lines = points[pairs]
    shown = np.flatnonzero(np.isfinite(lines).all(axis=(1, 2)))
    picked = colours if isinstance(colours, str) else [colours[bone] for bone in shown]
    alpha = alpha if np.isscalar(alpha) else [alpha[bone] for bone in shown]
    drawn = LineCollection(list(lines[shown]), colors=picked, linewidths=width, alpha=alpha, capstyle="round")
    ax.add_collection(drawn)


def draw_path(ax: Axes, history: History, body: int) -> None:
    """Draw the paths over the floor from above, with the places where feet stood."""
    ax.set_title("pelvis from above, world, m", loc="left", fontsize=10, weight="bold")
    ax.set(xlabel="x", ylabel="y")
    topic = next(t for t in (POSE_WORLD, POSE_CLEAN, POSE_RAW, POSE_TRUTH) if t in history.tracks)
    for number, person in enumerate(history.tracks.get(POSE_TRUTH, {}).values() if topic != POSE_TRUTH else ()):
        _, trail = with_gaps(person.time, person.positions[:, 0, :2])
        ax.plot(*trail.T, color=TRUTH_COLOUR, linewidth=3, alpha=0.35, label=None if number else "ground truth")
    for other, track in history.tracks[topic].items():
        pelvis = track.positions[:, 0, :2]
        _, trail = with_gaps(track.time, pelvis)
        colour, label = (WORLD_COLOUR, topic.removeprefix("pose/")) if other == body else (RAW_COLOUR, None)
        ax.plot(*trail.T, color=colour, linewidth=1.5, label=label)
        seen = np.flatnonzero(np.isfinite(pelvis[:, 0]))
        if len(seen):
            ax.annotate(f"{other}", tuple(pelvis[seen[0]]), fontsize=8, textcoords="offset points", xytext=(4, 4))
            ax.plot(*pelvis[seen[0]], "o", color="black", markersize=4, label="start" if other == body else None)
    world = history.track(POSE_WORLD, body)
    if world is not None:
        for side, colour in (("left", AXIS_COLOURS["y"]), ("right", AXIS_COLOURS["x"])):
            places = [row for row, name in enumerate(CONTACTS) if name in (f"{side}_ankle", f"{side}_foot")]
            touching = world.contacts[:, places] > CONTACT_PROBABILITY
            spots = world.positions[:, CONTACT_INDICES[places], :2][touching]
            if len(spots):
                ax.plot(*spots.T, "s", color=colour, markersize=1.5, alpha=0.5, label=f"{side} foot down", zorder=0)
    if ax.get_legend_handles_labels()[0]:
        ax.legend(loc="best", fontsize=7)
    ax.set_aspect("equal", adjustable="datalim")
    ax.grid(alpha=0.25)


def draw_by_joint(ax: Axes, clean: Track | None, errors: dict[str, TrackError]) -> None:
    """Draw each joint's mean distance from the ground truth or, without ground truth, its mean correction."""
    if errors:
        title = "mean position error of each joint, cm"
        bars = {topic.removeprefix("pose/"): (error.by_joint, TOPIC_COLOURS[topic]) for topic, error in errors.items()}
    elif clean is not None and np.nan_to_num(corrections(clean)).any():
        title = "mean distance between raw and clean, cm"
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
            gaps = f"gaps: {(steps > GAP_RATIO * usual).sum()}, longest {steps.max() * 1e3:.0f} ms"
            rate = 1 / usual if usual > 0 else np.nan
            lines.append(f"{topic:<10} {len(stamps):>5} frames {rate:5.1f} Hz, {gaps}")
    clean = history.track(POSE_CLEAN, body)
    if clean is not None:
        shares = [f"{state.name.lower()} {(clean.state == state).mean():.1%}" for state in JointState]
        lines += ["", f"joints of body {body}:", "  " + "  ".join(shares)]
    for key, name in (("jitter_mm", "independent"), ("slow_error_mm", "time-correlated")):
        if found := history.sensor.get(key):
            lines.append(f"sensor noise, {name}: {np.median(found):.1f} mm along an axis")
    for topic, error in errors.items():
        mean, p95 = 100 * error.mean.mean(), 100 * np.percentile(error.mean, 95)
        lines.append(f"error {topic:<10} mean {mean:5.1f}  p95 {p95:5.1f} cm")
    if errors and not history.calibrated:
        lines.append("(camera not calibrated: aligned to the truth first)")
    silence = "nothing dropped or refused" if history.reported else "no diagnostics were recorded"
    lines += ["", "dropped and refused:" if history.dropped_or_refused else silence]
    lines += [f"  {count:>6}  {cause}" for cause, count in history.dropped_or_refused.most_common(14)]
    ax.text(-0.2, 1, "\n".join(lines), va="top", family="monospace", fontsize=8, transform=ax.transAxes)
