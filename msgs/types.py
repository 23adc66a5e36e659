"""The messages as Python dataclasses.

Units are SI; stamps are nanoseconds of capture; quaternions are xyzw; the world is right-handed with z up and
the floor at z = 0. A constructor takes anything numpy reads as an array, gives it the dtype written here, and
raises `ValueError` naming the field, what was expected and what came. It checks form, not plausibility: a NaN or
a body 10 km away is a valid message, and the receiver's business.

Messages compare by value, NaN equal to NaN.
"""

from __future__ import annotations

import math
import operator
from dataclasses import dataclass, field, fields
from enum import IntEnum
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

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
"""The joints of `WorldBody.contacts`, in its order (an ankle stands for the heel, a foot for the toe)."""

# What a field holds. For a type checker any array will do, because the constructors convert.
Float32 = NDArray[Any]
Float64 = NDArray[Any]
UInt8 = NDArray[Any]

_J = len(JOINTS)
_C = len(CONTACTS)
_SECONDS_END = 2**31  # builtin_interfaces/Time counts seconds in an int32
_INT32 = 2**31


class JointState(IntEnum):
    """Where a joint's position comes from."""

    UNKNOWN = 0
    """no estimate: do not use"""
    SEEN = 1
    """the sensor's own, passed on"""
    REFINED = 2
    """seen, then corrected by the prior"""
    IMPUTED = 3
    """not seen: inferred from the rest of the body and its motion"""


class Tracking(IntEnum):
    """Whether a body's place in the world rests on observation."""

    OK = 0
    COASTING = 1
    """the root is not observed for now: predicted, its covariance growing"""
    LOST = 2
    """predicted for too long to be of use"""


class EventKind(IntEnum):
    """What a person does."""

    ENTERED = 0
    LEFT = 1
    NEAR = 2
    """within reach of the sensor"""
    STANDS = 3
    """upright on the feet, walking included"""
    SITS = 4
    LIES = 5
    FELL = 6
    """came to lie fast, and has not got up since"""
    HAND_RAISED = 7
    WAVES = 8
    POINTS = 9
    FACES_SENSOR = 10


class Phase(IntEnum):
    """Where an event is in its course."""

    BEGINS = 0
    HOLDS = 1
    ENDS = 2


class Hand(IntEnum):
    """Whose event it is; `NONE` for those of the whole body."""

    NONE = 0
    LEFT = 1
    RIGHT = 2


class Level(IntEnum):
    """The levels of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
    return a == b or (isinstance(a, float) and math.isnan(a) and math.isnan(b))


class _Record:
    """Equality by value (the dataclass' own cannot compare arrays) and the checks of the constructors."""

    __slots__ = ()
    __hash__ = None  # type: ignore[assignment]

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return all(_same(getattr(self, f.name), getattr(other, f.name)) for f in fields(self))  # type: ignore[arg-type]

    def _fail(self, name: str, expected: str, got: object) -> ValueError:
        return ValueError(f"{type(self).__name__}.{name}: expected {expected}, got {got}")

    def _array(self, name: str, dtype: type[np.generic], *shape: int) -> None:
        value = getattr(self, name)
        try:
            array = np.asarray(value, dtype)
        except (TypeError, ValueError, OverflowError) as error:
            raise self._fail(name, f"{dtype.__name__} numbers of shape {shape}", repr(value)[:80]) from error
        if array.shape != shape:
            raise self._fail(name, f"shape {shape}", f"shape {array.shape}")
        setattr(self, name, array)

    def _states(self, name: str) -> None:
        states = np.asarray(getattr(self, name))
        if states.size and not (states.min() >= 0 and states.max() <= JointState.IMPUTED):
            raise self._fail(name, f"JointState values, 0 to {JointState.IMPUTED:d}", states.tolist())
        self._array(name, np.uint8, _J)

    def _integer(self, name: str, low: int, end: int) -> None:
        value = getattr(self, name)
        try:
            number = operator.index(value)
        except TypeError as error:
            raise self._fail(name, "an integer", repr(value)[:80]) from error
        if not low <= number < end:
            raise self._fail(name, f"an integer of {low} or more and under {end}", number)
        setattr(self, name, number)

    def _number(self, name: str) -> None:
        value = getattr(self, name)
        try:
            setattr(self, name, float(value))
        except (TypeError, ValueError) as error:
            raise self._fail(name, "a number", repr(value)[:80]) from error

    def _stamp(self) -> None:
        self._integer("stamp_ns", 0, _SECONDS_END * 10**9)

    def _texts(self, *names: str) -> None:
        for name in names:
            value = getattr(self, name)
            if not isinstance(value, str):
                raise self._fail(name, "a string", repr(value)[:80])

    def _list(self, name: str, item: type) -> None:
        value = getattr(self, name)
        if not isinstance(value, list) or not all(isinstance(x, item) for x in value):
            raise self._fail(name, f"a list of {item.__name__}", repr(value)[:80])


@dataclass(slots=True, eq=False)
class Pose(_Record):
    """A frame's pose in the z-up world: world = orientation · point + position."""

    position: Float64
    """(3,) metres, world"""
    orientation: Float64
    """(4,) xyzw, from the frame to the world"""

    def __post_init__(self) -> None:
        self._array("position", np.float64, 3)
        self._array("orientation", np.float64, 4)

    @classmethod
    def identity(cls) -> Self:
        """The pose of a frame that is the world itself."""
        return cls(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))

    @classmethod
    def from_up(cls, up: str) -> Self:
        """The pose, at the origin, of a frame whose axis `up` points up.

        `z` is the identity. `y` (graphics) and `-y` (a level camera: x right, y down, z forward) turn about x
        by the quarter that brings that axis to the world's z; a level camera then looks along the world's +y.

        Raises:
            ValueError: for any other axis.
        """
        quarter = math.sqrt(0.5)
        turns = {"z": (0.0, 1.0), "y": (quarter, quarter), "-y": (-quarter, quarter)}
        if up not in turns:
            raise ValueError(f"up: expected one of 'z', 'y', '-y', got {up!r}")
        x, w = turns[up]
        return cls(np.zeros(3), np.array([x, 0.0, 0.0, w]))


