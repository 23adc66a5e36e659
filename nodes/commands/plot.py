"""``steadypose plot``: what happened in a recording, as one picture.

Panels that a recording has nothing for are left out, so that one of `pose/raw` alone is drawn too. One body is
drawn, the one seen the longest unless another is asked for; the way over the floor is that of all of them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np
import tyro
from numpy.typing import NDArray

from steadypose.msgs.recording import RecordingReader
from steadypose.msgs.topics import POSE_CLEAN, POSE_RAW, POSE_TRUTH, POSE_WORLD
from steadypose.msgs.types import CONTACTS, JOINTS, Diagnostics, JointState, PoseClean, PoseRaw, PoseWorld, Tracking
from steadypose.nodes.sinks.drawing import (
    ALARM_COLOUR,
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
    to_world,
)
from steadypose.prior.body.layouts import SKELETONS, to_canonical
from steadypose.prior.body.skeleton import J

if TYPE_CHECKING:
    from matplotlib.axes import Axes

GAP_S = 0.2
"""a line is not drawn across a longer silence"""
LATE = 1.5
"""times the usual interval from which on a frame counts as late"""
FIGURES = 12
JOINTS_SHOWN = 3
CONTACT_PROBABILITY = 0.5
TRUTH_REACH_S = 0.05
"""the furthest that a true pose may be from the stamp it is compared at"""

_TOPIC_COLOURS = {
    POSE_TRUTH: TRUTH_COLOUR,
    POSE_RAW: RAW_COLOUR,
    POSE_CLEAN: CLEAN_COLOUR,
    POSE_WORLD: WORLD_COLOUR,
}
_AXES = {"x": "#882255", "y": "#44aa99", "z": "#332288"}


STRIP = 2.8
TITLE = 0.45
"""inches: the strip of figures, and the title of a panel"""


class PlotError(ValueError):
    """What was asked for cannot be drawn. The text says why."""


class _Track(NamedTuple):
    """One body on one topic, a row a message. Positions are in the world."""

    time: NDArray[np.float64]
    """(T,) seconds since the recording's first stamp"""
    positions: NDArray[np.float64]
    """(T, 22, 3) metres; NaN where unobserved"""
    raw: NDArray[np.float64]
    """(T, 22, 3) what went in; empty but on `pose/clean`"""
    state: NDArray[np.uint8]
    """(T, 22) `JointState`"""
    sigma: NDArray[np.float64]
    """(T, 22) metres"""
    anomaly: NDArray[np.float64]
    """(T,)"""
    flag: NDArray[np.bool_]
    """(T,)"""
    contacts: NDArray[np.float64]
    """(T, 8)"""
    tracking: NDArray[np.uint8]
    """(T,) `Tracking`"""


class _Row(NamedTuple):
    """A body in a message, as it is gathered; the fields of `_Track`."""

    time: float
    positions: NDArray[np.floating]
    raw: NDArray[np.floating] = np.zeros(0)
    state: NDArray[np.uint8] = np.zeros(0, np.uint8)
    sigma: NDArray[np.floating] = np.zeros(0)
    anomaly: float = np.nan
    flag: bool = False
    contacts: NDArray[np.floating] = np.zeros(0)
    tracking: int = Tracking.OK


@dataclass
class _Story:
    """A recording as arrays."""

    name: str
    stamps: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    """topic to (T,) seconds"""
    tracks: dict[str, dict[int, _Track]] = field(default_factory=dict)
    """topic and body to its track"""
    calibrated: bool = True
    """whether the camera's place in the world is known"""
    reported: bool = False
    """whether nodes told what they dropped and refused"""
    observable: NDArray[np.bool_] = field(default_factory=lambda: np.ones(len(JOINTS), bool))
    """(22,) the joints that the sensor has at all"""
    origin: str = ""
    troubles: Counter[str] = field(default_factory=Counter)
    """dropped and refused messages by node and cause, as the nodes counted them; and what could not be read"""

    def track(self, topic: str, body: int) -> _Track | None:
        return self.tracks.get(topic, {}).get(body)

    def longest(self) -> int | None:
        """The body with the most messages on the furthest topic that has any."""
        for topic in (POSE_CLEAN, POSE_WORLD, POSE_RAW, POSE_TRUTH):
            if bodies := self.tracks.get(topic):
                return max(bodies, key=lambda body: len(bodies[body].time))
        return None


