"""Converts recordings to training data: complete bodies at 30 Hz on a floor, checked, labelled and split."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation

from steadypose.prior.body.bone_lengths import estimate_offsets
from steadypose.prior.body.capsules import TOE_HEIGHT
from steadypose.prior.body.inverse_kinematics import solve_rotations
from steadypose.prior.body.kinematics import REST_SPEED, label_contacts
from steadypose.prior.body.skeleton import JOINTS, PARENTS, J, finite_joints
from steadypose.prior.mocap.clip import Clip, MotionError
from steadypose.prior.timing.rate import FPS
from steadypose.training.data.datasets import Split, Use
from steadypose.training.data.readers import Dropped

CUTOFF = 12.0  # cut-off frequency of the anti-aliasing filter before resampling to 30 Hz, Hz

FAST_ENOUGH = 50.0
"""Least frame rate of a recording that may be played faster, frames per second; a slower one lacks motion at 30 Hz."""

MAX_GAP = 0.2
"""Longest gap of a joint that is interpolated, seconds; at longer gaps, the recording is cut."""

MIN_SECONDS = 1.0  # least duration of a recording, seconds; shorter ones are dropped, as in HuMoR

MAX_BONE_CHANGE = 0.10
"""Largest difference of a bone from its median in the recording, metres. Bones computed from skin markers vary by 1 to
3 cm (standard deviation); a mislabelled marker changes them by more than this."""

MAX_ACCELERATION = 200.0
"""Largest acceleration (second difference at 30 Hz), m/s². The fastest real motion of these recordings, a kicking foot,
reaches 195; a joint that jumps by 15 cm and back reaches 270."""

RAISED = 0.12  # height above the floor above which a lower toe that stands still is on something else, metres


@dataclass(frozen=True)
class Prepared:
    """A recording ready for training."""

    clip: Clip  # its joints canonical, at 30 Hz, z up, floor at z = 0
    weights: Use  # which weights it may train
    split: Split  # training, validation or test
    offsets: NDArray[np.float64]  # (22, 3) metres, its subject's bones
    rotations: NDArray[np.float64]  # (T, 22, 4) local, xyzw
    contacts: NDArray[np.bool_]  # (T, 8) labels
    flat: bool  # whether the person stays on the floor; contacts on raised objects are not labelled
    speed: float = 1.0  # factor by which it is sped up

    def __post_init__(self) -> None:
        if (self.weights, self.split) == ("measure", "train"):
            raise MotionError(
                f"{self.clip.name}: expected a split val or test for a source that only measures, got train"
            )


def at_speed(clip: Clip, speed: float) -> Clip | None:
    """Return the clip played faster, and named so; None if it was recorded at less than `FAST_ENOUGH`.

    A motion that is sped up has frequencies at 30 Hz that its recording at 30 Hz lacks.
    """
    if speed == 1.0:
        return clip
    return replace(clip, name=f"{clip.name} x{speed:g}", fps=clip.fps * speed) if clip.fps >= FAST_ENOUGH else None


def prepare_clip(clip: Clip, weights: Use, split: Split, speed: float = 1.0) -> Iterator[Prepared | Dropped]:
    """Resample a recording, as read or of `at_speed`, estimate its floor, check and label it.

    Yields its valid parts, and the dropped parts with the reasons. A recording is cut where joints are lost or move
    impossibly. A part is named by the second at which it begins. ``speed`` is the factor by which it is sped up, which
    raises the limit of accelerations.
    """
    clip = clip.canonical()
    if clip.seconds < MIN_SECONDS:
        yield _too_short(clip.name, clip.source, clip.seconds)
        return
    filled = fill_gaps(clip.positions, clip.fps)
    complete = np.asarray(finite_joints(filled).all(axis=1))
    if not complete.all():
        lost = [JOINTS[j] for j in np.flatnonzero(~finite_joints(filled).all(axis=0))]
        cause = f"{(~complete).sum() / clip.fps:.2f} s of {clip.seconds:.2f} s lack {', '.join(lost)}"
        yield Dropped(clip.name, clip.source, f"cut: joints lost for more than {MAX_GAP} s or at an end", cause)
    for start, stop in runs(complete):
        seconds = (stop - start) / clip.fps
        if seconds < MIN_SECONDS:
            yield _too_short(f"{clip.name}@{start / clip.fps:.1f}s", clip.source, seconds)
            continue
        positions = resample(filled[start:stop], clip.fps)
        positions[..., 2] -= floor_height(positions)
        bad, fault = find_faults(positions, MAX_ACCELERATION * speed**2)
        if fault:
            yield Dropped(clip.name, clip.source, "cut: impossible motion", fault)
        for first, last in runs(~bad):
            name = clip.name if complete.all() and not fault else f"{clip.name}@{start / clip.fps + first / FPS:.1f}s"
            if (last - first) / FPS < MIN_SECONDS:
                yield _too_short(name, clip.source, (last - first) / FPS)
            else:
                part = replace(clip, name=name, fps=FPS, positions=positions[first:last])
                yield _label(part, weights, split, speed)


def _too_short(name: str, source: str, seconds: float) -> Dropped:
    return Dropped(name, source, f"shorter than {MIN_SECONDS:.0f} s", f"{seconds:.2f} s long")


def _label(clip: Clip, weights: Use, split: Split, speed: float) -> Prepared:
    offsets = estimate_offsets(clip.positions)
    rotations = Rotation.from_matrix(solve_rotations(clip.positions, offsets).reshape(-1, 3, 3)).as_quat()
    return Prepared(
        clip=clip,
        weights=weights,
        split=split,
        offsets=offsets,
        rotations=rotations.reshape(*clip.positions.shape[:2], 4),
        contacts=label_contacts(clip.positions, FPS),
        flat=stays_on_floor(clip.positions),
        speed=speed,
    )


def fill_gaps(positions: NDArray[np.float64], fps: float) -> NDArray[np.float64]:
    """Interpolate joints (T, J, 3) linearly that are lost (NaN) for at most `MAX_GAP`; longer gaps stay NaN."""
    filled = positions.copy()
    lost = ~finite_joints(positions)
    time = np.arange(len(positions))
    for joint in np.flatnonzero(lost.any(axis=0)):
        observed = ~lost[:, joint]
        for start, stop in runs(lost[:, joint]):
            filled[start:stop, joint] = np.nan
            if start > 0 and stop < len(positions) and (stop - start) / fps <= MAX_GAP:
                for axis in range(3):
                    filled[start:stop, joint, axis] = np.interp(
                        time[start:stop], time[observed], positions[observed, joint, axis]
                    )
    return filled


def runs(mask: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """Yield start and stop of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]])))
    yield from zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)


