"""`Poses`, the result of `steadypose.Filter` and `steadypose.clean`, with joints accessible by name; and `sample` data
from steadypose's simulator.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from steadypose import PACKAGE
from steadypose.msgs.types import CONTACTS, JOINTS, PoseRaw, PoseWorld
from steadypose.nodes.graph.launch import bundled
from steadypose.nodes.sinks.drawing import to_world
from steadypose.nodes.sources.recording import open_recording
from steadypose.nodes.timeline import TimedEvent
from steadypose.prior.body.layouts import SKELETONS, to_canonical
from steadypose.prior.settings import nearest

if TYPE_CHECKING:
    import pandas  # pyright: ignore[reportMissingImports]
    import xarray  # pyright: ignore[reportMissingImports]

ALWAYS = ("stamp_ns", "joint_names", "body_id")
"""Arrays without an axis of bodies."""
AXES: dict[str, tuple[str, ...]] = {
    "positions": ("joint", "axis"),
    "world_positions": ("joint", "axis"),
    "rotations": ("joint", "quaternion"),
    "contacts": ("contact",),
    "root_velocity": ("axis",),
    **dict.fromkeys(("state", "sigma", "joint_anomaly"), ("joint",)),
    **dict.fromkeys(("anomaly", "anomaly_flag"), ()),
}
"""Axes of each array after those of time and bodies."""


class ByName(NDArray[Any] if TYPE_CHECKING else np.ndarray):
    """An array that you can index by joint names: ``positions["left_wrist"]``, ``sigma[["neck", "head"]]``.

    Any other index works as in numpy, and gives a plain array.
    """

    _names: tuple[str, ...] = ()
    _axis = 0

    @classmethod
    def of(cls, array: NDArray[Any], names: tuple[str, ...], axis: int) -> ByName:
        """A view of an array whose axis, counted from the end, has these names."""
        named = np.asarray(array).view(cls)
        named._names, named._axis = names, axis
        return named

    def __array_finalize__(self, source: Any) -> None:
        if isinstance(source, ByName) and source.shape == self.shape:
            self._names, self._axis = source._names, source._axis

    def __getitem__(self, key: Any) -> Any:
        plain = self.view(np.ndarray)
        if isinstance(key, str):
            return plain.take(self._index(key), axis=self._axis)
        if isinstance(key, (list, tuple)) and key and all(isinstance(name, str) for name in key):
            return plain.take([self._index(name) for name in key], axis=self._axis)
        return plain[key]

    def _index(self, name: str) -> int:
        if name in self._names:
            return self._names.index(name)
        known = ", ".join(self._names) or "none: the axis of joints is gone; take the joint before computing with it"
        raise KeyError(f"no joint {name!r}{nearest(name, self._names)}; expected one of {known}")


class Poses(dict[str, NDArray[Any]]):
    """Poses of one frame or of T frames: the arrays that ``steadypose clean`` writes, by name and as attributes.

    The shapes below are for one body in one frame. With T frames, each array has a leading axis T. If the input has an
    axis of bodies, an axis of B bodies follows it, in the order of ``body_id``.

    Attributes:
        problems: probable faults of the input, as text, with the remedy.
        refused: counts of unused frames, bodies and joints, by cause.
        events: what the people do. Of `clean`, each event once, by begin; of a `Filter`, what begins, holds or ends
            now. AttributeError if nobody looked for events.
    """

    events: tuple[TimedEvent, ...]

    def __init__(
        self,
        arrays: Mapping[str, NDArray[Any]],
        problems: Iterable[str] = (),
        refused: Mapping[str, int] | None = None,
        events: Iterable[TimedEvent] | None = None,
    ) -> None:
        super().__init__(arrays)
        if events is not None:
            self.events = tuple(events)
        self.problems: tuple[str, ...] = tuple(problems)
        self.refused: dict[str, int] = dict(refused or {})

    @property
    def stamp_ns(self) -> NDArray[np.int64]:
        """Time of capture in nanoseconds; for one frame, a number."""
        return self["stamp_ns"][()]

    @property
    def t(self) -> NDArray[np.float64]:
        """Time of capture in seconds: `stamp_ns` / 1e9."""
        return self["stamp_ns"][()] / 1e9

    @property
    def positions(self) -> ByName:
        """(22, 3) metres, in the input's frame, by joint."""
        return self._by_name("positions")

    @property
    def world(self) -> ByName:
        """(22, 3) metres, world frame, by joint: z up; floor at z = 0 if the sensor's pose is known."""
        return self._by_name("world_positions")

    @property
    def rotations(self) -> ByName:
        """(22, 4) xyzw, by joint: from the joint's frame to its parent's; for the pelvis, to the input's frame."""
        return self._by_name("rotations")

    @property
    def state(self) -> ByName:
        """(22,) `JointState`, by joint: seen, refined, imputed or unknown."""
        return self._by_name("state")

    @property
    def sigma(self) -> ByName:
        """(22,) metres, by joint: standard deviation of the position along one axis."""
        return self._by_name("sigma")

    @property
    def joint_anomaly(self) -> ByName:
        """(22,) anomaly score of each joint, by joint; NaN if it was not observed."""
        return self._by_name("joint_anomaly")

    @property
    def anomaly(self) -> Any:
        """Anomaly score: -log10 of the rate at which clean motion scores as high; NaN if not scored."""
        return self["anomaly"][()]

    @property
    def anomaly_flag(self) -> Any:
        """True if the pose should not be trusted."""
        return self["anomaly_flag"][()]

    @property
    def contacts(self) -> ByName:
        """(8,) probability that a joint of `CONTACTS` (knees, ankles, feet, wrists) bears load, by joint; NaN if
        unknown.
        """
        return self._by_name("contacts")

    @property
    def root_velocity(self) -> NDArray[np.float64]:
        """(3,) m/s, velocity of the pelvis, world frame."""
        return self["root_velocity"]

    @property
    def body_id(self) -> NDArray[np.int32]:
        """(B,) ids of the bodies; only 0 if the input has no axis of bodies."""
        return self.get("body_id", np.zeros(1, np.int32))

    @property
    def bodies(self) -> dict[int, Poses]:
        """Poses of each body, by id, without an axis of bodies."""
        if "body_id" not in self:
            return {0: self}
        axis = self["stamp_ns"].ndim
        common = {name: self[name] for name in self if name in ALWAYS[:2]}
        own = [name for name in self if name not in ALWAYS]
        bodies = {}
        for row, id in enumerate(self["body_id"].tolist()):
            arrays = common | {name: self[name].take(row, axis) for name in own}
            bodies[id] = Poses(arrays, self.problems, self.refused)
            if "events" in vars(self):
                bodies[id].events = tuple(event for event in self.events if event.body == id)
        return bodies

    def to_dict(self) -> dict[str, NDArray[Any]]:
        """Plain arrays by name, as in the ``.npz``."""
        return dict(self)

    def to_xarray(self) -> xarray.Dataset:
        """Convert to a dataset with named axes: time, body, joint, contact, axis, quaternion.

        Raises:
            ModuleNotFoundError: xarray is not installed.
        """
        xarray = _installed("xarray")

        lead = [*(["time"] if self["stamp_ns"].ndim else []), *(["body"] if "body_id" in self else [])]
        coordinates: dict[str, Any] = {"joint": list(JOINTS), "contact": list(CONTACTS), "axis": list("xyz")}
        coordinates |= {"quaternion": list("xyzw"), "stamp_ns": (lead[:1] if "time" in lead else [], self["stamp_ns"])}
        if "time" in lead:
            coordinates["time"] = np.asarray(self.t)
        if "body_id" in self:
            coordinates["body"] = self["body_id"]
        return xarray.Dataset({name: ([*lead, *own], self[name]) for name, own in AXES.items()}, coords=coordinates)

    def to_pandas(self) -> pandas.DataFrame:
        """Convert to a table with one row per frame and body, and columns such as ``left_wrist_x`` (metres, world).

        Raises:
            ModuleNotFoundError: pandas is not installed.
        """
        pandas = _installed("pandas")

        tables = []
        for id, body in self.bodies.items():
            count = body["stamp_ns"].size
            columns: dict[str, Any] = {"t": np.reshape(body.t, count), "body": np.full(count, id)}
            for joint in JOINTS:
                place = np.reshape(body.world[joint], (count, 3))
                columns |= {f"{joint}_{axis}": place[:, number] for number, axis in enumerate("xyz")}
                columns |= {
                    f"{joint}_{name}": np.reshape(body._by_name(name)[joint], count) for name in ("state", "sigma")
                }
            columns |= {name: np.reshape(body[name], count) for name in ("anomaly", "anomaly_flag")}
            tables.append(pandas.DataFrame(columns))
        return pandas.concat(tables, ignore_index=True).sort_values(["t", "body"], ignore_index=True)

    def __repr__(self) -> str:
        return _shapes("Poses", self)

    if not TYPE_CHECKING:  # so that type checkers still find a wrong name

        def __getattr__(self, name: str) -> Any:
            if name == "events":
                expected = "poses of steadypose.clean(...), or of steadypose.Filter(..., events=True)"
                raise AttributeError(f"no events: expected {expected}")
            raise AttributeError(f"Poses has no attribute {name!r}{nearest(name, dir(self))}")

        def __missing__(self, name: str) -> Any:
            raise KeyError(f"no array {name!r}{nearest(name, self)}; there are {', '.join(self)}")

    def _by_name(self, name: str) -> ByName:
        first, *others = AXES[name]
        return ByName.of(self[name], CONTACTS if first == "contact" else JOINTS, -1 - len(others))


