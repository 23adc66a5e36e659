"""The occlusion network and its training: ``steadypose train occlusion --data MOCAP``, resumable.

The network weighs the candidates for an occluded joint's position, and predicts a standard deviation. This is stacked
generalisation (Wolpert 1992): weights of several models are learned from their errors on held-out tasks. A convex
combination of the candidates is never worse than the worst candidate.

Clips of true motion pass through simulated sensors, lose joints, and pass through the pipeline. The candidates and
features of its occluded joints, with the truth, are the training data.
"""

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track
from torch import Tensor, nn

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.skeleton import PARENTS, J, limbs
from steadypose.prior.clean.core import CleanCore
from steadypose.prior.clean.frame import Observation
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.models.occlusion import CANDIDATES, FEATURES, MAX_LOG_SIGMA, MIN_LOG_SIGMA, Occluded, Weighed
from steadypose.prior.sim.camera import segment_gap
from steadypose.prior.timing.rate import FPS
from steadypose.training.data.prepare import made_once
from steadypose.training.data.recordings import write_arrays
from steadypose.training.data.sensors import Sensors
from steadypose.training.loop import Recipe, Rng, TrainingOptions

FIRST_LOG_SIGMA = 4.0  # initial logarithm of the standard deviation, which is in millimetres

ITERATIONS, BATCH, LEARNING_RATE, WEIGHT_DECAY = 800, 4096, 3e-3, 0.1
"""Number of steps; occluded joints per step; initial learning rate of AdamW, which falls along a cosine; weight decay.
More steps overfit the training people (benchmarks/NOTEBOOK.md, hidden joints)."""

FRAMES, CLIPS = 120, 64  # length of a clip, frames, and number of clips that are processed together as bodies of a run
RECORDED = {"train": 16, "val": 4}  # number of pipeline runs for each split
ROWS = 60_000  # largest number of occluded joints kept from a run
RADII = 0.12, 0.2  # range of radii of a trunk that hides arms, metres
FIRST_HIDDEN = 8, 40  # range of the first hidden frame in clips that lose the lower part or one side

DELAYS = (0, 0, 2, 4, 4, 8, 16)

MIN_MM, DEVIATION = 30.0, 0.02
"""Error added to the best candidate's error in the denominator of the loss, mm; and weight of the likelihood."""

_ARMS, _LEGS = limbs(("shoulder", "elbow", "wrist")), limbs(("knee", "ankle", "foot"))
_OCCLUSIONS: tuple[tuple[float, list[int]], ...] = (
    *((3.0, limb) for limb in (*_ARMS, *_LEGS, *(arm[1:] for arm in _ARMS))),
    *((2.0, leg[1:]) for leg in _LEGS),
    (4.0, _LEGS[0] + _LEGS[1]),
    (3.0, [J["left_hip"], J["right_hip"], *_LEGS[0], *_LEGS[1]]),
    (2.0, _ARMS[0] + _ARMS[1]),
    *((2.0, [J[f"{side}_collar"], J[f"{side}_hip"], *arm, *leg])
      for side, arm, leg in zip(("left", "right"), _ARMS, _LEGS, strict=True)),
    (1.0, [J["neck"], J["head"]]),
    (1.0, [J["left_wrist"]]),
    (1.0, [joint for name, joint in J.items() if joint > J["spine2"] or name == "spine2"]),
)  # fmt: skip
"""Joints that are hidden together, with their relative frequency."""


@dataclass(frozen=True)
class OcclusionConfig:
    hidden: int = 96  # of each layer


class OcclusionNet(nn.Module):
    """Two hidden layers; the bias of the first is the joint's."""

    mean: Tensor
    deviation: Tensor

    def __init__(self, config: OcclusionConfig) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("mean", torch.zeros(FEATURES))
        self.register_buffer("deviation", torch.ones(FEATURES))
        self.joint = nn.Parameter(torch.zeros(len(PARENTS), config.hidden))
        self.read = nn.Linear(FEATURES, config.hidden)
        self.think = nn.Linear(config.hidden, config.hidden)
        self.write = nn.Linear(config.hidden, CANDIDATES + 1)
        nn.init.constant_(self.write.bias[CANDIDATES:], FIRST_LOG_SIGMA)

    def forward(self, features: Tensor, joint: Tensor) -> tuple[Tensor, Tensor]:
        """Predict from features (N, `FEATURES`) of joints (N,).

        Returns the weights (N, 4) of the candidates, and the logarithm (N,) of the standard deviation along an axis,
        which is in millimetres.
        """
        read = torch.relu(self.read((features - self.mean) / self.deviation) + self.joint[joint])
        written = self.write(torch.relu(self.think(read)) + read)
        return written[:, :CANDIDATES].softmax(dim=-1), written[:, CANDIDATES].clamp(MIN_LOG_SIGMA, MAX_LOG_SIGMA)


