"""Declares every source once. To add a source, write a module with its settings and class, and
add a field to `InputSettings` and an entry to `SOURCES`."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from steadypose.nodes.extras import require_extra
from steadypose.nodes.graph.clock import Clock
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.settings import STREAMS, LaunchError, load_plugin, path_setting
from steadypose.nodes.sources.camera import MergeSettings, MergeSource, open_oak, open_webcam
from steadypose.nodes.sources.image import NAME as IMAGE
from steadypose.nodes.sources.ros2 import Ros2Settings, Ros2Source, TfSettings, TfSource
from steadypose.nodes.sources.source import (
    CalibrationSettings,
    LiveSource,
    OakSettings,
    RecordedSource,
    SourceContext,
    WebcamSettings,
)
from steadypose.prior.settings import nearest


def _open_recording(path: str, context: SourceContext) -> RecordedSource:
    from steadypose.nodes.sources.recording import open_recording  # imported late (3 MB), only if a recording is played

    return open_recording(path, image_file=context.image_file)


@dataclass(frozen=True)
class InputSettings:
    """``[input]``: where skeletons come from."""

    source: str = "recording"
    """name of a source: one of the fields below, or ``module:name`` of a function in another package, which is called
    with ``options`` and a `SourceContext`"""
    options: dict[str, Any] = field(default_factory=dict)
    """settings of another package's source"""
    rate: float = 1.0
    """playback speed relative to real time; 0: as fast as the subscribers accept"""
    loop: bool = False
    """whether to repeat the recording endlessly, with stamps that keep increasing"""
    image: bool = False
    """whether to give the viewer of this machine and user the newest image of an OAK, webcam or video, at most 15 per
    second"""
    calibration: CalibrationSettings = field(default_factory=CalibrationSettings)
    tf: TfSettings = field(default_factory=TfSettings)

    recording: str = path_setting(STREAMS)
    """rosbag2 directory, .mcap, .npz or .csv to play, relative to the launch file; or the name of a bundled stream"""
    oak: OakSettings = field(default_factory=OakSettings)
    webcam: WebcamSettings = field(default_factory=WebcamSettings)
    ros2: Ros2Settings = field(default_factory=Ros2Settings)
    merge: MergeSettings = field(default_factory=MergeSettings)

    def __post_init__(self) -> None:
        if self.source not in SOURCES and ":" not in self.source:
            got = f"{self.source!r}{nearest(self.source, SOURCES)}"
            raise LaunchError(f"[input] source: expected one of {', '.join(SOURCES)}, got {got}")
        if not 0 <= self.rate < math.inf:
            raise LaunchError(f"[input] rate: expected 0 (as fast as possible) or more, got {self.rate:g}")


SOURCES: Mapping[str, tuple[Callable[[Any, SourceContext], RecordedSource | LiveSource], str]] = {
    "recording": (_open_recording, ""),
    "oak": (open_oak, "oak"),
    "webcam": (open_webcam, "webcam"),
    "ros2": (Ros2Source, ""),
    "merge": (MergeSource, ""),
}
"""What creates each source from its settings, and the extra that it needs, if any. Cameras are opened later."""


def open_input(launch: Launch, clock: Clock | None = None) -> RecordedSource | LiveSource:
    """Open the source that ``[input]`` of a launch file names, for a node with this ``clock``.

    Raises LaunchError, RecordingError, NpzError or CsvError if a setting or the recording cannot be used.
    """
    settings, transport, clock = launch.settings(InputSettings), launch.transport, clock or Clock()
    if ":" in settings.source:
        opens, extra, own = load_plugin("[input] source", settings.source), "", settings.options
    else:
        (opens, extra), own = SOURCES[settings.source], getattr(settings, settings.source)
    if extra:
        require_extra(extra)
    image_file = transport.ipc_directory / IMAGE if settings.image else None
    context = SourceContext(clock, settings.calibration, transport.curve_keys(), transport.clear_text, image_file)
    source = opens(own, context)
    if not settings.tf.fixed_frame:
        return source
    if not isinstance(source, LiveSource):
        raise LaunchError(f"[input.tf] is for live sources: expected a camera or ros2, got {settings.source}")
    return TfSource(source, settings.tf, clock)
