"""Accuracy of the fusion of the root: noisy observations of known motion, with the root hidden for two seconds at a
time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from steadypose.msgs.types import CleanBody, JointState, Pose, PoseClean
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import CONTACT_JOINTS
from steadypose.prior.models.root_velocity import FRAME_S
from steadypose.prior.sim.noise import time_correlated
from steadypose.prior.world.observe import FEET
from steadypose.prior.world.pipeline import TrajectoryPipeline
from steadypose.prior.world.settings import TrajectorySettings

SEEN_FRAMES, HIDDEN_FRAMES = 36, 60
"""Number of frames in which the root is observed, then hidden, in turn."""

ROOT_NOISE, JOINT_NOISE = 0.015, 0.01
"""Standard deviations of the root's error, and of the joints' errors relative to it, metres."""

MEMORY = 0.95
"""Correlation of these errors between frames."""

HORIZONS = (15, 30, 60)
"""Frames after which the hidden root is compared with the truth."""


class Way(NamedTuple):
    """Output of a method, in the world."""

    positions: Floats
    """(T, 22, 3) metres"""
    sigma: Floats
    """(T, 3) metres, the root's standard deviation"""


Method = Callable[[Sequence[PoseClean]], Way]
"""Maps a clip from `observe` to estimates; each frame's uses only what came until then."""


def fusion(settings: TrajectorySettings, messages: Sequence[PoseClean]) -> Way:
    """Run the trajectory that ships, with these settings."""
    pipeline = TrajectoryPipeline(settings)
    bodies = [pipeline.process(message)[0].bodies[0] for message in messages]
    return Way(
        np.stack([b.positions for b in bodies]).astype(np.float64),
        np.sqrt(np.stack([np.diag(b.covariance)[:3] for b in bodies])),
    )


METHODS: Mapping[str, Method] = {
    "constant velocity": partial(fusion, TrajectorySettings(network=False, contacts=False)),
    "network": partial(fusion, TrajectorySettings(contacts=False)),
    "network and contacts": partial(fusion, TrajectorySettings()),
}
"""Methods to continue without a root: a Kalman filter alone, with the network's velocity, and with standing feet."""


@dataclass(frozen=True)
class Clip:
    """True motion at 30 Hz."""

    positions: Floats
    """(T, 22, 3) metres, world, floor at 0"""
    rotations: Floats
    """(T, 22, 4) xyzw, local"""
    contacts: NDArray[np.bool_]
    """(T, 8) labels"""

    @property
    def hidden(self) -> NDArray[np.bool_]:
        """Frames (T,) in which `observe` hides the root."""
        return np.arange(len(self.positions)) % (SEEN_FRAMES + HIDDEN_FRAMES) >= SEEN_FRAMES


def observe(clip: Clip, rng: np.random.Generator) -> list[PoseClean]:
    """Return a clip as a prior's output: with noise, and without the trunk where `Clip.hidden`.

    There the root stays where it was last observed, with an infinite standard deviation, and the body with it. Only the
    body's own motion is known, which is the task of HM-VAE's section 3.3.
    """
    count = len(clip.positions)
    root = clip.positions[:, 0] + ROOT_NOISE * time_correlated(rng.normal(size=(count, 3)), MEMORY)
    local = clip.positions - clip.positions[:, :1]
    local[:, 1:] += JOINT_NOISE * time_correlated(rng.normal(size=(count, 21, 3)), MEMORY)
    sigma = np.full((count, 22), np.hypot(ROOT_NOISE, JOINT_NOISE))
    sigma[:, 0] = np.where(clip.hidden, np.inf, ROOT_NOISE)
    trunk = [j for j in range(22) if j not in (4, 5, 7, 8, 10, 11, 20, 21)]
    messages = []
    for t, hidden in enumerate(clip.hidden):
        root[t] = root[t - 1] if hidden else root[t]
        state = np.full(22, JointState.REFINED)
        state[trunk] = JointState.IMPUTED if hidden else JointState.REFINED
        positions = root[t] + local[t]
        body = CleanBody(
            id=0, positions=positions, rotations=clip.rotations[t], state=state, sigma=sigma[t], anomaly=0.0,
            anomaly_flag=False, joint_anomaly=np.zeros(22, np.float32), bone_lengths=np.zeros(22, np.float32),
            raw_positions=positions, raw_confidence=np.ones(22, np.float32),
        )  # fmt: skip
        messages.append(PoseClean(round(t * FRAME_S * 1e9), "world", "clip", Pose.identity(), True, 0, [body]))
    return messages