class _Error(NamedTuple):
    """How far a track is from the truth."""

    time: NDArray[np.float64]
    """(T,) seconds"""
    mean: NDArray[np.float64]
    """(T,) metres, over the joints given"""
    by_joint: NDArray[np.float64]
    """(22,) metres, over time"""


class _Panel(NamedTuple):
    title: str
    height: float
    draw: Callable[[Axes], None]


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
    story = _read(recording)
    chosen = story.longest() if body is None else body
    if chosen is None:
        raise PlotError(f"{recording}: expected bodies on a pose topic, found none; there is nothing to draw")
    bodies = sorted({found for tracks in story.tracks.values() for found in tracks})
    if chosen not in bodies:
        raise PlotError(f"body: expected one of {bodies}, got {chosen}")

    errors = _errors(story, chosen)
    panels = _panels(story, chosen, errors)
    heights = [panel.height + TITLE for panel in panels]
    body_height = max(sum(heights), 9.0)
    figure = Figure(figsize=(16, STRIP + body_height), layout="constrained")
    figure.suptitle(f"{story.name} · {story.origin} · body {chosen} of {len(bodies)}", fontsize=14, weight="bold")
    rows = figure.add_gridspec(2, 1, height_ratios=[STRIP, body_height])
    _draw_strip(figure.add_subplot(rows[0]), story, chosen)
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
    _draw_path(figure.add_subplot(beside[0]), story, chosen)
    _draw_by_joint(figure.add_subplot(beside[1]), story.track(POSE_CLEAN, chosen), errors)
    _draw_summary(figure.add_subplot(beside[2]), story, chosen, errors)
    figure.savefig(output, dpi=110)
    print(f"wrote {output}")


def _read(recording: Path) -> _Story:
    rows: dict[tuple[str, int], list[_Row]] = {}
    stamps: dict[str, list[float]] = {}
    troubles: dict[str, Mapping[str, str]] = {}
    sources, skeletons = Counter[str](), Counter[str]()
    observable = np.zeros(len(JOINTS), bool)
    with RecordingReader(recording) as reader:
        story = _Story(reader.path.name)
        for topic, stamp_ns, message in reader:
            if isinstance(message, Diagnostics):
                troubles[message.node] = message.values
                continue
            if message.end_of_stream:
                continue
            time = (stamp_ns - reader.start_ns) / 1e9
            stamps.setdefault(topic, []).append(time)
            sources[message.source] += 1
            story.calibrated &= getattr(message, "calibrated", True)
            if isinstance(message, PoseRaw) and message.skeleton in SKELETONS:
                skeletons[message.skeleton] += 1
                observable |= SKELETONS[message.skeleton].observable
            for body, row in _rows(message, time):
                rows.setdefault((topic, body), []).append(row)
        story.troubles.update({f"unreadable {topic}": count for topic, count in reader.refused.items()})
        if not reader.complete:
            story.troubles["bytes cut off"] = reader.lost_bytes
    story.stamps = {topic: np.array(times) for topic, times in stamps.items()}
    for (topic, body), found in rows.items():
        track = _Track(*(np.array(column) for column in zip(*found, strict=True)))
        story.tracks.setdefault(topic, {})[body] = track
    if observable.any():
        story.observable = observable
    story.reported = bool(troubles)
    story.origin = " · ".join([", ".join(sources), *skeletons])
    for node, values in troubles.items():
        counts = {key: value for key, value in values.items() if key.startswith(("dropped.", "refused."))}
        story.troubles.update({f"{node} {key}": int(value) for key, value in counts.items() if value.isdecimal()})
    return story


