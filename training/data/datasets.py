"""The data sets that are known: who moves in them, under which licence, and what is held out to validate and to test.

What is held out is never a random choice of frames or clips where the subject is known: the motion model would be
measured on people it has learnt. A person is in one split only.
"""

from __future__ import annotations

import re
import tarfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from lzma import LZMAError
from pathlib import Path, PurePosixPath
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.body.layouts import CANONICAL, Skeleton, to_canonical
from steadypose.prior.body.rigs import Rig, RigError, up_axis
from steadypose.prior.mocap.amc import Asf, read_amc, read_asf
from steadypose.prior.mocap.bvh import Bvh, read_bvh
from steadypose.prior.mocap.clip import TO_Z_UP, Clip, MotionError
from steadypose.prior.mocap.cmu import CMU_AMC, CMU_BVH, read_expmap
from steadypose.prior.mocap.files import SUFFIXES, UNDESCRIBED, Description, file_rig, read_motion
from steadypose.training.data.cmu import CMU_ACTIONS, NORMALISED, REPEATS
from steadypose.training.data.ui_prmd import TRAIN_SUBJECTS, VALIDATION_SUBJECTS, load_pairs

CMU_LICENCE = "CMU mocap: free, no resale"
"""Free for all uses, products included; the data itself may not be resold; acknowledge NSF EIA-0196217."""

CMU_FPS = 120.0
"""Frames a second of CMU's AMC files, which do not state it."""

REST_POSE_SPEED = 30.0
"""m/s. No body does this: a first frame that is left faster is a rest pose that a converter has put in front."""

LEAVING_SPEED, REST_POSE_SECONDS = 5.0, 0.1
"""m/s, seconds. Converters that filter blend the rest pose into the motion: frames that are left faster than this, so
soon after it, go too (five of `cmu_dance`'s at 120 Hz)."""

UNREADABLE = "cannot be read"

Split = Literal["train", "val", "test"]
"""What a recording may be used for: nothing is chosen on ``test``."""

SPLITS: tuple[Split, ...] = ("train", "val", "test")

WeightSet = Literal["default", "research"]

Use = Literal["default", "research", "measure"]
"""Which weights a recording may train: ``default`` all of them, ``research`` those that are not for products, and
``measure`` none: it validates and tests."""


@dataclass(frozen=True)
class Dropped:
    """A recording, or a part of one, that does not go into training, and why.

    Attributes:
        name: of the recording.
        source: its data set.
        kind: the cause in general words, to count by.
        cause: the cause in this case, with its figures.
    """

    name: str
    source: str
    kind: str
    cause: str


Progress = Callable[[float], None]
"""Told how much of a file, 0 to 1, has been read."""


@dataclass(frozen=True)
class DataSet:
    """A source of motion.

    Attributes:
        name: of the source.
        files: a pattern (regex) of the names of the files or folders that hold it.
        weights: which weights models trained on it may become.
        read: reads a file or folder.
        split: assigns a clip to training, validation or test.
    """

    name: str
    files: str
    weights: Use
    read: Callable[[Path, Progress], Iterator[Clip | Dropped]]
    split: Callable[[Clip], Split]

    def matches(self, path: Path) -> bool:
        """Whether a file or folder holds it, by its name."""
        return re.fullmatch(self.files, path.name) is not None


