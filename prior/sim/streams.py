"""Generates the recordings of ``sim_data/`` from a manifest with the script, camera, noise and seed of each."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from steadypose.msgs.recording import RecordingWriter
from steadypose.msgs.topics import POSE_RAW, POSE_TRUTH
from steadypose.msgs.types import JointState, PoseRaw, PoseWorld, Tracking, WorldBody
from steadypose.prior.arrays import Bools
from steadypose.prior.body.capsules import mount
from steadypose.prior.sim.camera import Camera, as_tracked, film, sight
from steadypose.prior.sim.motion import Motion
from steadypose.prior.sim.noise import KINECT_NOISE, NoiseModel
from steadypose.prior.sim.scripts import SCRIPTS
from steadypose.prior.timing.resample import PERIOD_NS

START_NS = 1_750_000_000_000_000_000  # stamp of a stream's second 0, nanoseconds; arbitrary, but always the same

_SHORTEST_S = 2.0


class ManifestError(ValueError):
    """A manifest is invalid; the message says where and why."""


@dataclass(frozen=True)
class Stream:
    """The recipe of one stream."""

    name: str  # name of the stream and its directory
    what: str  # description in one line
    script: str  # a key of `prior.sim.scripts.SCRIPTS`
    seed: int  # random seed of body, motion and noise
    camera: Camera  # the camera
    noise: Path = KINECT_NOISE  # file with the noise's parameters
    seconds: float | None = None  # duration that is kept; the whole script if None


def read_manifest(path: Path) -> dict[str, Stream]:
    """Read the streams of a manifest, by name.

    Raises:
        ManifestError: the file is missing, is not JSON, or an entry has an unknown key, script or value.
    """
    try:
        entries = json.loads(path.read_text())["streams"].items()
    except OSError as error:
        raise ManifestError(f"cannot read {path}: {error.strerror}") from error
    except (KeyError, AttributeError, TypeError, ValueError) as error:
        raise ManifestError(f"{path}: expected JSON with an object 'streams', got {error!r}") from error
    return {name: _stream(name, entry, path.parent) for name, entry in entries}


def _stream(name: str, entry: Mapping[str, Any], folder: Path) -> Stream:
    known = {f.name for f in fields(Stream)} - {"name"}
    if not isinstance(entry, dict):
        raise ManifestError(f"{name}: expected an object with keys {sorted(known)}, got {entry!r}")
    if unknown := set(entry) - known:
        raise ManifestError(f"{name}: unknown keys {sorted(unknown)}; there are {sorted(known)}")
    try:
        filmed: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in entry["camera"].items()}
        camera = Camera(**filmed)
        stream = Stream(
            name,
            entry["what"],
            entry["script"],
            int(entry["seed"]),
            camera,
            folder / entry["noise"] if "noise" in entry else KINECT_NOISE,
            entry.get("seconds"),
        )
    except KeyError as error:
        raise ManifestError(f"{name}: expected a key {error}") from error
    except (AttributeError, TypeError, ValueError) as error:
        raise ManifestError(f"{name}: {error}") from error
    if stream.script not in SCRIPTS:
        raise ManifestError(f"{name}: no script '{stream.script}'; there are {', '.join(SCRIPTS)}")
    if stream.seconds is not None and stream.seconds < _SHORTEST_S:
        raise ManifestError(f"{name}: expected seconds of {_SHORTEST_S} or more, got {stream.seconds}")
    return stream


def make(stream: Stream) -> tuple[list[PoseRaw], list[PoseWorld]]:
    """Simulate a stream; returns the frames of ``pose/raw`` and ``pose/truth``.

    The truth is on the 30 Hz grid that starts at the first raw frame, like the prior's output. A joint's state is SEEN
    if the camera has it in view with a free line of sight, otherwise IMPUTED.

    Raises:
        ManifestError: the file of the noise's parameters is missing or invalid.
    """
    try:
        noise = NoiseModel.load(stream.noise)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ManifestError(
            f"{stream.name}: noise: expected parameters as {KINECT_NOISE.name} has them: {error}"
        ) from error
    playing, filming = (np.random.default_rng(s) for s in np.random.SeedSequence(stream.seed).spawn(2))
    people = [_cut(m, stream.seconds) for m in SCRIPTS[stream.script](playing)]
    frames = film(people, stream.camera, noise, filming, stream.name, START_NS)
    return frames, _truth(people, stream, frames[0].stamp_ns, frames[-1].stamp_ns)


def record(stream: Stream, directory: Path) -> None:
    """Simulate a stream and record it to ``directory``.

    Raises:
        RecordingError: the directory exists already, or cannot be created.
    """
    raw, truth = make(stream)
    with RecordingWriter(directory) as recording:
        filed = [(m.stamp_ns, POSE_RAW, m) for m in raw] + [(m.stamp_ns, POSE_TRUTH, m) for m in truth]
        for stamp, topic, message in sorted(filed, key=lambda f: f[:2]):
            recording.write(topic, message, stamp)


def _cut(motion: Motion, seconds: float | None) -> Motion:
    keep = motion.times <= (motion.times[-1] if seconds is None else seconds)
    return replace(
        motion,
        times=motion.times[keep],
        root=motion.root[keep],
        rotations=motion.rotations[keep],
        contacts=motion.contacts[keep],
    )


def _truth(people: list[Motion], stream: Stream, first_ns: int, last_ns: int) -> list[PoseWorld]:
    stamps = np.arange(first_ns, last_ns + 1, PERIOD_NS)
    times = (stamps - START_NS) / 1e9
    at = [m.at(times) for m in people]
    visible = [_visible(m, at, stream.camera) for m in at]
    quaternions = [Rotation.from_matrix(m.rotations.reshape(-1, 3, 3)).as_quat().reshape(-1, 22, 4) for m in at]
    velocities = [np.stack([np.interp(times, m.times, v) for v in m.velocity.T], axis=-1) for m in people]
    messages: list[PoseWorld] = []
    for t, stamp in enumerate(stamps):
        bodies = [
            WorldBody(
                id=k + 1,
                root_position=m.root[t],
                root_orientation=quaternions[k][t, 0],
                root_velocity=velocities[k][t],
                covariance=np.zeros((6, 6)),
                positions=m.positions[t],
                rotations=quaternions[k][t],
                state=np.where(visible[k][t], JointState.SEEN, JointState.IMPUTED),
                sigma=np.zeros(22),
                contacts=m.contacts[t].astype(np.float32),
                tracking=Tracking.OK,
            )
            for k, m in enumerate(at)
        ]
        messages.append(PoseWorld(int(stamp), "world", stream.name, np.array([0.0, 0.0, 1.0, 0.0]), bodies))
    return messages


def _visible(person: Motion, people: list[Motion], camera: Camera) -> Bools:
    """(T, 22) whether each joint is in view and not hidden."""
    eye = np.array(camera.position)
    hidden = as_tracked(sight(person.positions, people, eye).hidden, mount("smpl22"))
    return (hidden < 0.5) & camera.in_view((person.positions - eye) @ camera.orientation)