def _rows(message: PoseRaw | PoseClean | PoseWorld, time: float) -> Iterable[tuple[int, _Row]]:
    if isinstance(message, PoseRaw):
        skeleton = SKELETONS.get(message.skeleton)
        for body in message.bodies if skeleton else ():
            if skeleton and len(body.positions) == len(skeleton.joints):
                positions, _ = to_canonical(skeleton, to_world(body.positions, message.sensor_pose), body.confidence)
                yield body.id, _Row(time, positions)
    elif isinstance(message, PoseClean):
        for body in message.bodies:
            positions = to_world(body.positions, message.sensor_pose)
            raw = to_world(body.raw_positions, message.sensor_pose)
            yield body.id, _Row(time, positions, raw, body.state, body.sigma, body.anomaly, body.anomaly_flag)
    else:
        for body in message.bodies:
            yield (
                body.id,
                _Row(
                    time,
                    body.positions,
                    state=body.state,
                    sigma=body.sigma,
                    contacts=body.contacts,
                    tracking=body.tracking,
                ),
            )


def _panels(story: _Story, body: int, errors: dict[str, _Error]) -> list[_Panel]:
    """The panels over time that this recording has something for."""
    raw, clean, world = (story.track(topic, body) for topic in (POSE_RAW, POSE_CLEAN, POSE_WORLD))
    panels: list[_Panel] = []
    if clean is not None:
        for joint in _busiest(clean):
            panels.append(
                _Panel(f"{JOINTS[joint]} from the pelvis, m", 1.25, lambda ax, j=joint: _draw_joint(ax, clean, j))
            )
        panels.append(_Panel("where each joint comes from", 3.0, lambda ax: _draw_states(ax, clean)))
        panels.append(_Panel("standard deviation, cm", 0.8, lambda ax: _draw_sigma(ax, clean)))
        if np.isfinite(clean.anomaly).any():
            panels.append(_Panel("anomaly score", 0.8, lambda ax: _draw_anomaly(ax, clean)))
    elif raw is not None:
        for joint in (J["left_wrist"], J["right_wrist"], J["left_ankle"]):
            panels.append(_Panel(f"{JOINTS[joint]}, world, m", 1.25, lambda ax, j=joint: _draw_raw_joint(ax, raw, j)))
        panels.append(_Panel("joints the sensor gave", 3.0, lambda ax: _draw_seen(ax, raw, story.observable)))
    if world is not None:
        panels.append(_Panel("contacts", 1.0, lambda ax: _draw_contacts(ax, world)))
    if errors:
        panels.append(
            _Panel(
                "distance of a joint from the truth, cm (mean of those given)",
                1.25,
                lambda ax: _draw_errors(ax, errors),
            )
        )
    panels.append(_Panel("from frame to frame, ms", 1.0, lambda ax: _draw_intervals(ax, story)))
    return panels


def _busiest(clean: _Track) -> list[int]:
    """The joints to show: of hands, feet and head those most often missing, then most corrected."""
    limbs = [J[name] for name in ("left_wrist", "right_wrist", "left_ankle", "right_ankle", "head")]
    missing = (clean.state == JointState.IMPUTED).mean(axis=0).round(2)
    correction = np.nan_to_num(_mean(_corrections(clean), axis=0))
    return sorted(limbs, key=lambda joint: (-missing[joint], -correction[joint]))[:JOINTS_SHOWN]


def _corrections(clean: _Track) -> NDArray[np.float64]:
    """(T, 22) metres between what went in and what came out; NaN where nothing went in."""
    return np.linalg.norm(clean.positions - clean.raw, axis=2)


