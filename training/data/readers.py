"""Reads recordings from archives, folders and files; yields each recording, or the reason why it is dropped.

Of UI-PRMD it also reads the Kinect beside the Vicon, our only source of real noise with ground truth (Vakanski et al.
2018, "A data set of human body movements for physical rehabilitation exercises", Data 3(1):2).
"""

import tarfile
import zlib
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from lzma import LZMAError
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats
from steadypose.prior.body.layouts import CANONICAL, Skeleton, to_canonical
from steadypose.prior.body.rigs import Rig, up_axis
from steadypose.prior.mocap.bvh import Bvh, read_bvh
from steadypose.prior.mocap.clip import TO_Z_UP, Y_UP_TO_Z_UP, Clip, MotionError
from steadypose.prior.mocap.files import SUFFIXES, UNDESCRIBED, Description, file_rig, read_motion
from steadypose.prior.mocap.plug_in_gait import calibrate, joint_centres
from steadypose.prior.npz import open_npz
from steadypose.training.data.cmu import CMU_AMC, Asf, read_amc, read_asf

REST_POSE_SPEED = 30.0
"""Speed that no body reaches, m/s; a first frame that is left faster is a rest pose inserted by a converter."""

LEAVING_SPEED, REST_POSE_SECONDS = 5.0, 0.1
"""Speed, m/s, and time after an inserted rest pose, seconds, at which frames are dropped too. Converters that filter
blend the rest pose into the motion (five frames of `cmu_dance` at 120 Hz)."""

UNREADABLE = "cannot be read"


@dataclass(frozen=True)
class Dropped:
    """A recording, or a part of one, that is excluded from training, with the reason."""

    name: str  # name of the recording
    source: str  # its data set
    kind: str  # general cause, for counting
    cause: str  # the cause in this case, with its figures


Progress = Callable[[float], None]
"""Type of a progress callback, called with the share of a file, 0 to 1, that has been read."""


def members(path: Path, suffixes: tuple[str, ...], progress: Progress) -> Iterator[tuple[str, bytes]]:
    """Yield names and contents of files with these suffixes in an archive (.tar, .tar.xz, ...), a folder, or a file.

    Archives are read as a stream, in their own order; folders are read by name. Raises MotionError if the file is no
    archive, or is truncated.
    """
    if path.is_file() and path.suffix not in suffixes:
        size = path.stat().st_size
        try:
            with path.open("rb") as raw, tarfile.open(fileobj=raw, mode="r|*") as archive:
                for entry in archive:
                    if entry.isfile() and entry.name.endswith(suffixes) and (file := archive.extractfile(entry)):
                        yield entry.name, file.read()
                        progress(raw.tell() / size)
        except (tarfile.TarError, LZMAError, zlib.error, EOFError) as error:
            raise MotionError(f"{path}: expected a .tar archive, whole: {error}") from error
        return
    files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.suffix in suffixes)
    root = path.parent if path.is_file() else path
    for i, file in enumerate(files):
        yield file.relative_to(root).as_posix(), file.read_bytes()
        progress((i + 1) / len(files))


def bvh_motion(text: str) -> tuple[Bvh, Skeleton, Floats]:
    """A BVH file, its skeleton, and the positions (T, J, 3) of that skeleton's joints, metres, z up. Raises MotionError
    if it cannot be read, or no body is recognised in it."""
    bvh = read_bvh(text)
    rig = file_rig(bvh.joints, bvh.parents, bvh.offsets, UNDESCRIBED)
    positions = _select(rig, bvh.joints, bvh.positions(rig.lost_bones))
    return bvh, rig.skeleton, positions[_rest_frames(positions, bvh.fps) :]


def _rest_frames(positions: Floats, fps: float) -> int:
    """Return the number of frames at the start that are an inserted rest pose or the transition from it."""
    start = positions[: max(2, round(REST_POSE_SECONDS * fps) + 1)]
    speed = np.abs(np.diff(start, axis=0)).max(axis=(1, 2), initial=0.0) * fps
    if not len(speed) or speed[0] <= REST_POSE_SPEED:
        return 0
    return int(np.flatnonzero(speed > LEAVING_SPEED)[-1]) + 1


def _select(rig: Rig, joints: Sequence[str], positions: Floats) -> Floats:
    """Select the rig's joints of (T, J, 3), in metres, z up."""
    missing = set(rig.skeleton.joints) - set(joints)
    if missing:
        raise MotionError(f"expected the joints of '{rig.skeleton.name}', lacks {', '.join(sorted(missing))}")
    selected = positions[:, [joints.index(j) for j in rig.skeleton.joints]] * rig.metres
    up = rig.up or up_axis(to_canonical(rig.skeleton, selected)[0])
    return selected @ TO_Z_UP[up].T


