"""The messages as Python dataclasses.

Units are SI; stamps are capture times in nanoseconds; quaternions are xyzw; the world is right-handed with z up,
and the floor is at z = 0 if the sensor's pose is calibrated. A constructor accepts anything that numpy converts to an
array, converts it to the dtype declared here, and raises a `ValueError` that names the field, what was expected and
what came. It checks form, not plausibility: a NaN or a body 10 km away makes a valid message, and the receiver has to
handle it.

Messages compare by value, with NaN equal to NaN. A field's annotation defines its form for the constructor and the
codec. The codec takes the wire format from the definitions in `msgs/msg`.
"""

# without `from __future__ import annotations`: the constructors read the annotations
import math
from dataclasses import dataclass, field, fields
from enum import IntEnum
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs import forms
from steadypose.msgs.forms import Array, Form, Integer, ListOf, UnfitError

if TYPE_CHECKING:
    from typing_extensions import Self

JOINTS = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle",
    "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
)  # fmt: skip
"""The canonical skeleton, `smpl22`: the SMPL body joints in SMPL's order."""
CONTACTS = (
    "left_knee", "right_knee", "left_ankle", "right_ankle", "left_foot", "right_foot", "left_wrist", "right_wrist",
)  # fmt: skip
"""The joints of `WorldBody.contacts`, in order. An ankle stands for the heel, a foot for the toe."""


class JointState(IntEnum):
    """Where a joint's position comes from."""

    UNKNOWN = 0
    """no estimate; do not use"""
    SEEN = 1
    """observed, and passed on unchanged"""
    REFINED = 2
    """observed, and corrected by the prior"""
    IMPUTED = 3
    """not observed; inferred from the rest of the body and its motion"""


OBSERVED = (JointState.SEEN, JointState.REFINED)
"""States of joints that were observed."""


class Tracking(IntEnum):
    """Whether a body's root in the world is observed or predicted."""

    OK = 0
    COASTING = 1
    """the root is not observed at present; it is predicted, and its covariance grows"""
    LOST = 2
    """the root has been predicted for too long to be useful"""


class EventKind(IntEnum):
    """What a person does."""

    ENTERED = 0
    LEFT = 1
    NEAR = 2
    """within reach of the sensor"""
    STANDS = 3
    """upright on the feet, also while walking"""
    SITS = 4
    LIES = 5
    FELL = 6
    """came to lie quickly, and has not got up since"""
    HAND_RAISED = 7
    WAVES = 8
    POINTS = 9
    FACES_SENSOR = 10


class Phase(IntEnum):
    """Whether an event begins, continues or ends."""

    BEGINS = 0
    HOLDS = 1
    ENDS = 2


class Hand(IntEnum):
    """The hand that an event refers to; `NONE` for events of the whole body."""

    NONE = 0
    LEFT = 1
    RIGHT = 2


class Level(IntEnum):
    """The levels of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


# type checkers accept any array, because the constructors convert
_Array = NDArray[Any]
_J, _C = len(JOINTS), len(CONTACTS)
Id = Annotated[int, Integer(-(2**31), 2**31)]
Stamp = Annotated[int, Integer(0, 2**31 * 10**9)]  # builtin_interfaces/Time counts seconds in an int32
Number = Annotated[float, forms.number]
Text = Annotated[str, forms.text]
Vector = Annotated[_Array, Array(np.float64, (3,))]
Quaternion = Annotated[_Array, Array(np.float64, (4,))]
Positions = Annotated[_Array, Array(np.float32, (_J, 3))]
Rotations = Annotated[_Array, Array(np.float32, (_J, 4))]
PerJoint = Annotated[_Array, Array(np.float32, (_J,))]
States = Annotated[_Array, forms.States(Array(np.uint8, (_J,)), JointState.IMPUTED)]


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
    return a == b or (isinstance(a, float) and math.isnan(a) and math.isnan(b))


@cache
def forms_of(kind: type) -> dict[str, Form]:
    """The forms of a message's fields, by name. Fields without a form are stored unchanged."""
    return {f.name: f.type.__metadata__[0] for f in fields(kind) if hasattr(f.type, "__metadata__")}  # pyright: ignore


_SHORT = 7
"""Largest array that `repr` shows; of others it shows the shape."""