@dataclass(frozen=True)
class Rows:
    """N occluded joints."""

    features: NDArray[np.float32]  # (N, `FEATURES`) features
    joint: NDArray[np.int64]  # (N,) index of the joint
    candidates: NDArray[np.float32]  # (N, 4, 3) metres relative to the first candidate
    truth: NDArray[np.float32]  # (N, 3) metres, likewise


def occlusions(truth: Floats, rng: Rng) -> Bools:
    """(T, C, 22) which joints of clips (T, C, 22, 3) metres are hidden.

    At random, 20 % of clips lose the lower part, 10 % one side, 20 % arms behind the trunk, and the others limbs for 2
    to 100 frames.
    """
    frames, clips = truth.shape[:2]
    hidden = np.zeros(truth.shape[:3], dtype=bool)
    shares = np.array([share for share, _ in _OCCLUSIONS])
    for clip in range(clips):
        place, kind = np.nan_to_num(truth[:, clip]), rng.random()
        if kind < 0.5:
            if kind < 0.2:
                height = place[..., 2] - place[..., 2].min()
                gone = height < rng.uniform(0.25, 0.7) * height[0].max()
            elif kind < 0.4:
                gone = _arms_behind(place, rng)
            else:
                across = place[..., :2] @ (np.cos(angle := rng.uniform(0, 2 * np.pi)), np.sin(angle))
                middle = across[:, :1] if rng.random() < 0.5 else across[:, 0].mean()
                gone = across > middle + rng.uniform(-0.1, 0.25)
            hidden[:, clip] = gone
            hidden[: int(rng.integers(*FIRST_HIDDEN)), clip] = False
            continue
        at = int(rng.integers(10, 40))
        while at < frames:
            length = int(np.exp(rng.uniform(np.log(2), np.log(100))))
            for which in rng.choice(len(_OCCLUSIONS), 1 + (rng.random() < 0.25), p=shares / shares.sum()):
                hidden[at : at + length, clip, _OCCLUSIONS[which][1]] = True
            at += length + int(rng.integers(8, 40))
    return hidden


