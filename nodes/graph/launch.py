"""Launch files: what to start, from where, and how the nodes reach each other.

A launch file is TOML, one section a subject, and read strictly: a key that does not exist is an error that names
the nearest one that does. Every section may be left out; the defaults play nothing but run. ``[prior]`` and
``[trajectory]`` are passed on as they are to the stages they configure (`prior.clean.pipeline.PriorSettings`,
`prior.world.pipeline.TrajectorySettings`), which check them just as strictly, so that reading a launch file needs no
torch.
"""

from __future__ import annotations

import difflib
import math
import os
import sys
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from steadypose import PACKAGE
from steadypose.msgs.keys import Keys, load_keys
from steadypose.msgs.topics import DIAGNOSTICS, POSE_CLEAN, POSE_RAW, POSE_TRUTH, POSE_WORLD, TOPICS
from steadypose.msgs.types import Pose
from steadypose.prior.settings import build_settings

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

#: The graph: each node, and for every node it listens to the topics it takes from there.
LISTENS: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    "pose_input": {},
    "prior": {"pose_input": (POSE_RAW, DIAGNOSTICS)},
    "trajectory": {"prior": (POSE_CLEAN,), "pose_input": (DIAGNOSTICS,)},
    "ros2_bridge": {
        "trajectory": (POSE_WORLD, DIAGNOSTICS),
        "prior": (DIAGNOSTICS,),
        "pose_input": (DIAGNOSTICS,),
    },
    "recorder": {
        "pose_input": (POSE_RAW, POSE_TRUTH, DIAGNOSTICS),
        "prior": (POSE_CLEAN, DIAGNOSTICS),
        "trajectory": (POSE_WORLD, DIAGNOSTICS),
    },
    "viewer": {
        "pose_input": (POSE_RAW, POSE_TRUTH, DIAGNOSTICS),
        "prior": (POSE_CLEAN, DIAGNOSTICS),
        "trajectory": (POSE_WORLD, DIAGNOSTICS),
    },
}

#: The publishers that carry poses; what a listener from outside the graph (echo, hz, viewer) connects to.
POSE_NODES = ("pose_input", "prior", "trajectory")

_PATHS = (
    ("input", "recording"),
    ("input", "oak", "archive"),
    ("input", "webcam", "model"),
    ("recorder", "directory"),
    ("transport", "keys"),
    ("transport", "directory"),
)
"""settings that are paths: relative ones in a launch file start at that file"""


class LaunchError(ValueError):
    """A launch file, or a setting given on the command line, cannot be used. The text says what to do."""


@dataclass(frozen=True)
class OakSettings:
    """``[input.oak]``: an OAK camera."""

    device: str = ""
    """its id or, of one on the network, its address; empty: the first that is found"""
    model: str = ""
    """pose network of Luxonis' model zoo, COCO-17 key points; empty: the YOLO pose that suits the camera"""
    archive: str = ""
    """a pose network in a file (NN archive, .tar.xz) instead of the zoo's; a relative path starts at the launch file"""
    fps: float = 0.0
    """frames a second; 0: what the camera's own network does"""
    confidence: float = 0.5
    """of a person, below which it is none"""


@dataclass(frozen=True)
class WebcamSettings:
    """``[input.webcam]``: any camera that the system knows, and MediaPipe."""

    camera: int = 0
    """its number: 0 is /dev/video0"""
    model: str = ""
    """MediaPipe's pose landmarker, a .task file; a relative path starts at the launch file"""
    bodies: int = 1
    """most bodies to look for"""
    field_of_view: float = 1.05
    """radians, of the image's width, where the lens is not calibrated: scales how far away bodies seem"""


@dataclass(frozen=True)
class Ros2Settings:
    """``[input.ros2]``: a ROS 2 topic with skeletons."""

    topic: str = "/body_tracking_data"
    type: str = "MarkerArray"
    """MarkerArray, as the driver of the Azure Kinect has it; or PoseArray, the joints of one body after the other"""
    skeleton: str = "smpl22"
    """of a PoseArray: the joints and their order"""
    up: str = "z"
    """of a PoseArray: the axis of its frame that points up: z, y or -y"""

    def __post_init__(self) -> None:
        if self.type not in ("MarkerArray", "PoseArray"):
            raise LaunchError(f"[input.ros2] type: expected MarkerArray or PoseArray, got {self.type!r}")
        if self.up not in ("z", "y", "-y"):
            raise LaunchError(f"[input.ros2] up: expected z, y or -y, got {self.up!r}")