@dataclass
class Errors:
    """Errors of one method over clips; lists hold one number per frame or span."""

    seen_position: list[float] = field(default_factory=list)
    seen_skate: list[float] = field(default_factory=list)
    hidden_skate: list[float] = field(default_factory=list)
    hidden_position: dict[int, list[float]] = field(default_factory=lambda: {h: [] for h in HORIZONS})
    hidden_nees: dict[int, list[float]] = field(default_factory=lambda: {h: [] for h in HORIZONS})
    hidden_path: list[float] = field(default_factory=list)

    def add(self, clip: Clip, positions: Floats, sigma: Floats) -> None:
        """Compare (T, 22, 3) metres and (T, 3) metres, the root's standard deviation, with the truth."""
        hidden, truth = clip.hidden, clip.positions[:, 0]
        off = positions[:, 0] - truth
        settled = np.arange(len(hidden)) >= 10
        self.seen_position += list(np.linalg.norm(off[~hidden & settled], axis=1))
        speed = np.linalg.norm(np.diff(positions[:, FEET, :2], axis=0), axis=2) / FRAME_S
        labels = clip.contacts[:, [CONTACT_JOINTS.index(j) for j in FEET]]
        stands = labels[1:] & labels[:-1] & settled[1:, None]
        inside = hidden[1:] & hidden[:-1]
        self.seen_skate += list(speed[stands & ~hidden[1:, None] & ~hidden[:-1, None]])
        self.hidden_skate += list(speed[stands & inside[:, None]])
        for start in range(SEEN_FRAMES, len(hidden) - HIDDEN_FRAMES + 1, SEEN_FRAMES + HIDDEN_FRAMES):
            for h in HORIZONS:
                at = start + h - 1
                self.hidden_position[h].append(float(np.linalg.norm(off[at, :2])))
                self.hidden_nees[h].append(float(np.mean((off[at, :2] / sigma[at, :2]) ** 2)))
            end = start + HIDDEN_FRAMES - 1
            self.hidden_path.append(float(np.linalg.norm(np.diff(truth[start : end + 1, :2], axis=0), axis=1).sum()))

    def summary(self) -> dict[str, float]:
        """Return means and root mean squares, in the units named by the keys."""
        last, path = np.array(self.hidden_position[HORIZONS[-1]]), np.array(self.hidden_path)
        walked = path > 1.0
        return {
            "seen: root cm": 100 * rms(self.seen_position),
            "seen: skate m/s": float(np.mean(self.seen_skate)),
            "hidden: skate m/s": float(np.mean(self.hidden_skate)),
            **{f"hidden {h * FRAME_S:g} s: root cm": 100 * rms(e) for h, e in self.hidden_position.items()},
            "hidden: m per 10 m walked": float(10 * last[walked].sum() / path[walked].sum())
            if walked.any()
            else np.nan,
            **{
                f"hidden {h * FRAME_S:g} s: squared error over variance": float(np.mean(e))
                for h, e in self.hidden_nees.items()
            },
        }


def rms(values: ArrayLike) -> float:
    """Return the root mean square of all values."""
    return float(np.sqrt(np.mean(np.square(values))))


def evaluate_fusion(clips: list[Clip]) -> dict[str, Errors]:
    """Run all `METHODS` over every clip; "as observed" is the input."""
    errors = {name: Errors() for name in ("as observed", *METHODS)}
    for number, clip in enumerate(clips):
        messages = observe(clip, np.random.default_rng((0, number)))
        seen = np.stack([m.bodies[0].positions for m in messages]).astype(np.float64)
        errors["as observed"].add(clip, seen, np.full((len(seen), 3), ROOT_NOISE))
        for name, method in METHODS.items():
            errors[name].add(clip, *method(messages))
    return errors
