"""``steadypose calibrate sensor``: a sensor's own error, learned from recordings of it beside a reference."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np
import tyro
from numpy.typing import NDArray

from steadypose.msgs.types import PoseRaw
from steadypose.nodes.checks.problem import observed
from steadypose.nodes.commands.batch import FILES, find_recordings, is_folder_of_recordings
from steadypose.nodes.commands.output import check_output, plural
from steadypose.nodes.extras import require_extra
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sinks.drawing import to_world
from steadypose.nodes.sources.npz import read_arrays
from steadypose.nodes.sources.recording import open_recording
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import rigid_alignment
from steadypose.prior.body.layouts import SKELETONS, to_canonical
from steadypose.prior.body.skeleton import finite_joints
from steadypose.prior.complete.stream import interpolated
from steadypose.prior.timing.rate import FPS

if TYPE_CHECKING:
    from steadypose.training.recipes.sensor_bias import HeldOut, SensorTake

SHORTEST_S = 10.0  # time in seconds that sensor and reference have in common, at least, in all recordings together
FARTHEST_M, SHIFTS = 0.25, range(-15, 16)
"""Largest mean distance of a sensor's aligned joints from the reference's, metres; tried shifts, ticks of 30 Hz."""


@dataclass(frozen=True)
class CalibrateSensor:
    """Train a correction of a sensor's bias from recordings beside a reference: markers, or several cameras.

    The bias of a depth camera or a network depends on pose and direction of view, and does not average out. The
    command prints the error before and after correction by cross-validation over people. Ten people with a few
    minutes each are good; three are the minimum.

    Sensor and reference need stamps of one clock, or the same first frame. Their frames of reference and rates may
    differ, and joints may be missing. The sensor must stand still, and a recording must show one person, who is named
    by the array 'person' of an .npz, else by the folder, else by the file name.

    Try:
      steadypose calibrate sensor oak/ vicon/ --name my_oak --install
      steadypose run oak --set prior.correct.sensor=my_oak

    Args:
        recording: recording of the sensor, in a format of 'steadypose clean'; or a folder of them.
        reference: recording of the reference at the same time; or a folder with files of the same names.
        name: name of the sensor, for correct.sensor.
        out: folder for the weights, correction-NAME.safetensors, and their card.
        iterations: optimiser steps; fewer give a weaker correction sooner.
        install: install the weights under this name; otherwise, set correct.sensor to their path.
    """

    recording: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RECORDING")]
    reference: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="REFERENCE")]
    name: str = "my_sensor"
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path()
    iterations: int | None = None
    install: bool = False

    def run(self) -> None:
        check_output(self.recording, self.out / f"correction-{self.name}.safetensors")
        takes = list(read_takes(self.recording, self.reference))
        require_extra("train")
        from steadypose.training.distributed import set_threads
        from steadypose.training.loop import TrainingOptions
        from steadypose.training.recipes.sensor_bias import leave_one_person_out, train_sensor
        from steadypose.training.weights import install

        set_threads(1)  # of so small a network two are slower
        people = len({take.person for take in takes})
        print(f"{plural(len(takes), 'recording')} of {plural(people, 'person', 'people')}")
        with tempfile.TemporaryDirectory() as folder:
            try:
                options = TrainingOptions(self.recording, Path(folder), self.name, self.iterations)
            except ValueError as error:
                raise LaunchError(f"--{error}") from error
            _print_held_out(list(leave_one_person_out(takes, options)) if people > 1 else [])
            made = train_sensor(takes, options)
            kept = [made, made.with_suffix(".md"), made.with_suffix(".png")]
            for file in kept:
                (self.out / file.name).write_bytes(file.read_bytes())
        path = (self.out / made.name).resolve()
        sensor = self.name if self.install else path
        print(f"weights: {install(path) if self.install else path}")
        print(f'for a launch file: [prior.correct] sensor = "{sensor}"; to try: --set prior.correct.sensor={sensor}')


def _print_held_out(found: list[HeldOut]) -> None:
    if not found:
        print("one person: how far it helps others cannot be said; record at least three")
        return
    for held in found:
        print(f"  without {held.person}: {1e3 * held.observed_m:.1f} mm off, corrected {1e3 * held.corrected_m:.1f}")
    before, after = np.array([[held.observed_m, held.corrected_m] for held in found]).mean(axis=0)
    print(f"mean of {len(found)} people left out: {1e3 * before:.1f} mm off, corrected {1e3 * after:.1f}")
    if after > before:
        print("warning: it makes people whom it has not seen worse; do not use it, record more people")


class _Joints(NamedTuple):
    stamps_ns: NDArray[np.int64]
    positions: Floats
    camera: Floats


def read_takes(recording: Path, reference: Path) -> Iterator[SensorTake]:
    """Recordings beside their references, on a grid of 30 Hz. Raises LaunchError if they do not belong together."""
    require_extra("train")
    from steadypose.training.recipes.sensor_bias import SensorTake

    common_s = 0.0
    for observed_at, truth_at in _pairs(recording, reference):
        sensor, truth = _joints(observed_at), _joints(truth_at)
        first = max(sensor.stamps_ns[0], truth.stamps_ns[0])
        last = min(sensor.stamps_ns[-1], truth.stamps_ns[-1])
        if last <= first:
            raise LaunchError(f"{observed_at} and {truth_at}: expected stamps of one clock, got no time in common")
        ticks = np.arange(first, last, 1e9 / FPS).astype(np.int64)
        common_s += (last - first) * 1e-9
        take = SensorTake(_person(observed_at, recording), _at(sensor, ticks), sensor.camera, _at(truth, ticks))
        _check_match(take, f"{observed_at} and {truth_at}")
        yield take
    if common_s < SHORTEST_S:
        raise LaunchError(f"{recording}: expected {SHORTEST_S:g} s or more beside {reference}, got {common_s:.1f}")


def _check_match(take: SensorTake, files: str) -> None:
    """Raise if sensor and reference differ by more than a sensor's error: it would be learned as if it were that."""
    off = {shift: _mean_distance(take, shift) for shift in SHIFTS}
    best = min(off, key=lambda shift: off[shift])
    if abs(best) > 1 and off[best] < 0.7 * off[0]:
        when = f"{abs(best) / FPS:.2f} s {'earlier' if best > 0 else 'later'}"
        better = f"{1e3 * off[best]:.0f} mm off instead of {1e3 * off[0]:.0f}"
        raise LaunchError(f"{files}: expected stamps of one clock, but the reference fits best {when} ({better})")
    if not off[0] < FARTHEST_M:
        expected = f"expected one person's joints within {FARTHEST_M:g} m on average, aligned"
        remedy = "are both in metres and right-handed, in the order of their skeleton, and of the same moment?"
        raise LaunchError(f"{files}: {expected}, got {off[0]:.2f} m; {remedy}")