class _Record:
    """Equality and `repr` by value, because a dataclass's own cannot compare arrays, and prints them whole; and the
    checks of the constructors.
    """

    __slots__ = ()
    __hash__ = None  # type: ignore[assignment]

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return all(_same(getattr(self, f.name), getattr(other, f.name)) for f in fields(self))  # type: ignore[arg-type]

    def __repr__(self) -> str:
        values = {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]
        large = {name for name, value in values.items() if isinstance(value, np.ndarray) and value.size > _SHORT}
        parts = (f"{name}=<{value.shape}>" if name in large else f"{name}={value!r}" for name, value in values.items())
        return f"{type(self).__name__}({', '.join(parts)})"

    def __post_init__(self) -> None:
        for name, form in forms_of(type(self)).items():
            try:
                setattr(self, name, form(getattr(self, name)))
            except UnfitError as error:
                raise ValueError(f"{type(self).__name__}.{name}: {error}") from error


@dataclass(slots=True, eq=False, repr=False)
class Pose(_Record):
    """The pose of a frame in the z-up world: world = orientation · point + position."""

    position: Vector
    """(3,) metres, world"""
    orientation: Quaternion
    """(4,) xyzw, rotates from the frame to the world"""

    @classmethod
    def identity(cls) -> "Self":
        """The identity: the frame is the world."""
        return cls(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))

    @classmethod
    def from_up(cls, up: str) -> "Self":
        """The pose of a frame at the origin whose axis `up` points up.

        `z` is the identity. `y` (graphics) and `-y` (a level camera: x right, y down, z forward) rotate by 90 degrees
        about x, so that the axis becomes the world's z. A level camera then looks along the world's +y.

        Raises:
            ValueError: `up` is another axis.
        """
        quarter = math.sqrt(0.5)
        turns = {"z": (0.0, 1.0), "y": (quarter, quarter), "-y": (-quarter, quarter)}
        if up not in turns:
            raise ValueError(f"up: expected one of 'z', 'y', '-y', got {up!r}")
        x, w = turns[up]
        return cls(np.zeros(3), np.array([x, 0.0, 0.0, w]))


@dataclass(slots=True, eq=False, repr=False)
class RawBody(_Record):
    """One body as given by the sensor, in the joints of the message's skeleton."""

    id: Id
    """the sensor's track id, int32"""
    positions: Annotated[_Array, Array(np.float32, ("J", 3))]
    """(J, 3) metres, header frame; NaN where missing"""
    confidence: Annotated[_Array, Array(np.float32, ("J",))]
    """(J,) 0 to 1"""

    def __post_init__(self) -> None:
        _Record.__post_init__(self)
        if len(self.confidence) != len(self.positions):
            shapes = f"expected shape {self.positions.shape[:1]}, got shape {self.confidence.shape}"
            raise ValueError(f"RawBody.confidence: {shapes}")


@dataclass(slots=True, eq=False, repr=False)
class _Stamped(_Record):
    """The first fields of what is published about a source's bodies."""

    stamp_ns: Stamp
    """capture time, nanoseconds, 0 or later; of `pose/events`, that of the `pose/world` they were computed from"""
    frame_id: Text
    """the frame of the positions; in the world, its name"""
    source: Text
    """the camera or recording, by name"""


@dataclass(slots=True, eq=False, repr=False)
class PoseRaw(_Stamped):
    """`pose/raw`: the bodies that a skeleton source observed at one time."""

    skeleton: Text
    """name of the joint layout: `smpl22`, `coco17`, `kinect22`, …"""
    sensor_pose: Pose
    """pose of `frame_id` in the world; only its orientation is valid unless `calibrated`"""
    calibrated: bool
    """whether `sensor_pose.position`, and so the floor at z = 0, can be trusted"""
    bodies: Annotated[list[RawBody], ListOf(RawBody)]
    end_of_stream: bool = False
    """whether the stream ends here; sent once, without bodies"""


@dataclass(slots=True, eq=False, repr=False)
class CleanBody(_Record):
    """One body as estimated by the prior, in the canonical joints `JOINTS`."""

    id: Id
    """the sensor's track id, int32"""
    positions: Positions
    """(22, 3) metres, header frame"""
    rotations: Rotations
    """(22, 4) xyzw, each from the joint's frame to its parent's, the pelvis' to the header frame. If all are the
    identity, the body stands in a T pose with +x forward, +y left, +z up"""
    state: States
    """(22,) `JointState`"""
    sigma: PerJoint
    """(22,) metres, standard deviation of a position along an axis"""
    anomaly: Number
    """anomaly score of the last half second: -log10 of the rate at which clean motion scores as high; NaN if not
    scored"""
    anomaly_flag: bool
    """whether the estimate cannot be trusted"""
    joint_anomaly: PerJoint
    """(22,) anomaly score of each joint, on the same scale; NaN where not observed"""
    bone_lengths: PerJoint
    """(22,) metres, joint to parent; 0 for the pelvis"""
    raw_positions: Positions
    """(22, 3) metres, header frame: the input joints; NaN where missing"""
    raw_confidence: PerJoint
    """(22,) 0 to 1"""


