"""Learns a sensor's bias as a function of the observed pose, from recordings of the sensor with a reference.

The recordings are UI-PRMD's Kinect and Vicon, or a user's own. A smoother removes jitter, but most of a depth camera's
error is bias. It depends on the pose, on self-occlusion and on the view direction, and lasts as long as these. The
network predicts the correction of each joint, frame by frame.
"""

import math
from collections import deque
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim.lr_scheduler import OneCycleLR

from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import rigid_alignment
from steadypose.prior.body.layouts import KINECT22, to_canonical
from steadypose.prior.body.skeleton import MIRROR, finite_joints
from steadypose.prior.models.sensor_bias import (
    FEATURES,
    HISTORY,
    SMOOTHER_DENSITY,
    VECTORS,
    CorrectionConfig,
    LiveCorrection,
    features,
    recall,
    trunk_frame,
)
from steadypose.prior.timing.kalman import ConstantVelocityFilter
from steadypose.prior.timing.rate import FPS
from steadypose.training.data.dataset import mirror_offsets
from steadypose.training.data.readers import TRAIN_SUBJECTS, KinectPair, load_pairs
from steadypose.training.loop import Recipe, Rng, TrainingOptions


class CorrectionNet(nn.Module):
    """Maps features of a frame (B, FEATURES) to the corrections of joints (B, 22, 3), metres, trunk frame."""

    mean: Tensor
    scale: Tensor

    def __init__(self, config: CorrectionConfig) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("mean", torch.zeros(FEATURES))
        self.register_buffer("scale", torch.ones(FEATURES))
        self.layers = nn.Sequential(
            nn.Linear(FEATURES, config.hidden), nn.GELU(), nn.Dropout(0.5),
            nn.Linear(config.hidden, config.hidden), nn.GELU(), nn.Dropout(0.5),
            nn.Linear(config.hidden, 66),
        )  # fmt: skip

    def forward(self, features: Tensor) -> Tensor:
        """Predict corrections; NaN features (missing joints) are replaced by the training mean."""
        x = torch.nan_to_num((features - self.mean) / self.scale)
        return self.layers(x).reshape(-1, 22, 3)


def mirror_features(x: Tensor) -> Tensor:
    """Return the features (B, FEATURES) of the mirrored bodies, with left and right exchanged."""
    vectors = x[:, : 3 * VECTORS].reshape(len(x), VECTORS, 3) * x.new_tensor([1.0, -1.0, 1.0])
    joints = vectors[:, :-2].reshape(len(x), len(HISTORY), 22, 3)[:, :, MIRROR.tolist()]
    return torch.cat(
        [joints.flatten(1), vectors[:, -2:].flatten(1), x[:, -24:-22], x[:, -22:][:, MIRROR.tolist()]], dim=1
    )


ITERATIONS, BATCH, LEARNING_RATE, EVALUATIONS = 4_000, 256, 1e-3, 40
"""Numbers of steps and of frames per step; initial learning rate, which first doubles, then falls to 0; evaluations."""
HIDE = 0.1  # share of training frames with hidden joints, so that the network tolerates missing joints
INPUT_NOISE = 0.03  # noise on the inputs, standard deviations of a feature, as augmentation for only six people


@dataclass(frozen=True)
class SensorTake:
    """A person recorded by a sensor and by a reference at the same times, at 30 Hz."""

    person: str  # name of the person
    observed: Floats  # (T, 22, 3) metres, z up, from the sensor; NaN where unobserved
    camera: Floats  # (3,) metres, position of the sensor in that frame
    truth: Floats  # (T, 22, 3) metres, from the reference, in any frame; NaN where unknown


@dataclass(frozen=True)
class HeldOut:
    """Mean distance of one person's joints from the reference over joints and frames, metres."""

    person: str  # name of the person; the correction was learned from all others
    observed_m: float  # error of the sensor's joints after the best rigid alignment of each take
    corrected_m: float  # the same with correction


def train_correction(options: TrainingOptions, subjects: Collection[str] = TRAIN_SUBJECTS) -> Path:
    """Train the Kinect's correction on these subjects of ``ui_prmd.npz``; returns the path of the weights."""
    # Train on all six people: with one held out, the other five give measurably worse results (benchmarks/NOTEBOOK.md).
    # The length of the training was once chosen that way. `steadypose evaluate kinect_vicon` has unseen people.
    return _train(
        options, *_examples(options.data, subjects), "systematic error of a Kinect v2",
        f"UI-PRMD, Kinect beside Vicon: {', '.join(subjects)}",
        "Apache-2.0; the data is in the public domain (PDDL 1.0)",
    )  # fmt: skip


def train_sensor(takes: Sequence[SensorTake], options: TrainingOptions) -> Path:
    """Train the correction of the sensor named ``options.weights`` on its recordings; returns the weights' path."""
    people = sorted({take.person for take in takes})
    x, y = _usable(*(np.concatenate(part) for part in zip(*map(_take, takes), strict=True)))
    data = f"{len(takes)} recordings of {len(people)} people beside a reference"
    return _train(options, x, y, f"systematic error of the sensor {options.weights}", data, "that of the recordings")


def leave_one_person_out(takes: Sequence[SensorTake], options: TrainingOptions) -> Iterator[HeldOut]:
    """Yield every person's error with a correction learned from all others, which a new person can expect.
    ``options.runs`` is a folder without runs."""
    for number, person in enumerate(sorted({take.person for take in takes})):
        others = [take for take in takes if take.person != person]
        path = train_sensor(others, replace(options, weights=f"without-{number}"))
        errors = []
        for x, missing in (_take(take) for take in takes if take.person == person):
            there = np.isfinite(x[:, 0])
            correction = LiveCorrection.load(str(path), int(there.sum()))(x[there])
            errors.append(
                np.linalg.norm(np.stack([missing[there], missing[there] - correction]), axis=-1).reshape(2, -1)
            )
        yield HeldOut(person, *np.nanmean(np.concatenate(errors, axis=1), axis=1).tolist())