def _arms_behind(place: Floats, rng: Rng) -> Bools:
    """(T, 22) which elbows and wrists of a clip (T, 22, 3) metres are hidden by the trunk from a camera 3 m away."""
    middle, towards = place[len(place) // 2, J["pelvis"]], rng.uniform(0.0, 2 * np.pi)
    camera = middle + (3.0 * np.cos(towards), 3.0 * np.sin(towards), rng.uniform(0.0, 0.8))
    arms = [joint for arm in _ARMS for joint in arm[1:]]
    trunk = (place[:, None, J[end]] for end in ("pelvis", "neck"))
    gap, along = segment_gap(np.broadcast_to(camera, (len(place), len(arms), 3)), place[:, arms], *trunk)
    hidden = np.zeros(place.shape[:2], dtype=bool)
    hidden[:, arms] = (gap < rng.uniform(*RADII)) & (along < 1.0)
    return hidden


class _Recorder:
    """Replaces the network and records its inputs by frame; its outputs are not used."""

    def __init__(self) -> None:
        self.frame = 0
        self.rows: list[tuple[int, Occluded]] = []

    def __call__(self, rows: Occluded) -> Weighed:
        self.rows.append((self.frame, rows))
        return Weighed(rows.candidates.mean(axis=1), np.ones(len(rows.joint)))


def record(sensors: Sensors, settings: PriorSettings, runs: int, seed: int, split: str) -> Rows:
    """Record the pipeline's occluded joints over ``runs`` runs of `CLIPS` clips."""
    recorded: list[tuple[Any, ...]] = []
    for run in track(range(runs), description=f"occlusions, {split}"):
        rng = np.random.default_rng((seed, run, split == "val"))
        sensed, delay = sensors.draw(CLIPS, rng), int(rng.choice(DELAYS))
        truth = sensed.truth.swapaxes(0, 1)
        observed = np.where(occlusions(truth, rng)[..., None], np.nan, sensed.observed.swapaxes(0, 1))
        recorder = _Recorder()
        core = CleanCore(replace(settings, delay=delay, max_bodies=CLIPS), Counter())
        assert core.fuse.occluded
        core.fuse.occluded.weigher = recorder
        present = np.ones(CLIPS, dtype=bool)
        for t, (frame, confidence) in enumerate(zip(observed, sensed.confidence.swapaxes(0, 1), strict=True)):
            recorder.frame = t - delay
            confidence = np.where(np.isfinite(frame[..., 0]), confidence, 0.0)
            core.step(Observation(t / FPS, frame, confidence, present, np.zeros(3), np.zeros((CLIPS, 22))))
        at = np.concatenate([np.full(len(rows.joint), frame) for frame, rows in recorder.rows])
        body, joint, candidates, features = (
            np.concatenate(parts) for parts in zip(*(rows for _, rows in recorder.rows), strict=True)
        )
        first = candidates[:, :1]
        off = truth[at, body, joint] - first[:, 0]
        known = np.flatnonzero(np.isfinite(off[:, 0]))
        kept = rng.choice(known, min(len(known), ROWS), replace=False)
        recorded.append((features[kept], joint[kept], (candidates - first)[kept], off[kept]))
    features, joint, candidates, off = (np.concatenate(parts) for parts in zip(*recorded, strict=True))
    return Rows(features, joint.astype(np.int64), candidates.astype(np.float32), off.astype(np.float32))


def loss_of(network: OcclusionNet, rows: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Return the loss of `Rows`, the error (N,) of each, and that of its best candidate, mm."""
    weights, log_sigma = network(rows["features"], rows["joint"])
    off = 1e3 * ((weights[..., None] * rows["candidates"]).sum(dim=1) - rows["truth"])
    error = (off.square().sum(dim=-1) + 1.0).sqrt()
    best = 1e3 * (rows["candidates"] - rows["truth"][:, None]).norm(dim=-1).min(dim=-1).values
    square = off.detach().square().sum(dim=-1)
    likelihood = 3.0 * log_sigma + 0.5 * square * torch.exp(-2.0 * log_sigma)
    return (error / (MIN_MM + best)).mean() + DEVIATION * likelihood.mean(), error, best


def train_occlusion(options: TrainingOptions) -> Path:
    """Train the occlusion network on the recordings in the folder ``options.data``; returns the path of the weights.

    It uses the mixture's recordings that are licensed for products, or its prepared arrays.
    """
    arrays = write_arrays(options.data, options.path("occlusion").parent / "arrays")
    rows = {split: _rows(arrays, split, options.seed) for split in RECORDED}
    train, val = ({key: torch.from_numpy(value) for key, value in vars(rows[split]).items()} for split in RECORDED)

    def loss(network: OcclusionNet, count: int, _: float, rng: Rng) -> tuple[Tensor, dict[str, float]]:
        drawn = torch.from_numpy(rng.integers(len(train["joint"]), size=count))
        total, error, best = loss_of(network, {key: value[drawn] for key, value in train.items()})
        return total, {"loss": total.item(), "mm": error.mean().item(), "best": best.mean().item()}

    def evaluate(network: OcclusionNet) -> dict[str, float]:
        total, error, best = loss_of(network, val)
        return {"val": total.item(), "val mm": error.mean().item(), "val best": best.mean().item()}

    def measure_features(network: OcclusionNet) -> None:
        network.mean.copy_(train["features"].mean(dim=0))
        network.deviation.copy_(train["features"].std(dim=0).clamp(min=0.05))

    recipe = Recipe(
        "occlusion", lambda: OcclusionNet(OcclusionConfig()), loss, evaluate, ITERATIONS, BATCH, LEARNING_RATE,
        f"of {len(train['joint'])} occluded joints", decay=WEIGHT_DECAY, evaluations=20,
    )  # fmt: skip
    return recipe.train(
        options,
        "weights of four candidates for an occluded joint's position, and its standard deviation",
        "as the mixture's, through simulated sensors, occlusions and the pipeline itself",
        started_anew=measure_features,
    )


def _rows(arrays: Path, split: str, seed: int) -> Rows:
    """Return the rows of a split, recorded once, independently of the network's weights, as a recorder replaces it."""

    def make() -> dict[str, NDArray[Any]]:
        return vars(record(Sensors.of(arrays, split, FRAMES), PriorSettings(), RECORDED[split], seed, split))

    return Rows(**made_once(arrays.parent / f"rows-{split}.npz", make))