@dataclass(slots=True, eq=False, repr=False)
class PoseClean(_Stamped):
    """`pose/clean`: the bodies at one time, refined and completed, in the sensor's frame."""

    sensor_pose: Pose
    """pose of `frame_id` in the world, as in `pose/raw`"""
    calibrated: bool
    """whether `sensor_pose.position` can be trusted"""
    delay_frames: Annotated[int, Integer(0, 2**32)]
    """the prior's delay: number of later frames, at 30 Hz, that it waited for"""
    bodies: Annotated[list[CleanBody], ListOf(CleanBody)]
    end_of_stream: bool = False
    """whether the stream ends here; sent once, without bodies"""


@dataclass(slots=True, eq=False, repr=False)
class WorldBody(_Record):
    """One body in the world, in the canonical joints `JOINTS`."""

    id: Id
    """the sensor's track id, int32"""
    root_position: Vector
    """(3,) metres, world: the pelvis"""
    root_orientation: Quaternion
    """(4,) xyzw, rotates from the body (+x forward, +y left, +z up) to the world"""
    root_velocity: Vector
    """(3,) m/s, world"""
    covariance: Annotated[_Array, Array(np.float64, (6, 6))]
    """(6, 6) covariance of root position and velocity: m², m²/s, m²/s²"""
    positions: Positions
    """(22, 3) metres, world"""
    rotations: Rotations
    """(22, 4) xyzw, each from the joint's frame to its parent's, the pelvis' to the world"""
    state: States
    """(22,) `JointState`"""
    sigma: PerJoint
    """(22,) metres, standard deviation of a position along an axis"""
    contacts: Annotated[_Array, Array(np.float32, (_C,))]
    """(8,) probability that each joint of `CONTACTS` bears load on a surface, at rest or rolling over it; NaN, unknown,
    for a foot (ankle and toes) that was not observed for the last 2 s or never, and for its knee if that was not"""
    tracking: Annotated[Tracking, Integer(0, len(Tracking), Tracking)]


@dataclass(slots=True, eq=False, repr=False)
class PoseWorld(_Stamped):
    """`pose/world`: the bodies at one time, in the world. `pose/truth` has the same form."""

    ground_plane: Annotated[_Array, Array(np.float64, (4,))]
    """(4,) a, b, c, d with ax + by + cz + d = 0; the unit normal (a, b, c) points up, d in metres"""
    bodies: Annotated[list[WorldBody], ListOf(WorldBody)]
    end_of_stream: bool = False
    """whether the stream ends here; sent once, without bodies"""


@dataclass(slots=True, eq=False, repr=False)
class Event(_Record):
    """An event of one body."""

    body: Id
    """`WorldBody.id`, int32"""
    kind: Annotated[EventKind, Integer(0, len(EventKind), EventKind)]
    phase: Annotated[Phase, Integer(0, len(Phase), Phase)]
    hand: Annotated[Hand, Integer(0, len(Hand), Hand)]
    """hand of HAND_RAISED, WAVES and POINTS"""
    confidence: Number
    """0 to 1: probability of the event's condition, given the standard deviations of its joints"""
    direction: Vector
    """(3,) direction of POINTS: unit vector, world, from the head through the wrist; zeros for other events"""
    since_ns: Stamp
    """capture time at which the event began, nanoseconds"""


@dataclass(slots=True, eq=False, repr=False)
class PoseEvents(_Stamped):
    """`pose/events`: all events that begin, hold or end at one time. Sent once a second and when one begins or ends."""

    events: Annotated[list[Event], ListOf(Event)]
    end_of_stream: bool = False
    """whether the stream ends here; sent once, without events"""


@dataclass(slots=True, eq=False, repr=False)
class Diagnostics(_Record):
    """`diagnostics`: the state of one node; on the wire a diagnostic_msgs/DiagnosticArray with one status."""

    stamp_ns: Stamp
    """capture time of the node's newest frame, nanoseconds"""
    node: Text
    level: Annotated[Level, Integer(0, len(Level), Level)]
    message: Text
    """one human-readable line"""
    values: Annotated[dict[str, str], forms.texts] = field(default_factory=dict)
    """rates, latencies, counts of dropped and refused messages, by name"""


Message = PoseRaw | PoseClean | PoseWorld | PoseEvents | Diagnostics
