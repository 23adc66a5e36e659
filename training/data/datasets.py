"""The known data sets: their people, their licences, and the parts held out for validation and test.

If subjects are known, people are held out, never random frames or clips: otherwise the model would be evaluated on
people of its training. Each person is in only one split.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Literal, NamedTuple

from steadypose.prior.body.layouts import CANONICAL
from steadypose.prior.mocap.bvh import CMU_BVH, Bvh
from steadypose.prior.mocap.clip import TO_Z_UP, Clip, MotionError
from steadypose.training.data.cmu import CMU_AMC, read_expmap
from steadypose.training.data.readers import (
    TRAIN_SUBJECTS,
    UNREADABLE,
    VALIDATION_SUBJECTS,
    Dropped,
    Progress,
    amc_motions,
    bvh_motion,
    load_pairs,
    members,
    read_own,
    stem_of,
)

CMU_LICENCE = "CMU mocap: free, no resale"
"""Licence of CMU's data: free for all uses including products; the data may not be resold; acknowledge NSF
EIA-0196217."""

CMU_FPS = 120.0  # frame rate of CMU's AMC files, which do not contain it, frames per second

CMU_ACTIONS = {
    "01": "playground", "06": "basketball", "07": "walk", "02_01": "walk", "02_02": "walk", "02_03": "run",
    "02_04": "jump, balance", "02_05": "punch", "02_06": "bend, lift",
    **dict.fromkeys(("02_07", "02_08", "02_09"), "swordplay"), "02_10": "wash",
}  # fmt: skip
"""Actions of CMU's recordings, by subject or by subject and trial."""

REPEATS = {
    **{f"002_{trial:02d}": f"02_{trial:02d}" for trial in range(1, 11)},
    "006_01": "train_walking_3",
    **{f"006_{trial:02d}": f"train_basketball_{trial - 1}" for trial in range(2, 7)},
    "006_07": "test_basketball_1", "007_01": "train_walking_4", "007_02": "train_walking_5", "train_walking_1": "02_01",
    "08_02": "train_walking_13", "08_03": "train_walking_14", "08_08": "train_walking_15", "08_09": "train_walking_16",
    "08_10": "train_walking_17", "10_01": "train_soccer_1", "10_02": "train_soccer_2", "10_03": "train_soccer_3",
    "10_04": "train_walking_18", "10_05": "train_soccer_4", "10_06": "train_soccer_5", "11_01": "test_soccer_1",
    "12_01": "train_walking_19", "12_02": "train_walking_20", "12_03": "train_walking_21", "13_11": "train_jumping_1",
    "13_19": "train_jumping_3", "13_26": "train_directing_traffic_1", "13_32": "train_jumping_4",
    "13_39": "train_jumping_5", "14_12": "test_washwindow_1", "14_36": "14_31",
}  # fmt: skip
"""Recordings that are in two CMU archives: the dropped one, and the kept one (nearer to the source, or for validation).

They were identified by the bends of elbows and knees, frame by frame. These differ by 0.1 degrees for AMC and
exponential maps, by less than 1.7 for the hobbyist's BVH, and by more than 5 between any two other recordings at the
same lag. Those of `cmu_more` use another body, whose elbows and knees are always bent by 11 to 16 degrees more. Without
this offset, two recordings of one length differ by 0.4 to 2.5 degrees, and the next ones by 2.7 or more.
"""

NORMALISED = "first2s"
"""Folder of `cmu_more` whose takes are all stretched to 240 frames. Walks and runs there all take one step per second.
Takes that are also in `cmu_more` itself match it at 0.5 to 0.6 of their speed, jumps at 1.3 to 2. No file contains the
factor, and networks would learn wrong speeds."""

Split = Literal["train", "val", "test"]  # split of a recording; nothing may be chosen on ``test``

SPLITS: tuple[Split, ...] = ("train", "val", "test")

WeightSet = Literal["default", "research"]

Use = Literal["default", "research", "measure"]
"""Weights that a recording may train: ``default`` trains all, ``research`` those that are not for products, and
``measure`` none; it only validates and tests."""


@dataclass(frozen=True)
class DataSet:
    name: str  # name of the source
    files: str  # regular expression of the first word of the names of its files or folders
    weights: Use  # weights that it may train
    read: Callable[[Path, Progress], Iterator[Clip | Dropped]]  # reads a file or folder
    split: Callable[[Clip], Split]  # assigns a clip to training, validation or test

    def matches(self, path: Path) -> bool:
        return re.match(rf"{self.files}\b", path.name) is not None


def _read_cmu_amc(path: Path, progress: Progress) -> Iterator[Clip | Dropped]:
    for name, motion in amc_motions(path, progress):
        stem = stem_of(name)
        if isinstance(motion, MotionError):
            yield Dropped(stem, "CMU (AMC)", UNREADABLE, str(motion))
            continue
        subject = stem.split("_")[0]
        action = CMU_ACTIONS.get(stem, CMU_ACTIONS.get(subject, ""))
        yield Clip(stem, "CMU (AMC)", CMU_LICENCE, subject, action, CMU_FPS, CMU_AMC.skeleton, motion)


def _repeat(name: str, source: str) -> Dropped:
    return Dropped(name, source, "repeats another", f"the same recording as {REPEATS[name]}")


class _Origin(NamedTuple):
    name: str
    subject: str
    action: str = ""