def _broken(time: NDArray[np.float64], *columns: NDArray) -> list[NDArray]:
    """Time and columns with a NaN wherever nothing came for a while, so that no line bridges it."""
    gaps = np.flatnonzero(np.diff(time) > GAP_S) + 1
    return [
        np.insert(time, gaps, np.nan),
        *(np.insert(column.astype(float), gaps, np.nan, axis=0) for column in columns),
    ]


def _draw_joint(ax: Axes, clean: _Track, joint: int) -> None:
    pelvis = clean.positions[:, :1]
    time, before, after = _broken(clean.time, (clean.raw - pelvis)[:, joint], (clean.positions - pelvis)[:, joint])
    for axis, (name, colour) in enumerate(_AXES.items()):
        ax.plot(time, before[:, axis], ".", color=colour, markersize=2.5, alpha=0.35, label=f"{name} raw")
        ax.plot(time, after[:, axis], color=colour, linewidth=1.3, label=f"{name} clean")
    ax.legend(loc="upper right", ncols=6, fontsize=7, markerscale=3, handlelength=1.2)
    low, high = np.nanmin(after), np.nanmax(after)
    ax.set_ylim(low - 0.25, high + 0.45)


def _draw_raw_joint(ax: Axes, raw: _Track, joint: int) -> None:
    for axis, (name, colour) in enumerate(_AXES.items()):
        ax.plot(raw.time, raw.positions[:, joint, axis], ".", color=colour, markersize=3, label=name)
    ax.legend(loc="upper right", ncols=3, fontsize=7)


def _draw_states(ax: Axes, clean: _Track) -> None:
    _draw_cells(ax, clean.time, clean.state, {state.name.lower(): colour for state, colour in STATE_COLOURS.items()})
    ax.set_yticks(range(len(JOINTS)), JOINTS, fontsize=6)


def _draw_seen(ax: Axes, raw: _Track, observable: NDArray[np.bool_]) -> None:
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

    time, values = _broken(time, cells)
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


def _draw_sigma(ax: Axes, clean: _Track) -> None:
    time, middle, worst = _broken(clean.time, np.median(clean.sigma, axis=1) * 100, clean.sigma.max(axis=1) * 100)
    ax.plot(time, worst, color=STATE_COLOURS[JointState.IMPUTED], linewidth=1, label="worst joint")
    ax.plot(time, middle, color=CLEAN_COLOUR, linewidth=1, label="median joint")
    ax.legend(loc="upper right", ncols=2, fontsize=7)
    ax.set_ylim(bottom=0)


def _draw_anomaly(ax: Axes, clean: _Track) -> None:
    time, score = _broken(clean.time, clean.anomaly)
    ax.plot(time, score, color=CLEAN_COLOUR, linewidth=1)
    ax.plot(clean.time[clean.flag], clean.anomaly[clean.flag], ".", color=ALARM_COLOUR, markersize=4, label="flagged")
    if clean.flag.any():
        ax.legend(loc="upper right", fontsize=7)


def _draw_contacts(ax: Axes, world: _Track) -> None:
    time, contacts, tracking = _broken(world.time, world.contacts, world.tracking)
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


def _errors(story: _Story, body: int) -> dict[str, _Error]:
    """How far a body's joints are from the truth on each topic, where the recording has it."""
    truth = [person for person in story.tracks.get(POSE_TRUTH, {}).values() if len(person.time) > 1]
    found = {}
    for topic in (POSE_RAW, POSE_CLEAN, POSE_WORLD):
        track = story.track(topic, body)
        if track is None or not truth:
            continue
        joints = np.stack([_distances(track, person, placed=story.calibrated) for person in truth])
        means = np.stack([_mean(distances, axis=1) for distances in joints])
        some = np.flatnonzero(np.isfinite(means).any(axis=0))
        if len(some):
            # the sensor's ids need not be those of the truth: who is meant is told by where they stand
            nearest = np.nanargmin(means[:, some], axis=0)
            found[topic] = _Error(track.time[some], means[nearest, some], _mean(joints[nearest, some], axis=0))
    return found