def amc_motions(path: Path, progress: Progress) -> Iterator[tuple[str, Floats | MotionError]]:
    """Yield names and positions (T, J, 3) metres, z up, of AMC files; for an unreadable file, the reason.

    The skeleton of ``01/01_05.amc`` is the ``.asf`` in the same folder.
    """
    skeletons: dict[str, Asf | MotionError] = {}
    waiting: list[tuple[str, str]] = []
    for name, content in members(path, (".asf", ".amc"), lambda share: progress(0.3 * share)):
        # an archive may have its files in any order
        if name.endswith(".asf"):
            try:
                skeletons[folder_of(name)] = read_asf(content.decode("ascii", "replace"))
            except MotionError as error:
                skeletons[folder_of(name)] = error
        else:
            waiting.append((name, content.decode("ascii", "replace")))
    for done, (name, text) in enumerate(waiting, start=1):
        progress(0.3 + 0.7 * done / len(waiting))
        skeleton = skeletons.get(folder_of(name), MotionError("expected an .asf file in the same folder, found none"))
        try:
            if isinstance(skeleton, MotionError):
                raise skeleton
            yield name, _select(CMU_AMC, skeleton.joints, read_amc(text, skeleton))
        except MotionError as error:
            yield name, error


def folder_of(name: str) -> str:
    return PurePosixPath(name).parent.as_posix()


def stem_of(name: str) -> str:
    return PurePosixPath(name).stem


def read_own(path: Path, progress: Progress, description: Description = UNDESCRIBED) -> Iterator[Clip | Dropped]:
    """Read the motion files of a user's folder, archive or file. Each file's folder names its person.

    ``progress`` is called with the share that is read; ``description`` has what the files lack.
    """
    for name, content in members(path, SUFFIXES, progress):
        try:
            fps, positions = read_motion(name, content, description)
        except MotionError as error:
            yield Dropped(name, "own", UNREADABLE, str(error))
            continue
        yield Clip(name, "own", "own", folder_of(name), "", fps, CANONICAL, positions[_rest_frames(positions, fps) :])


TRAIN_SUBJECTS = ("s01", "s02", "s03", "s04", "s05", "s06")
VALIDATION_SUBJECTS = ("s07", "s08")

_METRES_PER_COUNT = 1e-4
_MISSING = -32768


@dataclass(frozen=True)
class KinectPair:
    """One repetition of a movement, observed by both systems at the same times.

    They agree in time but not in space: align them with one rotation and translation per clip.
    """

    name: str  # name in the file, such as ``m01_s01_e01``; with ``_inc``, the movement is deliberately incorrect
    subject: str  # ``s01`` to ``s08``
    movement: str  # ``m01`` to ``m10``
    fps: float  # frames per second
    kinect: NDArray[np.float64]  # (T, 22, 3) metres, ``kinect22``, z up, the camera at the origin, looking along +y
    vicon: NDArray[np.float64]  # (T, 22, 3) metres, canonical joint centres, z up; NaN where markers were lost


def _metres(counts: NDArray[np.int16]) -> NDArray[np.float64]:
    return np.where(counts == _MISSING, np.nan, counts * _METRES_PER_COUNT)


def load_pairs(path: Path, subjects: Collection[str]) -> list[KinectPair]:
    """Read some subjects' recordings from ``ui_prmd.npz``, ordered by subject, movement, repetition.

    Raises MotionError if the file is not this archive, or lacks a subject.
    """
    with open_npz(path, "fps", "vicon_names") as archive:
        marker_names = [str(n) for n in archive["vicon_names"]]
        fps = float(archive["fps"])
        names = (name.removesuffix("/kinect") for name in archive.files if name.endswith("/kinect"))
        split = sorted(((n.split("_")[1], n) for n in names), key=lambda pair: pair)
        missing = set(subjects) - {s for s, _ in split}
        if missing:
            raise MotionError(f"{path}: no recordings of {', '.join(sorted(missing))}")
        pairs: list[KinectPair] = []
        for subject, group in groupby((p for p in split if p[0] in subjects), key=lambda pair: pair[0]):
            markers = {
                name: dict(zip(marker_names, _metres(archive[f"{name}/vicon_markers"]).swapaxes(0, 1), strict=True))
                for _, name in group
            }
            calibration = calibrate(markers.values())
            pairs += [
                KinectPair(
                    name=name,
                    subject=subject,
                    movement=name.split("_")[0],
                    fps=fps,
                    kinect=_metres(archive[f"{name}/kinect"]) @ Y_UP_TO_Z_UP.T,
                    vicon=joint_centres(own, calibration),
                )
                for name, own in markers.items()
            ]
    return pairs