SOURCES = ("recording", "oak", "webcam", "ros2", "merge")


@dataclass(frozen=True)
class MergeSettings:
    """``[input.merge]``: several calibrated cameras in place of one."""

    cameras: list[str] = field(default_factory=list)
    """addresses of their input nodes (``tcp://192.168.1.21:7111``)"""

    def __post_init__(self) -> None:
        _check_addresses("[input.merge] cameras", self.cameras)


@dataclass(frozen=True)
class CalibrationSettings:
    """``[input.calibration]``: the camera's lens and place, as ``steadypose calibrate`` writes them."""

    size: list[int] = field(default_factory=list)
    """pixels, width and height of the pictures that the lens is told for"""
    focal: list[float] = field(default_factory=list)
    """fx, fy in pixels"""
    centre: list[float] = field(default_factory=list)
    """cx, cy in pixels"""
    distortion: list[float] = field(default_factory=list)
    """k1, k2, p1, p2, k3, as OpenCV has them"""
    position: list[float] = field(default_factory=list)
    """metres, world"""
    orientation: list[float] = field(default_factory=list)
    """xyzw, from the camera's optical frame to the world"""

    def __post_init__(self) -> None:
        lengths = {"size": (2,), "focal": (2,), "centre": (2,), "position": (3,), "orientation": (4,)}
        for name, allowed in (lengths | {"distortion": (4, 5)}).items():
            values = getattr(self, name)
            numbers = all(isinstance(v, int | float) and math.isfinite(v) for v in values)
            if values and not (numbers and len(values) in allowed):
                raise LaunchError(
                    f"[input.calibration] {name}: expected {' or '.join(map(str, allowed))} numbers, got {values}"
                )
        if bool(self.position) != bool(self.orientation):
            raise LaunchError("[input.calibration] expected position and orientation, or neither")
        if self.orientation and abs(math.hypot(*self.orientation) - 1.0) > 0.01:
            raise LaunchError(f"[input.calibration] orientation: expected a unit quaternion, got {self.orientation}")
        if bool(self.size) != bool(self.focal) or bool(self.size) != bool(self.centre):
            raise LaunchError("[input.calibration] expected size, focal and centre of a lens, or none of them")
        if any(value <= 0 for value in (*self.size, *self.focal)):
            raise LaunchError(f"[input.calibration] expected a size and focal above 0, got {self.size}, {self.focal}")

    @property
    def pose(self) -> Pose | None:
        """Of the camera in the world, if it is calibrated."""
        return Pose(np.array(self.position), np.array(self.orientation)) if self.position else None


@dataclass(frozen=True)
class InputSettings:
    """``[input]``: where skeletons come from."""

    source: str = "recording"
    """recording, oak, webcam, ros2 or merge"""
    recording: str = ""
    """rosbag2 directory, .npz or .csv to play; a relative path starts at the launch file"""
    rate: float = 1.0
    """times real time; 0 is as fast as the listeners take it"""
    loop: bool = False
    """start again at the end, with stamps that go on rising"""
    calibration: CalibrationSettings = field(default_factory=CalibrationSettings)
    oak: OakSettings = field(default_factory=OakSettings)
    ros2: Ros2Settings = field(default_factory=Ros2Settings)
    webcam: WebcamSettings = field(default_factory=WebcamSettings)
    merge: MergeSettings = field(default_factory=MergeSettings)

    def __post_init__(self) -> None:
        if self.source not in SOURCES:
            raise LaunchError(
                f"[input] source: expected {', '.join(SOURCES[:-1])} or {SOURCES[-1]}, got {self.source!r}"
                f"{nearest(self.source, SOURCES)}"
            )
        if not 0 <= self.rate < math.inf:
            raise LaunchError(f"[input] rate: expected 0 (as fast as possible) or more, got {self.rate:g}")


