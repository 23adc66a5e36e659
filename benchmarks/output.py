"""Outputs of the pipeline and of completion on the bundled streams, reduced to a few numbers that reveal a change."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from itertools import islice
from pathlib import Path

import numpy as np

from steadypose import PACKAGE
from steadypose.msgs.topics import POSE_RAW
from steadypose.msgs.types import CleanBody, Pose, PoseClean, PoseRaw, PoseWorld, RawBody, WorldBody
from steadypose.nodes.driving import stream
from steadypose.nodes.sources.recording import open_recording
from steadypose.prior.body.skeleton import J, limbs
from steadypose.prior.clean.pipeline import PriorPipeline
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.complete.body import Uncertainty
from steadypose.prior.complete.parts import PartsCompleter
from steadypose.prior.complete.stream import complete_raws
from steadypose.prior.models.completer import LiveCompleter
from steadypose.prior.models.posture import LivePosture
from steadypose.prior.world.pipeline import TrajectoryPipeline
from steadypose.prior.world.settings import TrajectorySettings

FRAMES = 120  # number of frames of each bundled stream that are processed
PROJECTIONS = 8  # number of projections kept of each output
HIDDEN = 50, 70  # first frame in which an arm is hidden, and first in which it is seen again
LEGLESS = "wave_hidden_arm"  # stream whose legs are never seen
NOISE_M = 0.01  # standard deviation of the noise along an axis, metres

_ARM = [J["left_elbow"], J["left_wrist"]]
_LEGS = np.ravel(limbs(("hip", "knee", "ankle", "foot")))


@cache
def outputs() -> dict[str, list[float]]:
    """Return random projections of outputs by name: with default settings, with HM-VAE's refinement, and of `complete`.

    Sensors lack joints of the canonical 22, and most studies give all of them. So the same outputs are also returned
    for the true joints of some streams, with noise and with hidden limbs.

    A projection has weights of 1 and -1, divided by the root of their number. It changes by about the root mean square
    change of the output, so eight numbers measure how much 100,000 differ.
    """
    paths = sorted(path.parent for path in (PACKAGE / "sim_data").glob("*/metadata.yaml"))
    sensed, given = [_sensed(path) for path in paths], [_given(path) for path in paths[-3:]]
    found = {"complete": projections(_completed(path) for path in paths[:2])}
    for joints, streams in (("", sensed), (" of 22 joints", given)):
        found[f"pose/clean{joints}"], found[f"pose/world{joints}"] = _projected(streams, PriorSettings())
        refining = PriorSettings.from_dict({"refine": {"enabled": True}})
        found[f"pose/clean{joints}, HM-VAE"], _ = _projected(streams[:1], refining)
    return found


def _completed(path: Path) -> np.ndarray:
    """Complete every body of a stream with a gap of one second."""
    raws = [message for _, message in islice(open_recording(path), FRAMES) if isinstance(message, PoseRaw)]
    del raws[40:70]
    completer = LiveCompleter.load("default")
    uncertainty = Uncertainty(completer.config.far_sigma, 1, LivePosture.load("default"))
    done = complete_raws(path.name, raws, PartsCompleter(completer), uncertainty).done
    return np.concatenate([np.ravel(completed.positions[np.isfinite(completed.positions)]) for _, completed in done])


def _sensed(path: Path) -> list[PoseRaw]:
    raws = (message for _, message in open_recording(path) if isinstance(message, PoseRaw))
    return list(islice(raws, FRAMES))


def _given(path: Path) -> list[PoseRaw]:
    """Return the true joints of a stream, with noise; an arm is hidden for a while, and in one stream legs are never
    seen."""
    rng = np.random.default_rng(0)
    true = (message for _, message in open_recording(path) if isinstance(message, PoseWorld) and message.bodies)
    raws = []
    for k, message in enumerate(islice(true, FRAMES)):
        bodies = []
        for body in message.bodies:
            confidence = np.ones(22, dtype=np.float32)
            confidence[_LEGS] = path.name != LEGLESS
            confidence[_ARM] = not HIDDEN[0] <= k < HIDDEN[1]
            noisy = body.positions + rng.normal(0.0, NOISE_M, (22, 3)).astype(np.float32)
            bodies.append(RawBody(body.id, noisy, confidence))
        raws.append(PoseRaw(message.stamp_ns, "world", path.name, "smpl22", Pose.identity(), True, bodies))
    return raws


def _projected(streams: Iterable[list[PoseRaw]], settings: PriorSettings) -> tuple[list[float], list[float]]:
    """Return the projections of `pose/clean` and of `pose/world` of all streams."""
    clean, world = [], []
    for raws in streams:
        pipelines = PriorPipeline(settings), TrajectoryPipeline(TrajectorySettings())
        for _, message in stream(((POSE_RAW, raw) for raw in raws), *pipelines):
            if isinstance(message, PoseClean | PoseWorld):
                (clean if isinstance(message, PoseClean) else world).extend(map(_numbers, message.bodies))
    return projections(clean), projections(world)


def _numbers(body: CleanBody | WorldBody) -> np.ndarray:
    """Return positions, rotations, deviations, and contacts or the anomaly, in a row."""
    last = body.contacts if isinstance(body, WorldBody) else [body.anomaly]
    parts = body.positions, body.rotations, body.sigma, last
    return np.nan_to_num(np.concatenate([np.ravel(part) for part in parts]), posinf=1.0).astype(np.float64)


def projections(parts: Iterable[np.ndarray]) -> list[float]:
    """Project an output that is given in parts."""
    values = np.concatenate(list(parts))
    signs = np.random.default_rng(0).integers(0, 2, (PROJECTIONS, len(values)), dtype=np.int8) * 2.0 - 1.0
    return [round(float(p), 7) for p in signs @ values / np.sqrt(len(values))]