def _mean_distance(take: SensorTake, shift: int) -> float:
    """Metres between joints, aligned, with the reference ``shift`` ticks earlier; infinite if none is in both."""
    frames = len(take.truth) - abs(shift)
    truth, observed = take.truth[max(shift, 0) :][:frames], take.observed[max(-shift, 0) :][:frames]
    if (finite_joints(truth) & finite_joints(observed)).sum() < 3:
        return np.inf
    rotation, translation = rigid_alignment(truth, observed)
    return float(np.nanmean(np.linalg.norm(truth @ rotation.T + translation - observed, axis=-1)))


def _pairs(recording: Path, reference: Path) -> list[tuple[Path, Path]]:
    for path in (recording, reference):
        if not path.exists():
            raise LaunchError(f"{path} does not exist: expected a recording, an .npz or .csv, or a folder of these")
    if not is_folder_of_recordings(recording):
        return [(recording, reference)]
    # by name alone: sensor and reference are rarely recorded by the same program
    others = {_name(path, reference): path for path in find_recordings(reference)} if reference.is_dir() else {}
    found = [(path, others.get(_name(path, recording))) for path in find_recordings(recording)]
    pairs = [(path, other) for path, other in found if other]
    alone = [str(path) for path, other in found if not other]
    if not pairs or alone:
        what = f"of {', '.join(alone[:4])} there is none" if alone else f"{recording} holds none"
        formats = f"rosbag2 directory, .mcap or {', '.join(FILES)}"
        raise LaunchError(f"{reference}: expected one of the same name for each recording ({formats}): {what}")
    return pairs


def _name(path: Path, root: Path) -> Path:
    """Of a recording in a folder: where it lies there, without the ending of a file."""
    return path.relative_to(root) if path.is_dir() else path.relative_to(root).with_suffix("")


def _person(path: Path, root: Path) -> str:
    if path.suffix == ".npz" and "person" in (arrays := read_arrays(path)):
        return str(arrays["person"])
    return path.parent.name if path.parent != root and path != root else path.stem


def _joints(path: Path) -> _Joints:
    stamps, positions, camera = [], [], np.zeros(3)
    for _, raw in open_recording(path):
        if not isinstance(raw, PoseRaw) or not raw.bodies:
            continue
        if len(raw.bodies) > 1:
            raise LaunchError(f"{path}: expected one person, got {len(raw.bodies)} in a frame; cut the others out")
        body = raw.bodies[0]
        joints, _ = to_canonical(SKELETONS[raw.skeleton], observed(body), body.confidence)
        if finite_joints(joints).any() and (not stamps or raw.stamp_ns > stamps[-1]):
            camera = np.asarray(raw.sensor_pose.position, np.float64)
            stamps.append(raw.stamp_ns)
            positions.append(to_world(joints, raw.sensor_pose))
    if len(stamps) < 2:
        raise LaunchError(f"{path}: expected a person in two frames or more, got {len(stamps)}")
    return _Joints(np.array(stamps), np.stack(positions), camera)


def _at(joints: _Joints, ticks: NDArray[np.int64]) -> Floats:
    """(T, 22, 3) metres at ``ticks``; NaN where a joint was not observed nearby."""
    at = np.full((len(ticks), 22, 3), np.nan)
    for joint in range(22):
        usable = finite_joints(joints.positions[:, joint])
        if usable.any():
            at[:, joint] = interpolated(joints.stamps_ns[usable], joints.positions[usable, joint], ticks)
    return at
