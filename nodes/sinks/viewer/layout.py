"""Layout of the viewer's window: scenes, plots, their colours, and the initial viewpoint."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.topics import POSE_CLEAN, POSE_RAW, POSE_WORLD
from steadypose.msgs.types import JointState
from steadypose.nodes.sinks import drawing

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

TIMELINE = "elapsed"


def _rgb(colour: str) -> list[int]:
    return [int(colour[i : i + 2], 16) for i in (1, 3, 5)]


DARK_RGB = _rgb(drawing.DARK)
SIDE_RGB = np.array([_rgb(colour) for colour in drawing.ON_DARK], np.uint8)  # (3, 3) colours of left, right and middle
FAINT_RGB = (drawing.FAINT * SIDE_RGB + (1.0 - drawing.FAINT) * np.array(DARK_RGB)).astype(np.uint8)
"""(3, 3) colours of unobserved joints and bones, blended with the background because Rerun's lines have no opacity."""
STATE_RGB = np.array([_rgb(drawing.STATE_COLOURS[state]) for state in JointState], np.uint8)
RAW_RGB, TRUTH_RGB, CONTACT_RGB, ALARM_RGB = map(
    _rgb, (drawing.RAW_COLOUR, drawing.TRUTH_COLOUR, drawing.CONTACT_COLOUR, drawing.ALARM_COLOUR)
)
PATH_RGB = [235, 235, 235]
RATE_RGB = {POSE_RAW: RAW_RGB, POSE_CLEAN: _rgb(drawing.STATE_COLOURS[JointState.REFINED]), POSE_WORLD: CONTACT_RGB}
LEGEND = """
- **blue** left, **orange** right
- **faint** not observed: inferred; the sphere is its standard deviation
- **points** of raw: whiter is more confident
- **yellow** contact; **arrow** velocity, 1 m/s is 1 m; **grey** ground truth
- **grid, axes** 0.5 m: x red, y green, z blue
- **red** flagged as an anomaly
"""


class Eye(NamedTuple):
    """The initial viewpoint of a scene."""

    target: NDArray[np.float64]  # (3,) metres, world: the middle of the bodies
    front: NDArray[np.float64]  # (3,) unit vector, world: direction in which one of them faces


def name_series(recording: rr.RecordingStream) -> None:
    """Log the names and colours of the plots' lines, which are static."""
    import rerun as rr

    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    states = [state.name.lower() for state in JointState]
    lines = rr.SeriesLines(names=states, colors=STATE_RGB, widths=[2.0] * len(states))
    recording.log("plots/joints", lines, static=True)
    for topic, colour in RATE_RGB.items():
        recording.log(f"plots/rates/{topic}", rr.SeriesLines(names=topic, colors=colour, widths=2), static=True)
    flagged = rr.SeriesPoints(names="flagged", colors=ALARM_RGB, markers="circle", marker_sizes=3)
    recording.log("plots/anomaly/flagged", flagged, static=True)
    threshold = rr.SeriesLines(names="flagged from here on", colors=ALARM_RGB, widths=1)
    recording.log("plots/anomaly/threshold", threshold, static=True)
    recording.log("legend", rr.TextDocument(LEGEND, media_type=rr.MediaType.MARKDOWN), static=True)
    axes = rr.Arrows3D(vectors=0.5 * np.eye(3), colors=255 * np.eye(3, dtype=np.uint8), labels=["x", "y", "z"])
    recording.log("world/axes", axes, static=True)


def blueprint(eye: Eye | None, *, calibrated: bool, scored: bool, images: bool = False) -> rrb.Blueprint:
    """The layout of scenes and plots in the window, seen from ``eye`` if a body was observed.

    If ``calibrated``, the floor is drawn in raw and clean too; anomaly scores are plotted if ``scored``, and clean
    poses drawn over camera images if there are any.
    """
    import rerun.blueprint as rrb

    cursor = rrb.TimeRangeBoundary.cursor_relative
    last_half_minute = rrb.VisibleTimeRange(TIMELINE, start=cursor(seconds=-30.0), end=cursor())

    def scene(origin: str, name: str, *, distance: float, height: float, floor: bool) -> rrb.Spatial3DView:
        controls = None
        if eye is not None:
            aside = np.array([-eye.front[1], eye.front[0], 0.0])
            place = eye.target + distance * (0.94 * eye.front + 0.34 * aside) + [0, 0, height]
            controls = rrb.EyeControls3D(
                kind="orbital", position=place, look_target=eye.target, eye_up=[0, 0, 1],
                tracking_entity=f"/{origin}/focus",
            )  # fmt: skip
        return rrb.Spatial3DView(
            origin="/",
            contents=f"/{origin}/**",
            name=name,
            background=DARK_RGB,
            line_grid=rrb.LineGrid3D(visible=floor, spacing=0.5, color=[120, 130, 150, 90]),
            eye_controls=controls,
        )

    def plot(origin: str, name: str, span: tuple[float, float] | None = None) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(
            origin=f"/plots/{origin}",
            name=name,
            axis_y=None if span is None else rrb.ScalarAxis(range=span),
            plot_legend=rrb.Corner2D.LeftTop,
            time_ranges=last_half_minute,
        )

    over_image = rrb.Spatial2DView(
        origin="/camera/image", contents=["/camera/**", "/clean/**"], name="camera: clean over its image"
    )
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                *([over_image] if images else []),
                scene("raw", "raw: as the sensor gives it", distance=2.0, height=0.3, floor=calibrated),
                scene("clean", "clean: faint is inferred", distance=2.0, height=0.3, floor=calibrated),
                scene("world", "world: path and contacts", distance=2.3, height=0.8, floor=True),
            ),
            rrb.Horizontal(
                *([plot("anomaly", "anomaly score")] if scored else []),
                plot("correction", "correction, cm"),
                plot("joints", "joints by state"),
                plot("rates", "messages a second", (0.0, 40.0)),
                rrb.TextDocumentView(origin="/legend", name="legend"),
                column_shares=[2] * (4 if scored else 3) + [3],
            ),
            row_shares=[5, 2],
        ),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
    )