def members(path: Path, suffixes: tuple[str, ...], progress: Progress) -> Iterator[tuple[str, bytes]]:
    """Names and contents of the files with some suffix in an archive (.tar, .tar.xz, ...), folder, or file.

    Archives are read as a stream, in their own order; folders by name.

    Raises:
        MotionError: the archive is cut short or none.
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


def bvh_motion(text: str) -> tuple[Bvh, Skeleton, NDArray[np.float64]]:
    """A BVH file, its skeleton, and the positions (T, J, 3) of that skeleton's joints, metres, z up.

    Raises:
        MotionError: it cannot be read, or no body is recognised in it.
    """
    bvh = read_bvh(text)
    try:
        rig = file_rig(bvh.joints, bvh.parents, bvh.offsets, UNDESCRIBED)
    except RigError as error:
        raise MotionError(str(error)) from error
    positions = _select(rig, bvh.joints, bvh.positions(rig.lost_bones))
    return bvh, rig.skeleton, positions[_rest_frames(positions, bvh.fps) :]


def _rest_frames(positions: NDArray[np.float64], fps: float) -> int:
    """How many frames at the start are a rest pose that a converter has put in front, and the way out of it."""
    start = positions[: max(2, round(REST_POSE_SECONDS * fps) + 1)]
    speed = np.abs(np.diff(start, axis=0)).max(axis=(1, 2), initial=0.0) * fps
    if not len(speed) or speed[0] <= REST_POSE_SPEED:
        return 0
    return int(np.flatnonzero(speed > LEAVING_SPEED)[-1]) + 1


def _select(rig: Rig, joints: Sequence[str], positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rig's joints of (T, J, 3), in metres, z up."""
    missing = set(rig.skeleton.joints) - set(joints)
    if missing:
        raise MotionError(f"expected the joints of '{rig.skeleton.name}', lacks {', '.join(sorted(missing))}")
    selected = positions[:, [joints.index(j) for j in rig.skeleton.joints]] * rig.metres
    up = rig.up or up_axis(to_canonical(rig.skeleton, selected)[0])
    return selected @ TO_Z_UP[up].T


def amc_motions(path: Path, progress: Progress) -> Iterator[tuple[str, NDArray[np.float64] | MotionError]]:
    """Names and positions (T, J, 3), metres, z up, of AMC files; of one that cannot be read, the reason.

    The skeleton of ``01/01_05.amc`` is the ``.asf`` in the same folder.
    """
    skeletons: dict[str, Asf | MotionError] = {}
    waiting: list[tuple[str, str]] = []
    for name, content in members(path, (".asf", ".amc"), lambda share: progress(0.3 * share)):
        # An archive has its files in any order.
        if name.endswith(".asf"):
            try:
                skeletons[_folder(name)] = read_asf(content.decode("ascii", "replace"))
            except MotionError as error:
                skeletons[_folder(name)] = error
        else:
            waiting.append((name, content.decode("ascii", "replace")))
    for done, (name, text) in enumerate(waiting, start=1):
        progress(0.3 + 0.7 * done / len(waiting))
        motion: NDArray[np.float64] | MotionError
        try:
            skeleton = skeletons.get(_folder(name), MotionError("expected an .asf file in the same folder, found none"))
            if isinstance(skeleton, MotionError):
                raise skeleton
            motion = _select(CMU_AMC, skeleton.joints, read_amc(text, skeleton))
        except MotionError as error:
            motion = error
        yield name, motion


def _folder(name: str) -> str:
    return PurePosixPath(name).parent.as_posix()


def _stem(name: str) -> str:
    return PurePosixPath(name).stem


def _read_cmu_amc(path: Path, progress: Progress) -> Iterator[Clip | Dropped]:
    for name, motion in amc_motions(path, progress):
        stem = _stem(name)
        if isinstance(motion, MotionError):
            yield Dropped(stem, "CMU (AMC)", UNREADABLE, str(motion))
            continue
        subject = stem.split("_")[0]
        action = CMU_ACTIONS.get(stem, CMU_ACTIONS.get(subject, ""))
        yield Clip(stem, "CMU (AMC)", CMU_LICENCE, subject, action, CMU_FPS, CMU_AMC.skeleton, motion)


def _repeat(name: str, source: str) -> Dropped:
    return Dropped(name, source, "repeats another", f"the same recording as {REPEATS[name]}")


class _Told(NamedTuple):
    """What the path of a recording tells, and its skeleton."""

    name: str
    subject: str
    action: str = ""


def _bvh_reader(
    source: str, licence: str, tell: Callable[[str, Bvh], _Told]
) -> Callable[[Path, Progress], Iterator[Clip | Dropped]]:
    """Reads the BVH files of an archive or folder."""

    def read(path: Path, progress: Progress) -> Iterator[Clip | Dropped]:
        for name, content in members(path, (".bvh",), progress):
            if PurePosixPath(name).parent.name == NORMALISED:
                yield Dropped(name, source, "of unknown speed", "stretched to 240 frames, whatever it lasted")
                continue
            try:
                bvh, skeleton, positions = bvh_motion(content.decode("ascii", "replace"))
            except MotionError as error:
                yield Dropped(name, source, UNREADABLE, str(error))
                continue
            told = tell(name, bvh)
            if told.name in REPEATS:
                yield _repeat(told.name, source)
                continue
            yield Clip(told.name, source, licence, told.subject, told.action, bvh.fps, skeleton, positions)

    return read