def resample(positions: NDArray[np.float64], fps: float) -> NDArray[np.float64]:
    """Resample (T, J, 3) at ``fps`` to (T', J, 3) at 30 Hz by time, starting at the first frame.

    Faster recordings are filtered by a fourth-order Butterworth filter at 12 Hz, forwards and backwards for zero delay.
    All are then interpolated by a cubic spline. Impacts lose their frequencies above 12 Hz.
    """
    if abs(fps / FPS - 1) < 1e-4:
        return positions.copy()
    if fps > FPS:
        positions = sosfiltfilt(butter(4, CUTOFF, fs=fps, output="sos"), positions, axis=0)
    time = np.arange(len(positions)) / fps
    frames = int(time[-1] * FPS + 1e-6) + 1
    return CubicSpline(time, positions)(np.arange(frames) / FPS)


def floor_height(positions: NDArray[np.float64]) -> float:
    """Estimate the height of the floor under a recording at 30 Hz from resting toes, metres.

    As in HuMoR, it is the lowest height at which toes stand still (their fifth percentile, robust to outliers). If none
    does (a run in mid-stride), it is the second percentile of the lower toe.
    """
    toes, speed = _toes(positions)
    still = toes[..., 2][speed < REST_SPEED]
    resting = np.percentile(still, 5) if len(still) >= 5 else np.percentile(toes[..., 2].min(axis=1), 2)
    return float(resting) - TOE_HEIGHT


def stays_on_floor(positions: NDArray[np.float64]) -> bool:
    """Whether the lower toe hardly ever rests above the floor, in a recording at 30 Hz with its floor at 0."""
    toes, speed = _toes(positions)
    lower = toes[..., 2].argmin(axis=1)[:, None]
    height = np.take_along_axis(toes[..., 2], lower, axis=1)
    raised = (height > RAISED) & (np.take_along_axis(speed, lower, axis=1) < REST_SPEED)
    return float(raised.mean()) < 0.02