@dataclass(slots=True, eq=False)
class RawBody(_Record):
    """One body as the sensor gives it, in the joints of the message's skeleton."""

    id: int
    """the sensor's track id, int32"""
    positions: Float32
    """(J, 3) metres, header frame; NaN where missing"""
    confidence: Float32
    """(J,) 0 to 1"""

    def __post_init__(self) -> None:
        self._integer("id", -_INT32, _INT32)
        shape = np.shape(self.positions)
        if len(shape) != 2:
            raise self._fail("positions", "shape (J, 3)", f"shape {shape}")
        self._array("positions", np.float32, shape[0], 3)
        self._array("confidence", np.float32, shape[0])


@dataclass(slots=True, eq=False)
class PoseRaw(_Record):
    """`pose/raw`: what a skeleton source saw at one moment."""

    stamp_ns: int
    """capture, nanoseconds, 0 or later"""
    frame_id: str
    """the frame of the positions"""
    source: str
    """the camera or recording, by name"""
    skeleton: str
    """the joints' names and order: `smpl22`, `coco17`, `kinect22`, …"""
    sensor_pose: Pose
    """of `frame_id` in the world; only the orientation means anything unless `calibrated`"""
    calibrated: bool
    """whether `sensor_pose.position`, and so the floor at z = 0, can be trusted"""
    bodies: list[RawBody]
    end_of_stream: bool = False
    """the source ends here: sent once, without bodies"""

    def __post_init__(self) -> None:
        self._stamp()
        self._texts("frame_id", "source", "skeleton")
        self._list("bodies", RawBody)


@dataclass(slots=True, eq=False)
class CleanBody(_Record):
    """One body after the prior, in the canonical joints `JOINTS`."""

    id: int
    """the sensor's track id, int32"""
    positions: Float32
    """(22, 3) metres, header frame"""
    rotations: Float32
    """(22, 4) xyzw, each from the joint's to its parent's frame; the pelvis' to the header frame. At rest, all
    identity, the body stands in a T with +x forward, +y left, +z up"""
    state: UInt8
    """(22,) `JointState`"""
    sigma: Float32
    """(22,) metres, standard deviation of a position along an axis"""
    anomaly: float
    """how unlike human motion the last half second is: -log10 of the rate at which clean motion scores as high; NaN if
    it was not scored"""
    anomaly_flag: bool
    """the estimate cannot be trusted"""
    joint_anomaly: Float32
    """(22,) the same scale, joint by joint: which ones caused it; NaN where not seen"""
    bone_lengths: Float32
    """(22,) metres, joint to parent; 0 for the pelvis"""
    raw_positions: Float32
    """(22, 3) metres, header frame: the joints that went in; NaN where missing"""
    raw_confidence: Float32
    """(22,) 0 to 1"""

    def __post_init__(self) -> None:
        self._integer("id", -_INT32, _INT32)
        self._array("positions", np.float32, _J, 3)
        self._array("rotations", np.float32, _J, 4)
        self._states("state")
        self._array("sigma", np.float32, _J)
        self._number("anomaly")
        self._array("joint_anomaly", np.float32, _J)
        self._array("bone_lengths", np.float32, _J)
        self._array("raw_positions", np.float32, _J, 3)
        self._array("raw_confidence", np.float32, _J)


@dataclass(slots=True, eq=False)
class PoseClean(_Record):
    """`pose/clean`: the bodies at one moment, refined and complete, in the sensor's frame."""

    stamp_ns: int
    """the moment the poses are of, on the clock of capture; nanoseconds"""
    frame_id: str
    """the frame of the positions, as it came"""
    source: str
    """the camera or recording, by name"""
    sensor_pose: Pose
    """of `frame_id` in the world, as it came"""
    calibrated: bool
    """whether `sensor_pose.position` can be trusted"""
    delay_frames: int
    """how many later frames, at 30 Hz, the prior waited for"""
    bodies: list[CleanBody]
    end_of_stream: bool = False
    """the source ends here: sent once, without bodies"""

    def __post_init__(self) -> None:
        self._stamp()
        self._texts("frame_id", "source")
        self._integer("delay_frames", 0, 2**32)
        self._list("bodies", CleanBody)