@dataclass(frozen=True)
class TransportSettings:
    """``[transport]``: how messages travel."""

    directory: str = ""
    """of the ipc sockets; empty: ``steadypose`` in the user's runtime directory"""
    endpoints: dict[str, str] = field(default_factory=dict)
    """node to address (``tcp://192.168.1.5:7101``); a node not named here has an ipc socket in ``directory``"""
    keys: str = ""
    """directory of CurveZMQ keys, needed where an address is not local"""
    lossless: bool = True
    """a recording can wait, a camera cannot: true lets a node hold up its source while it is slow, or not there yet;
    false drops its oldest frames"""
    queue: int = 8
    """not lossless: frames a node keeps when it falls behind"""

    def __post_init__(self) -> None:
        for node, address in self.endpoints.items():
            if not isinstance(address, str):
                raise LaunchError(f"[transport.endpoints] {node}: expected an address, got {address!r}")
            if node not in LISTENS:
                raise LaunchError(
                    f"[transport.endpoints] names {node!r}, which is no node{nearest(node, LISTENS)}; "
                    f"nodes are {', '.join(LISTENS)}"
                )
        if self.queue < 1:
            raise LaunchError(f"[transport] queue: expected 1 frame or more, got {self.queue}")

    def endpoint(self, node: str) -> str:
        """The address ``node`` publishes at."""
        if node in self.endpoints:
            return self.endpoints[node]
        return f"ipc://{self.ipc_directory / node}"

    def curve_keys(self) -> Keys | None:
        """The CurveZMQ keys asked for, or None.

        Raises:
            LaunchError: they are not there, or not safe.
        """
        try:
            return load_keys(self.keys) if self.keys else None
        except ValueError as error:
            raise LaunchError(str(error)) from error

    @property
    def ipc_directory(self) -> Path:
        return Path(self.directory) if self.directory else default_directory()


@dataclass(frozen=True)
class ServerSettings:
    """``[server]``: one prior for several kiosks, whose input nodes run elsewhere."""

    kiosks: list[str] = field(default_factory=list)
    """addresses of their input nodes (``tcp://192.168.1.21:7101``), listened to in place of an own one"""

    def __post_init__(self) -> None:
        _check_addresses("[server] kiosks", self.kiosks)


@dataclass(frozen=True)
class RecorderSettings:
    """``[recorder]``: what is written, where."""

    directory: str = ""
    """the rosbag2 directory to make; a relative path starts at the launch file"""
    topics: list[str] = field(default_factory=lambda: list(TOPICS))

    def __post_init__(self) -> None:
        for topic in self.topics:
            if topic not in TOPICS:
                raise LaunchError(
                    f"[recorder] topics names {topic!r}, which nobody publishes{nearest(topic, TOPICS)}; "
                    f"topics are {', '.join(TOPICS)}"
                )


@dataclass(frozen=True)
class ViewerSettings:
    """``[viewer]``: the picture in the browser."""

    port: int = 9090
    """of the web page; the drawings come on the next one"""

    def __post_init__(self) -> None:
        if not 1 <= self.port <= 65534:
            raise LaunchError(f"[viewer] port: expected 1 to 65534, got {self.port}")