def _tell_cmu(name: str, _bvh: Bvh) -> _Told:
    subject = _stem(name).split("_")[0][-2:]
    return _Told(_stem(name), subject, CMU_ACTIONS.get(subject, ""))


def _tell_cmu_more(name: str, _bvh: Bvh) -> _Told:
    return _Told(_stem(name), _stem(name).split("_")[0])


def _tell_kind(name: str, _bvh: Bvh) -> _Told:
    """All stand on one skeleton; who dances is not told, but no one of one kind is in another."""
    kind = PurePosixPath(name).parent.name
    return _Told(f"{kind}_{_stem(name)}", kind, kind)


def _tell_reactidle(name: str, _bvh: Bvh) -> _Told:
    subject, _, kind = _stem(name).partition("_")
    return _Told(_stem(name), subject, f"idle, {kind}")


def _tell_bandai(name: str, bvh: Bvh) -> _Told:
    """All bones have been retargeted to one body; the place of the hips in the rest pose differs by session."""
    session = " ".join(f"{v:.1f}" for v in bvh.offsets[bvh.joints.index("Hips")])
    return _Told(_stem(name), session, " ".join(_stem(name).split("_")[1:-1]))


def _tell_dancedb(name: str, _bvh: Bvh) -> _Told:
    stem = _stem(name).removesuffix("-BVH")
    subject, _, emotion = stem.partition("_")
    return _Told(stem, subject, emotion.split("_")[0].lower())


def _tell_lafan1(name: str, _bvh: Bvh) -> _Told:
    action, _, subject = _stem(name).rpartition("_")
    return _Told(_stem(name), subject, action.rstrip("0123456789"))


def _read_cmu_expmap(path: Path, progress: Progress) -> Iterator[Clip | Dropped]:
    source = "CMU (expmap)"
    with path.open("rb") as file:
        for share, name, fps, positions in read_expmap(file):
            progress(share)
            if name in REPEATS:
                yield _repeat(name, source)
                continue
            action = " ".join(name.split("_")[1:-1])
            motion = positions @ TO_Z_UP["y"].T
            yield Clip(name, source, CMU_LICENCE, "unknown", action, fps, CMU_BVH.skeleton, motion)


def read_own(path: Path, progress: Progress, description: Description = UNDESCRIBED) -> Iterator[Clip | Dropped]:
    """The files of motion of anybody's folder, archive, or of one file; the folder that each lies in is a person's.

    Args:
        path: of these.
        progress: told how much is read.
        description: what the files do not say.
    """
    for name, content in members(path, SUFFIXES, progress):
        try:
            fps, positions = read_motion(name, content, description)
        except MotionError as error:
            yield Dropped(name, "own", UNREADABLE, str(error))
            continue
        yield Clip(name, "own", "own", _folder(name), "", fps, CANONICAL, positions[_rest_frames(positions, fps) :])


def _read_amass(path: Path, progress: Progress) -> Iterator[Clip | Dropped]:
    for clip in read_own(path, progress):
        told = {"source": "AMASS", "licence": "AMASS: non-commercial"}
        yield replace(clip, **told) if isinstance(clip, Clip) else replace(clip, source=told["source"])


def _read_ui_prmd(path: Path, progress: Progress) -> Iterator[Clip | Dropped]:
    pairs = load_pairs(path, TRAIN_SUBJECTS + VALIDATION_SUBJECTS)
    for i, pair in enumerate(pairs):
        yield Clip(
            pair.name, "UI-PRMD (Vicon)", "PDDL-1.0", pair.subject, pair.movement, pair.fps, CANONICAL, pair.vicon
        )
        progress((i + 1) / len(pairs))


def _held_out(test: bool) -> Split:
    return "val" if test else "train"


