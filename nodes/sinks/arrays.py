"""Output as plain arrays: ``.npz``, and CSV for a spreadsheet.

The arrays have one row per input frame: ``stamp_ns`` (T,), ``positions`` (T, 22, 3) metres in the input's frame,
``rotations`` (T, 22, 4) local, xyzw, ``state`` (T, 22) `msgs.types.JointState`, ``sigma`` (T, 22) metres, ``anomaly``
(T,), ``anomaly_flag`` (T,), ``joint_anomaly`` (T, 22), ``contacts`` (T, 8), ``root_velocity`` (T, 3) m/s,
``world_positions`` (T, 22, 3) metres, and ``joint_names`` (22,). Where the prior has no body, numbers are NaN and the
state is UNKNOWN; unknown contacts are NaN too. For several bodies, an axis of bodies follows time, and ``body_id`` (B,)
lists their ids.
"""

import csv
import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.types import JOINTS, OBSERVED, EventKind, Message, PoseClean, PoseWorld
from steadypose.nodes.graph.clock import FRAME_NS
from steadypose.nodes.timeline import TimedEvent

SLACK_NS = 1_000_000
"""Time short of a period for which a row is held, nanoseconds: a period away, where there is a body, is another row."""
_ROW = np.dtype(
    [
        ("stamp_ns", np.int64),
        ("positions", np.float32, (22, 3)),
        ("world_positions", np.float32, (22, 3)),
        ("rotations", np.float32, (22, 4)),
        ("sigma", np.float32, (22,)),
        ("joint_anomaly", np.float32, (22,)),
        ("contacts", np.float32, (8,)),
        ("root_velocity", np.float64, (3,)),
        ("anomaly", np.float64),
        ("state", np.uint8, (22,)),
        ("anomaly_flag", np.bool_),
    ]
)
_NEAREST = ("state", "anomaly_flag")
_MOVING = ("positions", "world_positions", "rotations")


