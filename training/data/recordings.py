"""Training and validation data of the mixture as plain arrays: motion at several speeds, and a real Kinect with
Vicon."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import rigid_alignment
from steadypose.prior.body.layouts import KINECT22, to_canonical
from steadypose.prior.body.skeleton import HIPS, SHOULDERS, J, finite_joints
from steadypose.prior.mocap.clip import Clip, MotionError
from steadypose.prior.timing.rate import FPS
from steadypose.training.data.datasets import DATA_SETS
from steadypose.training.data.prepare import fill_gaps, find_faults, resample, runs, save_arrays
from steadypose.training.data.readers import TRAIN_SUBJECTS, VALIDATION_SUBJECTS, load_pairs

SPEEDS = (1.0, 1.4, 1.9, 2.5)
"""Factors by which training motion is sped up: people of the test split move faster than those recorded for
training."""

_FREE = ("CMU (AMC)", "CMU (BVH)", "CMU (expmap)", "CMU (dance)", "CMU (more)", "ReActIdle", "UI-PRMD (Vicon)")
_ALIGNED = [
    J["head"],
    *(J[f"{side}_{n}"] for n in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle") for side in ("left", "right")),
]


@dataclass(frozen=True)
class Motion:
    """Recordings in a row, at 30 Hz."""

    positions: NDArray[np.float32]  # (N, 22, 3) float32 metres, z up
    start: NDArray[np.int64]  # (C + 1,) first frame of each recording, and the end
    source: NDArray[np.str_]  # (C,) name of the data set
    speed: Floats  # (C,) factor by which the recording is sped up


@dataclass(frozen=True)
class Pairs:
    """Recordings of a real Kinect and its ground truth, concatenated, at 30 Hz."""

    seen: NDArray[np.float32]  # (N, 22, 3) float32 metres, z up; NaN where the Kinect has no such joint
    truth: NDArray[np.float32]  # (N, 22, 3) metres, Vicon's, with the Kinect's joint definitions; NaN where unknown
    start: NDArray[np.int64]  # (C + 1,) first frame of each recording, and the end
    subject: NDArray[np.str_]  # (C,) the person

    def of(self, subjects: Collection[str]) -> "Pairs":
        clips = np.flatnonzero(np.isin(self.subject, list(subjects)))
        rows = np.concatenate([np.arange(*self.start[c : c + 2]) for c in clips])
        lengths = np.diff(self.start)[clips]
        start = np.concatenate([[0], np.cumsum(lengths)])
        return Pairs(self.seen[rows], self.truth[rows], start, self.subject[clips])


def write_arrays(mocap: Path, out: Path) -> Path:
    """Read the recordings under ``mocap`` that are licensed for products; write ``motion-SPLIT.npz`` and ``pairs.npz``.

    Recordings of the test split are excluded. Arrays that are there are kept. Returns ``out``. Raises MotionError if
    there are none of one split, or no pairs of Kinect and Vicon (``ui_prmd.npz``).
    """
    if (out / "pairs.npz").is_file():
        return out
    by_split: dict[str, list[tuple[str, float, NDArray[np.float32]]]] = {"train": [], "val": []}
    for data in DATA_SETS:
        if data.name not in _FREE:
            continue
        for path in sorted(path for path in mocap.iterdir() if data.matches(path)):
            for clip in track(list(data.read(path, lambda _: None)), description=data.name):
                if not isinstance(clip, Clip):
                    continue
                split = data.split(clip)
                if split in by_split:
                    by_split[split] += [(data.name, *part) for part in _at_speeds(clip)]
    for split, clips in by_split.items():
        if not clips:
            raise MotionError(f"{mocap}: expected motion capture of {', '.join(sorted(_FREE))}; none is for '{split}'")
    out.mkdir(parents=True, exist_ok=True)
    for split, clips in by_split.items():
        lengths = [len(positions) for _, _, positions in clips]
        np.savez(
            out / f"motion-{split}.npz",
            positions=np.concatenate([positions for _, _, positions in clips]),
            start=np.concatenate([[0], np.cumsum(lengths)]),
            source=np.array([source for source, _, _ in clips]),
            speed=np.array([speed for _, speed, _ in clips]),
        )
    # the last: its existence means that all arrays are written
    save_arrays(out / "pairs.npz", **vars(_pairs(mocap / "ui_prmd.npz")))
    return out


def load_motion(arrays: Path, split: str) -> Motion:
    """Read the motion of a split from the folder of `write_arrays`."""
    with np.load(arrays / f"motion-{split}.npz") as data:
        return Motion(**data)


def load_kinect(arrays: Path, split: str) -> Pairs:
    """Read the pairs of the training subjects or of the validation subjects, likewise."""
    with np.load(arrays / "pairs.npz") as data:
        return Pairs(**data).of(TRAIN_SUBJECTS if split == "train" else VALIDATION_SUBJECTS)


def _at_speeds(clip: Clip) -> Iterator[tuple[float, NDArray[np.float32]]]:
    """Yield the faultless parts of a recording at `SPEEDS`, resampled to 30 Hz."""
    clip = clip.canonical()
    if clip.seconds < 1.0:
        return
    filled = fill_gaps(clip.positions, clip.fps)
    for first, last in runs(np.asarray(finite_joints(filled).all(axis=1))):
        if (last - first) / clip.fps < 1.0:
            continue
        slow = resample(filled[first:last], clip.fps)
        bad, _ = find_faults(slow)
        for speed in SPEEDS:
            fast = resample(filled[first:last], clip.fps * speed)
            faulty = bad[np.minimum((np.arange(len(fast)) * speed).astype(int), len(bad) - 1)]
            for a, b in runs(~faulty):
                if b - a >= FPS:
                    yield speed, fast[a:b].astype(np.float32)


def _pairs(path: Path) -> Pairs:
    observed, truth, names = [], [], []
    for subject in (*TRAIN_SUBJECTS, *VALIDATION_SUBJECTS):
        clips = [pair for pair in load_pairs(path, [subject]) if pair.fps == FPS and len(pair.kinect) >= FPS]
        aligned = []
        for pair in clips:
            kinect = to_canonical(KINECT22, pair.kinect)[0]
            rotation, translation = rigid_alignment(kinect[:, _ALIGNED], pair.vicon[:, _ALIGNED])
            aligned.append(kinect @ rotation.T + translation)
        frames = [trunk_frame(pair.vicon) for pair in clips]
        apart = [
            np.einsum("tba,tjb->tja", frame, kinect - pair.vicon)
            for frame, kinect, pair in zip(frames, aligned, clips, strict=True)
        ]
        offset = np.nanmedian(np.concatenate(apart), axis=0)
        for frame, kinect, pair in zip(frames, aligned, clips, strict=True):
            observed.append(kinect.astype(np.float32))
            truth.append((pair.vicon + np.einsum("tab,jb->tja", frame, offset)).astype(np.float32))
            names.append(subject)
    start = np.concatenate([[0], np.cumsum([len(s) for s in observed])])
    return Pairs(np.concatenate(observed), np.concatenate(truth), start, np.array(names))


def trunk_frame(joints: Floats, corners: Sequence[int] = (*HIPS, *SHOULDERS)) -> Floats:
    """Return the trunk's axes forward, left and up as columns, (..., 3, 3), of joints (..., J, 3).

    Up runs from the hips to the shoulders, which are the ``corners``: left hip, right hip, left and right shoulder.
    """
    left_hip, right_hip, left_shoulder, right_shoulder = (joints[..., corner, :] for corner in corners)
    up = left_shoulder + right_shoulder - left_hip - right_hip
    up = up / np.linalg.norm(up, axis=-1, keepdims=True)
    left = left_shoulder - right_shoulder + left_hip - right_hip
    left = left - (left * up).sum(axis=-1, keepdims=True) * up
    left = left / np.linalg.norm(left, axis=-1, keepdims=True)
    return np.stack([np.cross(left, up), left, up], axis=-1)