def _shapes(kind: str, arrays: Mapping[str, NDArray[Any]]) -> str:
    return f"<{kind} {', '.join(f'{name} {array.shape}' for name, array in arrays.items())}>"


def _installed(name: str) -> Any:
    """Import an optional library, which no extra installs.

    Raises:
        ModuleNotFoundError: it is not installed. The text has the command to install it.
    """
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name:
            raise
        text = f"to_{name} needs {name}, which is not installed: pip install {name}"
        raise ModuleNotFoundError(text, name=name) from error


BUNDLED = "walk_turn"
"""Sample of every installation."""


@dataclass(frozen=True)
class Sample:
    """A recording of a simulated depth camera, with hidden joints, jumps and noise.

    Attributes:
        positions: (T, 22, 3) metres, world, z up; NaN where unobserved. With several bodies, (T, B, 22, 3).
        stamp_ns: (T,) times of capture in nanoseconds.
        truth: ground truth without noise or gaps, in the shape of ``positions``, interpolated at these stamps.
    """

    positions: NDArray[np.float64]
    stamp_ns: NDArray[np.int64]
    truth: NDArray[np.float64]

    def __repr__(self) -> str:
        return _shapes("Sample", vars(self))


def sample(name: str = BUNDLED) -> Sample:
    """Load sample data: ``s = steadypose.sample(); steadypose.clean(s.positions, stamp_ns=s.stamp_ns)``.

    Args:
        name: name of the sample. ``walk_turn``, 20 s of a walk, is in every installation; ``reach``, ``sit_rise``,
            ``wave_hidden_arm``, ``crossing`` (two people), ``leave_reenter`` and ``idle`` are in a checkout only.

    Raises:
        ValueError: unknown name; the message lists the samples.
    """
    streams = {file.parent.name: file.parent for file in bundled("sim_data").glob("*/metadata.yaml")}
    if name not in streams:
        hint = nearest(name, streams)
        checkout = "" if (PACKAGE.parents[1] / "pyproject.toml").exists() else "; a checkout of steadypose has more"
        raise ValueError(f"no sample {name!r}{hint}: there are {', '.join(sorted(streams))}{checkout}")
    raws: list[PoseRaw] = []
    truths: list[PoseWorld] = []
    for _, message in open_recording(streams[name]):
        if isinstance(message, PoseRaw):
            raws.append(message)
        elif isinstance(message, PoseWorld):
            truths.append(message)
    ids = sorted({body.id for raw in raws for body in raw.bodies})
    positions = np.full((len(raws), len(ids), 22, 3), np.nan)
    for row, raw in enumerate(raws):
        for body in raw.bodies:
            joints = to_world(body.positions, raw.sensor_pose)
            positions[row, ids.index(body.id)] = to_canonical(SKELETONS[raw.skeleton], joints, body.confidence)[0]
    stamps = np.array([raw.stamp_ns for raw in raws], np.int64)
    people = sorted({body.id for message in truths for body in message.bodies})
    places = np.full((len(truths), len(people), 22, 3), np.nan)
    for row, message in enumerate(truths):
        for body in message.bodies:
            places[row, people.index(body.id)] = body.positions
    from scipy.interpolate import interp1d  # imported late: it takes a tenth of a second

    times = np.array([message.stamp_ns for message in truths])
    known = np.clip(stamps, times[0], times[-1])  # the camera's last frame may be a little later than the last truth
    truth = interp1d(times - times[0], places, axis=0)(known - times[0])
    alone = len(ids) == len(people) == 1
    return Sample(positions[:, 0], stamps, truth[:, 0]) if alone else Sample(positions, stamps, truth)