def _own_split(clip: Clip) -> Split:
    """By the folders that a recording of the user's own lies in."""
    folders = PurePosixPath(clip.name).parts
    return "val" if "val" in folders else "test" if "test" in folders else "train"


CMU_VALIDATION = frozenset({"02"})
"""Subjects of the AMC recordings; all ten of subject 02's are among them, so that no other archive has more of them."""

DANCE_TRAINING = frozenset({"salsa"})
"""Kinds, and so people: the others (martial arts, Indian dance) are the test split."""

REACTIDLE_VALIDATION = ("013", "014", "015")
"""Subjects."""

BANDAI_VALIDATION = "-17.2 93.2 453.0"
"""The rest pose's hips of the session held out: one of the second set's three, 807 clips."""

AMASS_VALIDATION = frozenset({"HumanEva", "MPI_HDM05", "HDM05", "SFU", "MPI_mosh", "MoSh"})
"""Folders that hold the parts HM-VAE validates on (the names of both of AMASS' releases)."""

DANCEDB_VALIDATION = frozenset({"Andria", "Elena"})
"""Dancers; Anna, Olivia and Theodora are the test split."""

LAFAN1_VALIDATION = "subject1"
"""An actor; subjects 2 to 4 are the test split."""

DATA_SETS: tuple[DataSet, ...] = (
    # The unnamed expmap clips may be of subjects 06 and 07: all of these train.
    DataSet(
        "CMU (AMC)", r"cmu_amc\b.*", "default", _read_cmu_amc,
        lambda clip: _held_out(clip.subject in CMU_VALIDATION),
    ),
    DataSet(
        "CMU (BVH)", r"cmu_bvh\b.*", "default", _bvh_reader("CMU (BVH)", CMU_LICENCE, _tell_cmu),
        lambda _: "train",
    ),
    DataSet("CMU (expmap)", r"cmu_expmap\b.*", "default", _read_cmu_expmap, lambda _: "train"),
    DataSet(
        "CMU (more)", r"cmu_more\b.*", "default", _bvh_reader("CMU (more)", CMU_LICENCE, _tell_cmu_more),
        lambda _: "train",
    ),
    DataSet(
        "CMU (dance)", r"cmu_dance\b.*", "default", _bvh_reader("CMU (dance)", CMU_LICENCE, _tell_kind),
        lambda clip: "train" if clip.subject in DANCE_TRAINING else "test",
    ),
    DataSet(
        "ReActIdle", r"reactidle\b.*", "default", _bvh_reader("ReActIdle", "MIT", _tell_reactidle),
        lambda clip: _held_out(clip.subject in REACTIDLE_VALIDATION),
    ),
    DataSet(
        "UI-PRMD (Vicon)", r"ui_prmd\b.*", "default", _read_ui_prmd,
        lambda clip: _held_out(clip.subject in VALIDATION_SUBJECTS),
    ),
    DataSet(
        "Bandai-Namco", r"bandai_\d\b.*", "research", _bvh_reader("Bandai-Namco", "CC-BY-NC-4.0", _tell_bandai),
        lambda clip: _held_out(clip.subject == BANDAI_VALIDATION),
    ),
    DataSet(
        "AMASS", r"amass\b.*", "research", _read_amass,
        lambda clip: _held_out(not AMASS_VALIDATION.isdisjoint(PurePosixPath(clip.name).parts)),
    ),
    DataSet(
        "DanceDB", r"dancedb\b.*", "measure", _bvh_reader("DanceDB", "DanceDB: research", _tell_dancedb),
        lambda clip: "val" if clip.subject in DANCEDB_VALIDATION else "test",
    ),
    DataSet(
        "LAFAN1", r"lafan1\b.*", "measure", _bvh_reader("LAFAN1", "CC-BY-NC-ND-4.0", _tell_lafan1),
        lambda clip: "val" if clip.subject == LAFAN1_VALIDATION else "test",
    ),
    DataSet(
        "own", r"own\b.*", "default", read_own,
        _own_split,
    ),
)  # fmt: skip
"""In the order of preparation. What a user puts into a folder ``own`` is theirs to train on: the default set."""