@dataclass(frozen=True)
class Launch:
    """A launch file as read, with the overrides of the command line applied."""

    nodes: list[str] = field(default_factory=lambda: list(POSE_NODES))
    input: InputSettings = field(default_factory=InputSettings)
    prior: dict[str, Any] = field(default_factory=dict)
    trajectory: dict[str, Any] = field(default_factory=dict)
    transport: TransportSettings = field(default_factory=TransportSettings)
    server: ServerSettings = field(default_factory=ServerSettings)
    recorder: RecorderSettings = field(default_factory=RecorderSettings)
    viewer: ViewerSettings = field(default_factory=ViewerSettings)

    def __post_init__(self) -> None:
        for node in self.nodes:
            if node not in LISTENS:
                raise LaunchError(
                    f"nodes names {node!r}, which is no node{nearest(node, LISTENS)}; there are {', '.join(LISTENS)}"
                )
        if self.server.kiosks and "pose_input" in self.nodes:
            raise LaunchError("[server] kiosks have their own pose_input: expected nodes without it, such as prior")
        if self.server.kiosks and self.transport.lossless:
            raise LaunchError("[server] kiosks do not wait: expected [transport] lossless = false")

    @classmethod
    def read(cls, path: str | Path, overrides: Iterable[str] = ()) -> Launch:
        """Read a launch file.

        Args:
            path: a file, or the name of one of the project's own (``replay``, ``oak``).
            overrides: ``section.key=value`` each, over what the file says; the value is TOML, or else plain text.

        Raises:
            LaunchError: no such file, not TOML, an unknown key, or a value of the wrong type.
        """
        file = find(path)
        try:
            table = tomllib.loads(file.read_text(encoding="utf-8"))
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise LaunchError(f"{file} is not TOML: {error}") from error
        for *sections, key in _PATHS:
            values = table
            for section in sections:
                values = values.get(section) if isinstance(values, dict) else None
            if isinstance(values, dict) and isinstance(text := values.get(key), str) and text:
                values[key] = str(file.parent / Path(text).expanduser())
        for override in overrides:
            apply_override(table, override)
        try:
            return build_settings(cls, table, file.name)
        except LaunchError:
            raise
        except ValueError as error:
            raise LaunchError(str(error)) from error

    def addresses(self, node: str) -> list[str]:
        """Where to hear what ``node`` publishes: one address, or those of all kiosks."""
        if node == "pose_input" and self.server.kiosks:
            return self.server.kiosks
        return [self.transport.endpoint(node)]

    def listeners(self, node: str) -> frozenset[str]:
        """The nodes that must not miss a pose of ``node``: those of this launch that work on it or record it."""
        if not self.transport.lossless:
            return frozenset()
        return frozenset(
            name
            for name in self.nodes
            if name != "viewer" and any(topic != DIAGNOSTICS for topic in LISTENS[name].get(node, ()))
        )


def _check_addresses(setting: str, addresses: list[str]) -> None:
    for address in addresses:
        if not isinstance(address, str):
            raise LaunchError(f"{setting}: expected addresses such as tcp://192.168.1.21:7111, got {address!r}")


def default_directory() -> Path:
    """Where ipc sockets live unless a launch file says otherwise: private to the user, gone after a reboot."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    return Path(runtime) / "steadypose" if runtime else Path(tempfile.gettempdir()) / f"steadypose-{os.getuid()}"


def bundled(*parts: str) -> Path:
    """A path inside the package: launch files, and a recorded stream (in a checkout, all of them) lie there.

    Raises:
        LaunchError: it is not there: the installation is damaged.
    """
    path = PACKAGE.joinpath(*parts)
    if not path.exists():
        raise LaunchError(f"{path} does not exist, and should have come with steadypose: install it anew")
    return path


def find(launch: str | Path) -> Path:
    """The launch file of that path, or of that name among the project's own."""
    path = Path(launch).expanduser()
    if path.is_file():
        return path.resolve()
    if path.parent == Path() and not path.suffix:
        own = sorted(file.stem for file in bundled("launch").glob("*.toml"))
        if path.name in own:
            return bundled("launch", f"{path.name}.toml")
        raise LaunchError(
            f"no launch file {path.name!r}{nearest(path.name, own)}; there are {', '.join(own)}, or give a path"
        )
    raise LaunchError(f"no launch file at {path}")


def apply_override(table: dict[str, Any], override: str) -> None:
    """Set one ``section.key=value`` in a table of settings, making the sections on the way.

    Raises:
        LaunchError: it has no ``=``, or goes through something that is not a section.
    """
    path, separator, text = override.partition("=")
    if not separator or not path.strip():
        raise LaunchError(f"expected section.key=value, got {override!r}")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text
    *sections, key = (part.strip() for part in path.split("."))
    for section in sections:
        table = table.setdefault(section, {})
        if not isinstance(table, dict):
            raise LaunchError(f"cannot set {path}: {section} is a value, not a section")
    table[key] = value


def nearest(name: str, known: Iterable[str]) -> str:
    """The end of an error's sentence: the known name that was probably meant, if there is one."""
    close = difflib.get_close_matches(str(name), list(known), n=1, cutoff=0.5)
    return f", did you mean {close[0]!r}?" if close else ""