def _train(options: TrainingOptions, x: Tensor, y: Tensor, described: str, data: str, licence: str) -> Path:
    """Train on features x (N, FEATURES) and corrections y (N, 22, 3); returns the path of the weights."""
    iterations = options.iterations or ITERATIONS
    evaluations = min(EVALUATIONS, max(iterations // 100, 1))
    recent = deque[float](maxlen=max(iterations // evaluations, 1))

    def network() -> CorrectionNet:
        net = CorrectionNet(CorrectionConfig(sensor=options.weights))
        net.mean.copy_(x.nanmean(dim=0).nan_to_num())
        net.scale.copy_((x - net.mean).square().nanmean(dim=0).sqrt().nan_to_num().clamp(min=1e-2))
        return net

    def loss_of(net: CorrectionNet, count: int, _: float, rng: Rng) -> tuple[Tensor, dict[str, float]]:
        rows = torch.from_numpy(rng.integers(len(x), size=count))
        inputs, targets = _hide(x[rows], rng), y[rows]
        half = count // 2
        inputs = torch.cat([mirror_features(inputs[:half]), inputs[half:]])
        targets = torch.cat([mirror_offsets(targets[:half]), targets[half:]])
        loss = _error(net(inputs + INPUT_NOISE * net.scale * torch.randn_like(inputs)), targets)
        recent.append(1000 * loss.item())
        return loss, {"training mm": float(np.mean(recent))}

    recipe = Recipe(
        "correction", network, loss_of, lambda net: {}, ITERATIONS, BATCH, LEARNING_RATE, "frames", decay=1e-2,
        schedule=lambda optimiser, steps: OneCycleLR(optimiser, 2 * LEARNING_RATE, total_steps=steps),
        evaluations=evaluations, clip=math.inf,
    )  # fmt: skip
    return recipe.train(options, f"{described}, a two-layer perceptron on 0.4 s of poses", data, licence=licence)


def _examples(data: Path, subjects: Collection[str]) -> tuple[Tensor, Tensor]:
    """Return features (N, FEATURES) and corrections (N, 22, 3) of every frame, metres in the trunk's frame."""
    return _usable(*(np.concatenate(part) for part in zip(*(_examples_of(data, s) for s in subjects), strict=True)))


def _usable(x: np.ndarray, y: np.ndarray) -> tuple[Tensor, Tensor]:
    """Select the frames of x (N, FEATURES) and y (N, 22, 3) whose trunk is observed."""
    usable = np.isfinite(x[:, 0])
    return torch.from_numpy(x[usable]).float(), torch.from_numpy(y[usable]).float()


@lru_cache(maxsize=8)
def _examples_of(data: Path, subject: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the examples of one person; cached, because evaluation leaves out one person at a time."""
    found = [_clip(pair) for pair in load_pairs(data, (subject,))]
    x, y = (np.concatenate(part) for part in zip(*found, strict=True))
    return x, y


def _clip(pair: KinectPair) -> tuple[np.ndarray, np.ndarray]:
    seen, _ = to_canonical(KINECT22, pair.kinect)
    shared = np.asarray((finite_joints(seen) & finite_joints(pair.vicon)).all(axis=0))
    alignment = rigid_alignment(pair.vicon[:, shared], seen[:, shared])
    return _features_and_missing(seen, pair.vicon, alignment, np.zeros(3), pair.fps)


def _take(take: SensorTake) -> tuple[np.ndarray, np.ndarray]:
    alignment = rigid_alignment(take.truth, take.observed)
    return _features_and_missing(take.observed, take.truth, alignment, take.camera, FPS)


def _features_and_missing(
    observed: Floats, truth: Floats, alignment: tuple[Floats, Floats], camera: Floats, fps: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return features (T, FEATURES) and corrections (T, 22, 3) of every frame, metres in the trunk's frame.

    ``alignment`` is the rigid transform from the truth to the sensor's frame.
    """
    smoother = ConstantVelocityFilter(SMOOTHER_DENSITY)
    smoothed = np.stack([smoother.update(frame, t / fps).positions for t, frame in enumerate(observed)])
    padded = np.concatenate([np.full((HISTORY[-1], 22, 3), np.nan), smoothed])
    history = np.stack([recall(padded[t : t + HISTORY[-1] + 1, None])[:, 0] for t in range(len(smoothed))], axis=1)
    rotation, translation = alignment
    return features(history, camera), (truth @ rotation.T + translation - observed) @ trunk_frame(smoothed)


def _hide(x: Tensor, generator: np.random.Generator) -> Tensor:
    hidden = (generator.random((len(x), 1)) < HIDE) & (generator.random((len(x), 22)) < 0.2)
    mask = torch.from_numpy(hidden)
    return torch.cat(
        [
            x[:, : 66 * len(HISTORY)].masked_fill(mask.repeat_interleave(3, dim=1).repeat(1, len(HISTORY)), torch.nan),
            x[:, 66 * len(HISTORY) : -22],
            x[:, -22:] * ~mask,
        ],
        dim=1,
    )


def _error(estimate: Tensor, truth: Tensor) -> Tensor:
    """Mean distance over the joints that the reference has, metres."""
    known = truth.isfinite().all(dim=-1)
    return nn.functional.pairwise_distance(estimate[known], truth[known]).mean()