def _toes(positions: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return positions (T, 2, 3) and speeds (T, 2) of both toes."""
    toes = positions[:, [J["left_foot"], J["right_foot"]]]
    return toes, np.linalg.norm(np.gradient(toes, 1 / FPS, axis=0), axis=-1)


def find_faults(
    positions: NDArray[np.float64], max_acceleration: float = MAX_ACCELERATION
) -> tuple[NDArray[np.bool_], str]:
    """Return the frames (T,) of positions (T, 22, 3) at 30 Hz with impossible motion, and a description of the worst.

    The description is empty if there is none.
    """
    bad = np.zeros(len(positions), dtype=bool)
    words: list[str] = []
    bones = np.linalg.norm(positions[:, 1:] - positions[:, list(PARENTS[1:])], axis=-1)
    change = np.abs(bones - np.median(bones, axis=0))
    if change.max() > MAX_BONE_CHANGE:
        frame, bone = np.unravel_index(change.argmax(), change.shape)
        off = f"{change[frame, bone] * 100:.0f} cm off its length at {frame / FPS:.1f} s"
        words.append(f"the bone to {JOINTS[bone + 1]} is {off}")
        bad |= (change > MAX_BONE_CHANGE).any(axis=1)
    acceleration = np.linalg.norm(np.diff(positions, n=2, axis=0), axis=-1) * FPS**2
    if acceleration.max() > max_acceleration:
        frame, joint = np.unravel_index(acceleration.argmax(), acceleration.shape)
        words.append(f"{JOINTS[joint]} accelerates by {acceleration[frame, joint]:.0f} m/s² at {frame / FPS:.1f} s")
        jerked = (acceleration > max_acceleration).any(axis=1)
        for shift in range(3):
            bad[shift : shift + len(jerked)] |= jerked
    return bad, "; ".join(words)


def write_prepared(prepared: Sequence[Prepared], path: Path) -> None:
    """Write ``prepared.npz`` atomically.

    Arrays: ``positions`` (N, 22, 3) float32 metres, z up, floor 0, all recordings in a row at 30 Hz; ``rotations``
    (N, 22, 4) float32 local, xyzw; ``contacts`` (N, 8) bool; ``offsets`` (C, 22, 3) float32 metres; ``clip_start``
    (C + 1,) int64; and for each of the C recordings ``name``, ``source``, ``licence``, ``subject``, ``action``,
    ``split``, ``set``, ``flat`` and ``speed`` (see `Prepared`).
    """
    frames = [len(p.clip.positions) for p in prepared]
    arrays = {
        "positions": np.concatenate([p.clip.positions for p in prepared], dtype=np.float32),
        "rotations": np.concatenate([p.rotations for p in prepared], dtype=np.float32),
        "contacts": np.concatenate([p.contacts for p in prepared]),
        "offsets": np.stack([p.offsets for p in prepared]).astype(np.float32),
        "clip_start": np.concatenate([[0], np.cumsum(frames)]).astype(np.int64),
        "split": np.array([p.split for p in prepared]),
        "set": np.array([p.weights for p in prepared]),
        "flat": np.array([p.flat for p in prepared]),
        "speed": np.array([p.speed for p in prepared]),
    }
    for text in ("name", "source", "licence", "subject", "action"):
        arrays[text] = np.array([getattr(p.clip, text) for p in prepared])
    save_arrays(path, **arrays)


@contextmanager
def whole(path: Path) -> Iterator[BinaryIO]:
    """Open a file that is ``path`` after the block. If it cannot be written, what was there before stays. Raises
    OSError if it cannot be written, for example because the disk is full."""
    part = path.with_name(path.name + ".part")
    try:
        with part.open("wb") as file:
            yield file
        part.replace(path)
    except OSError as error:
        raise OSError(error.errno, os.strerror(error.errno or 0), str(path)) from error
    finally:
        part.unlink(missing_ok=True)


def save_arrays(path: Path, **arrays: NDArray[Any]) -> None:
    """Write an ``.npz`` atomically."""
    with whole(path) as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def made_once(path: Path, make: Callable[[], Mapping[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """Return the arrays of an ``.npz``, which are made and written if it is not there."""
    if not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        save_arrays(path, **make())
    with np.load(path) as arrays:
        return dict(arrays)