def _bvh(
    name: str, files: str, weights: Use, licence: str, origin_of: Callable[[str, Bvh], _Origin],
    split: Callable[[Clip], Split],
) -> DataSet:  # fmt: skip
    """A data set of BVH files in an archive or folder."""

    def read(path: Path, progress: Progress) -> Iterator[Clip | Dropped]:
        for file, content in members(path, (".bvh",), progress):
            if PurePosixPath(file).parent.name == NORMALISED:
                yield Dropped(file, name, "of unknown speed", "stretched to 240 frames, whatever it lasted")
                continue
            try:
                bvh, skeleton, positions = bvh_motion(content.decode("ascii", "replace"))
            except MotionError as error:
                yield Dropped(file, name, UNREADABLE, str(error))
                continue
            origin = origin_of(file, bvh)
            if origin.name in REPEATS:
                yield _repeat(origin.name, name)
                continue
            yield Clip(origin.name, name, licence, origin.subject, origin.action, bvh.fps, skeleton, positions)

    return DataSet(name, files, weights, read, split)


def _origin_cmu(name: str, _bvh: Bvh) -> _Origin:
    subject = stem_of(name).split("_")[0][-2:]
    return _Origin(stem_of(name), subject, CMU_ACTIONS.get(subject, ""))


def _origin_cmu_more(name: str, _bvh: Bvh) -> _Origin:
    return _Origin(stem_of(name), stem_of(name).split("_")[0])


def _origin_kind(name: str, _bvh: Bvh) -> _Origin:
    """All takes have the same skeleton. Dancers are not named, but no dancer of one kind is in another."""
    kind = PurePosixPath(name).parent.name
    return _Origin(f"{kind}_{stem_of(name)}", kind, kind)


def _origin_reactidle(name: str, _bvh: Bvh) -> _Origin:
    subject, _, kind = stem_of(name).partition("_")
    return _Origin(stem_of(name), subject, f"idle, {kind}")


def _origin_bandai(name: str, bvh: Bvh) -> _Origin:
    """All takes are retargeted to one body. The position of the hips in the rest pose differs by session."""
    session = " ".join(f"{v:.1f}" for v in bvh.offsets[bvh.joints.index("Hips")])
    return _Origin(stem_of(name), session, " ".join(stem_of(name).split("_")[1:-1]))


def _origin_dancedb(name: str, _bvh: Bvh) -> _Origin:
    stem = stem_of(name).removesuffix("-BVH")
    subject, _, emotion = stem.partition("_")
    return _Origin(stem, subject, emotion.split("_")[0].lower())


def _origin_lafan1(name: str, _bvh: Bvh) -> _Origin:
    action, _, subject = stem_of(name).rpartition("_")
    return _Origin(stem_of(name), subject, action.rstrip("0123456789"))


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


def _read_amass(path: Path, progress: Progress) -> Iterator[Clip | Dropped]:
    for clip in read_own(path, progress):
        known = {"source": "AMASS", "licence": "AMASS: non-commercial"}
        yield replace(clip, **known) if isinstance(clip, Clip) else replace(clip, source=known["source"])


def _read_ui_prmd(path: Path, progress: Progress) -> Iterator[Clip | Dropped]:
    pairs = load_pairs(path, TRAIN_SUBJECTS + VALIDATION_SUBJECTS)
    for i, pair in enumerate(pairs):
        yield Clip(
            pair.name, "UI-PRMD (Vicon)", "PDDL-1.0", pair.subject, pair.movement, pair.fps, CANONICAL, pair.vicon
        )
        progress((i + 1) / len(pairs))


def _validates(*people: str, others: Split = "train") -> Callable[[Clip], Split]:
    return lambda clip: "val" if clip.subject in people else others


def _own_split(clip: Clip) -> Split:
    folders = PurePosixPath(clip.name).parts
    return "val" if "val" in folders else "test" if "test" in folders else "train"


AMASS_VALIDATION = frozenset({"HumanEva", "MPI_HDM05", "HDM05", "SFU", "MPI_mosh", "MoSh"})
"""Folders of the parts on which HM-VAE validates (names in both AMASS releases)."""

DATA_SETS: tuple[DataSet, ...] = (
    # All of subject 02 is in this archive. The unnamed expmap clips may be of subjects 06 and 07: all of these train.
    DataSet("CMU (AMC)", "cmu_amc", "default", _read_cmu_amc, _validates("02")),
    _bvh("CMU (BVH)", "cmu_bvh", "default", CMU_LICENCE, _origin_cmu, _validates()),
    DataSet("CMU (expmap)", "cmu_expmap", "default", _read_cmu_expmap, _validates()),
    _bvh("CMU (more)", "cmu_more", "default", CMU_LICENCE, _origin_cmu_more, _validates()),
    # kinds, and so people; the others are martial arts and Indian dance
    _bvh("CMU (dance)", "cmu_dance", "default", CMU_LICENCE, _origin_kind,
         lambda clip: "train" if clip.subject == "salsa" else "test"),
    _bvh("ReActIdle", "reactidle", "default", "MIT", _origin_reactidle, _validates("013", "014", "015")),
    DataSet("UI-PRMD (Vicon)", "ui_prmd", "default", _read_ui_prmd, _validates(*VALIDATION_SUBJECTS)),
    # one of the second set's three sessions, 807 clips, by the hips of its rest pose
    _bvh("Bandai-Namco", r"bandai_\d", "research", "CC-BY-NC-4.0", _origin_bandai, _validates("-17.2 93.2 453.0")),
    DataSet("AMASS", "amass", "research", _read_amass,
            lambda clip: "train" if AMASS_VALIDATION.isdisjoint(PurePosixPath(clip.name).parts) else "val"),
    _bvh("DanceDB", "dancedb", "measure", "DanceDB: research", _origin_dancedb,
         _validates("Andria", "Elena", others="test")),
    _bvh("LAFAN1", "lafan1", "measure", "CC-BY-NC-ND-4.0", _origin_lafan1, _validates("subject1", others="test")),
    DataSet("own", "own", "default", read_own, _own_split),
)  # fmt: skip
"""All data sets, in the order of preparation. A user's own recordings in a folder ``own`` train the default set."""