class NpzCollector:
    """Collects the output of both pipelines on the 30 Hz grid, and interpolates it at the stamps of the input.

    ``bodies`` are the ids of the input's axis of bodies, if it has one; the arrays then have the same axis.
    """

    def __init__(self, messages: Iterable[tuple[str, Message]] = (), bodies: Iterable[int] = ()) -> None:
        self._rows: dict[int, list[NDArray[np.void]]] = {body_id: [] for body_id in bodies}
        self._axis = bool(self._rows)
        self.newest: dict[int, NDArray[np.void]] = {}
        """the row of each body in the last ``pose/clean``, by its id"""
        for _, message in messages:
            self.add(message)

    def add(self, message: Message) -> None:
        """Add the next message of the stream. At each stamp, ``pose/clean`` must come before ``pose/world``."""
        if isinstance(message, PoseClean):
            self.newest = {}
            for body in message.bodies:
                row = self.newest[body.id] = _blank(())
                row["stamp_ns"] = message.stamp_ns
                for name in ("positions", "rotations", "state", "sigma", "anomaly", "anomaly_flag", "joint_anomaly"):
                    row[name] = getattr(body, name)
                self._rows.setdefault(body.id, []).append(row)
        elif isinstance(message, PoseWorld):
            for body in message.bodies:
                row = self.newest.get(body.id)
                if row is not None and row["stamp_ns"] == message.stamp_ns:
                    row["world_positions"] = body.positions
                    row["root_velocity"] = body.root_velocity
                    row["contacts"] = body.contacts

    def arrays(self, stamps_ns: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        """The output's arrays at ``stamps_ns`` (T,), by name."""
        blank = _blank(stamps_ns.shape)
        tracks = [_at(np.stack(rows), stamps_ns) if rows else blank for rows in self._rows.values()]
        table = np.stack(tracks, axis=1) if tracks else _blank((len(stamps_ns), 1))
        several = self._axis or len(tracks) > 1
        shown = table if several else table[:, 0]
        arrays: dict[str, NDArray[Any]] = {name: shown[name] for name in _ROW.names or () if name != "stamp_ns"}
        arrays |= {"stamp_ns": stamps_ns, "joint_names": np.array(JOINTS)}
        return arrays | {"body_id": np.array(list(self._rows), np.int32)} if several else arrays


def _blank(shape: tuple[int, ...]) -> NDArray[np.void]:
    rows = np.zeros(shape, _ROW)
    for name in _ROW.names or ():
        if rows[name].dtype.kind == "f":
            rows[name] = np.nan
    return rows


def _at(grid: NDArray[np.void], stamps_ns: NDArray[np.int64]) -> NDArray[np.void]:
    """One body's rows at other stamps: interpolated between neighbours of the grid. For less than a period beyond its
    ends, the body moves on as in the last step, and for as long into a gap it is held."""
    grid = grid[np.unique(grid["stamp_ns"], return_index=True)[1]]
    after = np.searchsorted(grid["stamp_ns"], stamps_ns, side="right").clip(1, max(len(grid) - 1, 1))
    before, after = after - 1, np.minimum(after, len(grid) - 1)
    first, last = grid["stamp_ns"][before], grid["stamp_ns"][after]
    span = last - first
    fraction = (stamps_ns - first) / np.maximum(span, 1)
    nearest = np.where(np.abs(stamps_ns - first) <= np.abs(last - stamps_ns), before, after)
    # in a gap of the grid there is at most one neighbour; at its ends there are two, on the same side
    adjacent = span <= 1.5 * FRAME_NS
    between = adjacent & (fraction >= 0) & (fraction <= 1)
    known = between | (np.abs(grid["stamp_ns"][nearest] - stamps_ns) < FRAME_NS - SLACK_NS)
    before, after = np.where(adjacent, before, nearest), np.where(adjacent, after, nearest)
    fraction = np.where(adjacent, fraction, 0.0)

    rows = _blank(stamps_ns.shape)
    for name in _ROW.names or ():
        values = grid[name]
        if name in _NEAREST:
            rows[name][known] = values[nearest][known]
        elif name != "stamp_ns":
            share = fraction if name in _MOVING else fraction.clip(0.0, 1.0)
            weight = share.reshape(-1, *[1] * (values.ndim - 1))
            a, b = values[before].astype(np.float64), values[after].astype(np.float64)
            mixed = _slerp(a, b, weight) if name == "rotations" else a + weight * (b - a)
            rows[name][known] = np.where(np.isnan(mixed), values[nearest], mixed)[known]
    rows["stamp_ns"] = stamps_ns
    return rows


def _slerp(a: NDArray[np.float64], b: NDArray[np.float64], fraction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit quaternions (..., 4), interpolated on the shorter arc from ``a`` to ``b``."""
    cosine = (a * b).sum(axis=-1, keepdims=True)
    b, angle = np.where(cosine < 0, -b, b), np.arccos(np.minimum(np.abs(cosine), 1.0))
    small = angle < 1e-4
    sine = np.where(small, 1.0, np.sin(angle))
    from_a = np.where(small, 1.0 - fraction, np.sin((1.0 - fraction) * angle) / sine)
    from_b = np.where(small, fraction, np.sin(fraction * angle) / sine)
    return from_a * a + from_b * b


_PARTS = ("x", "y", "z", "confidence", "state", "sigma")


def write_csv(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write the arrays of `NpzCollector`, for one body or several, as CSV."""
    several = "body_id" in arrays
    columns = ["stamp", *(["body"] if several else [])]
    columns += [f"{joint}_{part}" for joint in JOINTS for part in _PARTS] + ["anomaly", "anomaly_flag"]
    with path.open("w", newline="", encoding="utf-8") as file:
        file.write("# skeleton: smpl22\n# up: z\n")
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(_rows(arrays, several))


def _rows(arrays: Mapping[str, NDArray[Any]], several: bool) -> Iterator[list[str]]:
    ids = arrays["body_id"].tolist() if several else [0]

    def of_bodies(name: str) -> NDArray[Any]:
        return arrays[name] if several else arrays[name][:, None]

    joints, state, sigma = of_bodies("world_positions"), of_bodies("state"), of_bodies("sigma")
    anomaly, flag = of_bodies("anomaly"), of_bodies("anomaly_flag")
    observed = np.isin(state, OBSERVED).astype(int)
    for row, stamp_ns in enumerate(arrays["stamp_ns"].tolist()):
        for body, number in enumerate(ids):
            if several and np.isnan(joints[row, body]).all():
                continue  # absent bodies have no row
            cells = [_seconds(stamp_ns), *([str(number)] if several else [])]
            for joint in range(len(JOINTS)):
                at = row, body, joint
                cells += [_cell(value, 5) for value in joints[at].tolist()]
                cells += [str(observed[at]), str(state[at]), _cell(float(sigma[at]), 5)]
            yield [*cells, _cell(float(anomaly[row, body]), 3), str(int(flag[row, body]))]


def write_events(path: Path, events: Iterable[TimedEvent]) -> None:
    """Write events as CSV: a row each, with its begin and end in seconds."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        direction = [f"direction_{axis}" for axis in "xyz"]
        writer.writerow(["body", "event", "hand", "begin", "end", "confidence", *direction])
        for event in events:
            hand = event.hand.name if event.hand else ""
            times = [_seconds(event.begin_ns), _seconds(event.end_ns)]
            direction = [_cell(x, 3) if event.kind == EventKind.POINTS else "" for x in event.direction.tolist()]
            writer.writerow([event.body, event.kind.name, hand, *times, _cell(event.confidence, 3), *direction])


def _seconds(stamp_ns: int) -> str:
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"


def _cell(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else ""