@dataclass(slots=True, eq=False)
class WorldBody(_Record):
    """One body in the world, in the canonical joints `JOINTS`."""

    id: int
    """the sensor's track id, int32"""
    root_position: Float64
    """(3,) metres, world: the pelvis"""
    root_orientation: Float64
    """(4,) xyzw, from the body (+x forward, +y left, +z up) to the world"""
    root_velocity: Float64
    """(3,) m/s, world"""
    covariance: Float64
    """(6, 6) of root position and velocity: m², m²/s, m²/s²"""
    positions: Float32
    """(22, 3) metres, world"""
    rotations: Float32
    """(22, 4) xyzw, each from the joint's to its parent's frame; the pelvis' to the world"""
    state: UInt8
    """(22,) `JointState`"""
    sigma: Float32
    """(22,) metres, standard deviation of a position along an axis"""
    contacts: Float32
    """(8,) probability that each of `CONTACTS` bears load on something: rests on it, or rolls over it"""
    tracking: Tracking

    def __post_init__(self) -> None:
        self._integer("id", -_INT32, _INT32)
        self._array("root_position", np.float64, 3)
        self._array("root_orientation", np.float64, 4)
        self._array("root_velocity", np.float64, 3)
        self._array("covariance", np.float64, 6, 6)
        self._array("positions", np.float32, _J, 3)
        self._array("rotations", np.float32, _J, 4)
        self._states("state")
        self._array("sigma", np.float32, _J)
        self._array("contacts", np.float32, _C)
        self._integer("tracking", Tracking.OK, Tracking.LOST + 1)
        self.tracking = Tracking(self.tracking)


@dataclass(slots=True, eq=False)
class PoseWorld(_Record):
    """`pose/world`: the bodies at one moment, in the world. `pose/truth` has the same form."""

    stamp_ns: int
    """the moment the poses are of, on the clock of capture; nanoseconds"""
    frame_id: str
    """the world's name"""
    source: str
    """the camera or recording, by name"""
    ground_plane: Float64
    """(4,) a, b, c, d with ax + by + cz + d = 0, the unit normal (a, b, c) up, d in metres"""
    bodies: list[WorldBody]
    end_of_stream: bool = False
    """the source ends here: sent once, without bodies"""

    def __post_init__(self) -> None:
        self._stamp()
        self._texts("frame_id", "source")
        self._array("ground_plane", np.float64, 4)
        self._list("bodies", WorldBody)


@dataclass(slots=True, eq=False)
class Event(_Record):
    """Something that one body does."""

    body: int
    """`WorldBody.id`, int32"""
    kind: EventKind
    phase: Phase
    hand: Hand
    """of HAND_RAISED, WAVES and POINTS"""
    confidence: float
    """0 to 1: the probability of its condition, given the standard deviations of the joints it was computed from"""
    direction: Float64
    """(3,) of POINTS: unit vector, world, from the head through the wrist; zeros otherwise"""
    since_ns: int
    """capture, nanoseconds: when it began"""

    def __post_init__(self) -> None:
        self._integer("body", -_INT32, _INT32)
        self._integer("kind", EventKind.ENTERED, EventKind.FACES_SENSOR + 1)
        self._integer("phase", Phase.BEGINS, Phase.ENDS + 1)
        self._integer("hand", Hand.NONE, Hand.RIGHT + 1)
        self.kind, self.phase, self.hand = EventKind(self.kind), Phase(self.phase), Hand(self.hand)
        self._number("confidence")
        self._array("direction", np.float64, 3)
        self._integer("since_ns", 0, _SECONDS_END * 10**9)


@dataclass(slots=True, eq=False)
class PoseEvents(_Record):
    """`pose/events`: all that begins, holds or ends at one moment. Sent when something begins or ends, and once a
    second."""

    stamp_ns: int
    """of the `pose/world` it was computed from, nanoseconds"""
    frame_id: str
    """the world's name"""
    source: str
    """the camera or recording, by name"""
    events: list[Event]
    end_of_stream: bool = False
    """the source ends here: sent once, without events"""

    def __post_init__(self) -> None:
        self._stamp()
        self._texts("frame_id", "source")
        self._list("events", Event)


@dataclass(slots=True, eq=False)
class Diagnostics(_Record):
    """`diagnostics`: how one node is doing; on the wire a diagnostic_msgs/DiagnosticArray of one status."""

    stamp_ns: int
    """nanoseconds, on the clock of the frames it speaks of"""
    node: str
    level: Level
    message: str
    """one line for a person"""
    values: dict[str, str] = field(default_factory=dict)
    """rates, latencies, counts of dropped and refused messages, by name"""

    def __post_init__(self) -> None:
        self._stamp()
        self._texts("node", "message")
        self._integer("level", Level.OK, Level.STALE + 1)
        self.level = Level(self.level)
        if not all(isinstance(text, str) for pair in self.values.items() for text in pair):
            raise self._fail("values", "strings for keys and values", repr(self.values)[:80])


Message = PoseRaw | PoseClean | PoseWorld | PoseEvents | Diagnostics