def _distances(track: _Track, truth: _Track, *, placed: bool) -> NDArray[np.float64]:
    """(T, 22) metres from a track's joints to the true ones at the same moments; NaN where either is missing.

    Args:
        placed: whether the track's place in the world is known; if not, it is first put where it fits best.
    """
    index = np.clip(np.searchsorted(truth.time, track.time), 1, len(truth.time) - 1)
    before, after = truth.time[index - 1], truth.time[index]
    share = np.clip((track.time - before) / np.maximum(after - before, 1e-9), 0, 1)[:, None, None]
    expected = truth.positions[index - 1] * (1 - share) + truth.positions[index] * share
    far = np.minimum(np.abs(track.time - before), np.abs(after - track.time)) > TRUTH_REACH_S
    expected[far] = np.nan
    positions = track.positions if placed else _placed(track.positions, expected)
    return np.linalg.norm(positions - expected, axis=2)


def _placed(positions: NDArray[np.float64], expected: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions (T, 22, 3), shifted and turned about the vertical, once for all, to where they fit the expected."""
    both = np.isfinite(positions).all(axis=2) & np.isfinite(expected).all(axis=2)
    if not both.any():
        return positions
    origin, target = positions[both].mean(axis=0), expected[both].mean(axis=0)
    p, q = positions[both] - origin, expected[both] - target
    turn = np.arctan2(np.sum(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]), np.sum(p[:, 0] * q[:, 0] + p[:, 1] * q[:, 1]))
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    return (positions - origin) @ rotation.T + target


def _mean(values: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """The mean of what is not NaN; NaN where all is."""
    counted = np.isfinite(values)
    total = np.where(counted, values, 0.0).sum(axis=axis)
    number = counted.sum(axis=axis)
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)


def _draw_errors(ax: Axes, errors: dict[str, _Error]) -> None:
    for topic, error in errors.items():
        time, distance = _broken(error.time, error.mean * 100)
        label = f"{topic.removeprefix('pose/')}: mean {error.mean.mean() * 100:.1f} cm"
        ax.plot(time, distance, color=_TOPIC_COLOURS[topic], linewidth=1.2, label=label)
    ax.legend(loc="upper right", ncols=3, fontsize=7)
    ax.set_ylim(0, 1.4 * max(np.percentile(error.mean, 99) * 100 for error in errors.values()))


def _draw_intervals(ax: Axes, story: _Story) -> None:
    for topic, colour in _TOPIC_COLOURS.items():
        stamps = story.stamps.get(topic, np.zeros(0))
        if len(stamps) > 1:
            ax.plot(
                stamps[1:], np.diff(stamps) * 1e3, ".", color=colour, markersize=3, label=topic.removeprefix("pose/")
            )
    ax.legend(loc="upper right", ncols=3, fontsize=7, markerscale=3)
    ax.set_yscale("log")
    ax.set_yticks([10, 30, 100, 300, 1000], ["10", "30", "100", "300", "1000"])
    ax.minorticks_off()


def _draw_strip(ax: Axes, story: _Story, body: int) -> None:
    """Stick figures at even times, seen from the front: what came in behind what came out."""
    clean = story.track(POSE_CLEAN, body)
    track = next(
        t for topic in (POSE_CLEAN, POSE_WORLD, POSE_RAW, POSE_TRUTH) if (t := story.track(topic, body)) is not None
    )
    raw_bones = bones(story.observable)
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


def _draw_path(ax: Axes, story: _Story, body: int) -> None:
    """The way over the floor from above, feet where they stood."""
    ax.set_title("from above, m", loc="left", fontsize=10, weight="bold")
    topic = next(t for t in (POSE_WORLD, POSE_CLEAN, POSE_RAW, POSE_TRUTH) if t in story.tracks)
    for person in story.tracks.get(POSE_TRUTH, {}).values():
        _, way = _broken(person.time, person.positions[:, 0, :2])
        ax.plot(*way.T, color=TRUTH_COLOUR, linewidth=3, alpha=0.35)
    for other, track in story.tracks[topic].items():
        pelvis = track.positions[:, 0, :2]
        _, way = _broken(track.time, pelvis)
        ax.plot(*way.T, color=WORLD_COLOUR if other == body else RAW_COLOUR, linewidth=1.5)
        seen = np.flatnonzero(np.isfinite(pelvis[:, 0]))
        if len(seen):
            ax.annotate(f"{other}", tuple(pelvis[seen[0]]), fontsize=8, textcoords="offset points", xytext=(4, 4))
            ax.plot(*pelvis[seen[0]], "o", color="black", markersize=4)
    world = story.track(POSE_WORLD, body)
    if world is not None:
        for side, colour in (("left", _AXES["y"]), ("right", _AXES["x"])):
            places = [row for row, name in enumerate(CONTACTS) if name in (f"{side}_ankle", f"{side}_foot")]
            touching = world.contacts[:, places] > CONTACT_PROBABILITY
            spots = world.positions[:, CONTACT_INDICES[places], :2][touching]
            ax.plot(*spots.T, ".", color=colour, markersize=3, alpha=0.5, label=f"{side} foot down", zorder=0)
    handles, _ = ax.get_legend_handles_labels()
    if handles:
        ax.legend(loc="best", fontsize=7, markerscale=3)
    ax.set_aspect("equal", adjustable="datalim")
    ax.grid(alpha=0.25)


def _draw_by_joint(ax: Axes, clean: _Track | None, errors: dict[str, _Error]) -> None:
    """Each joint's mean distance from the truth or, where that is unknown, from what the sensor said."""
    if errors:
        title = "by joint: mean distance from the truth, cm"
        bars = {topic.removeprefix("pose/"): (error.by_joint, _TOPIC_COLOURS[topic]) for topic, error in errors.items()}
    elif clean is not None:
        title = "by joint: mean correction, cm"
        bars = {"correction": (_mean(_corrections(clean), axis=0), CLEAN_COLOUR)}
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


def _draw_summary(ax: Axes, story: _Story, body: int, errors: dict[str, _Error]) -> None:
    ax.axis("off")
    lines = []
    for topic, stamps in story.stamps.items():
        if len(stamps) > 1:
            steps = np.diff(stamps)
            usual = np.median(steps)
            late = int((steps > LATE * usual).sum())
            rate = (len(stamps) - 1) / (stamps[-1] - stamps[0]) if stamps[-1] > stamps[0] else np.nan
            longest = f"longest {steps.max() * 1e3:.0f} ms"
            lines.append(f"{topic:<10} {len(stamps):>5} frames {rate:5.1f} Hz {late:>3} late, {longest}")
    clean = story.track(POSE_CLEAN, body)
    if clean is not None:
        shares = [f"{state.name.lower()} {(clean.state == state).mean():.1%}" for state in JointState]
        lines += ["", f"joints of body {body}:", "  " + "  ".join(shares)]
    for topic, error in errors.items():
        mean, p95 = 100 * error.mean.mean(), 100 * np.percentile(error.mean, 95)
        lines.append(f"error {topic:<10} mean {mean:5.1f}  p95 {p95:5.1f} cm")
    if errors and not story.calibrated:
        lines.append("(the camera's place is unknown: moved to where it fits best)")
    silence = "nothing dropped or refused" if story.reported else "no diagnostics were recorded"
    lines += ["", "dropped and refused:" if story.troubles else silence]
    lines += [f"  {count:>6}  {cause}" for cause, count in story.troubles.most_common(14)]
    ax.text(-0.2, 1, "\n".join(lines), va="top", family="monospace", fontsize=8, transform=ax.transAxes)
