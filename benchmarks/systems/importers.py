"""Do the importers agree? The same CMU recordings, read from AMC, from exponential maps and from BVH.

Two archives hold twenty recordings twice (`prior.motion.cmu.REPEATS`). AMC and exponential maps should be the
same motion of nearly the same body: a fault in either reader, or in the bones that the latter's converter has lost,
shows in full. The BVH is a hobbyist's retarget onto another character, with legs 15 % longer and other shoulders, so
that positions cannot agree; what a retarget should keep is compared too: the directions of bones, the bends of
elbows and knees, and positions once both bodies have been given the same bone lengths. As a control, the same with
left and right exchanged: readers that mirror a body would agree better there.

Each pair is brought to 30 Hz, shifted in time by up to 0.1 s for the least difference in bone directions, and
aligned by one rotation and one translation.

What PyPI has for BVH, tried on one file of each family:

- bvhio 1.5.4: agrees with our reader to a micrometre; 13 s for a recording of 2.4 minutes, then 1 ms a frame;
- upc-pymotion 0.3.4: reads from disk only; its forward kinematics passes over the position channels of joints other
  than the root (in Bandai-Namco's files the body then stays in one place) and the end sites (ReActIdle's hands);
- bvhTools 1.6.0: cannot read Bandai-Namco's files; passes over position channels too;
- bvh 0.3: parses, but has no forward kinematics.

Hence `prior.motion.bvh`: all 3,057 files, 0.9 s for that same recording.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from scipy.interpolate import CubicSpline

from steadypose.benchmarks.provenance import require_committed
from steadypose.benchmarks.results import RESULTS, Table, save, show
from steadypose.prior.body.kinematics import rigid_alignment
from steadypose.prior.body.layouts import Skeleton, to_canonical
from steadypose.prior.body.skeleton import JOINTS, MIRROR, PARENTS, REST_OFFSETS, J
from steadypose.prior.motion.clip import Y_UP_TO_Z_UP, MotionError
from steadypose.prior.motion.cmu import REPEATS
from steadypose.prior.motion.datasets import CMU_FPS, amc_motions, bvh_motion, members
from steadypose.prior.motion.npz import read_expmap
from steadypose.prior.motion.prepare import FPS, resample
from steadypose.prior.motion.tables import CMU_AMC, CMU_BVH, ICLONE

Floats = NDArray[np.float64]

DEPENDS_ON = ()

MAX_LAG = 0.1
"""Seconds."""

HINGES = tuple(
    (J[f"{side}_{a}"], J[f"{side}_{b}"], J[f"{side}_{c}"])
    for side in ("left", "right")
    for a, b, c in (("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle"))
)
BONE_LENGTHS = np.linalg.norm(REST_OFFSETS, axis=-1)


@dataclass(frozen=True)
class Args:
    """Compare the importers on the CMU recordings that two archives hold."""

    mocap: Path
    """folder with cmu_amc, cmu_expmap and cmu_bvh"""
    results: Path = RESULTS
    """folder for importers.json"""


class Difference(NamedTuple):
    """Of one recording, read in two ways: (T, 22) or (T, 4)."""

    position: Floats
    """cm, aligned"""
    same_bones: Floats
    """cm, both bodies with the rest skeleton's bones, pelvis on pelvis"""
    mirrored: Floats
    """cm, as ``same_bones``, one of the bodies mirrored"""
    direction: Floats
    """degrees between bones that end in a joint"""
    bend: Floats
    """degrees, at elbows and knees"""


def main(args: Args) -> None:
    """Read, compare, print, and write the results."""
    require_committed(args.results)
    motions, families = read(args.mocap)
    groups: dict[str, list[Difference]] = {}
    for other, kept in REPEATS.items():
        group = f"{families[kept]} and {families[other]}"
        groups.setdefault(group, []).append(compare(motions[kept], motions[other]))
    tables = [agreement(groups), joints(groups), bones(motions, families)]
    console = Console()
    for table in tables:
        show(table, console)
    console.print(f"wrote {save('importers', sys.argv[1:], tables, {}, DEPENDS_ON, args.results)}")


def read(mocap: Path) -> tuple[dict[str, Floats], dict[str, str]]:
    """Canonical positions (T, 22, 3) at 30 Hz, z up, and the file format, of every recording that is there twice."""
    wanted = {*REPEATS, *REPEATS.values()}
    motions: dict[str, Floats] = {}
    families: dict[str, str] = {}

    def keep(name: str, family: str, skeleton: Skeleton, positions: Floats, fps: float) -> None:
        if name in wanted:
            motions[name] = resample(to_canonical(skeleton, positions)[0], fps)
            families[name] = family

    for path in sorted(mocap.iterdir()):
        if path.name.startswith("cmu_amc"):
            for name, motion in amc_motions(path, lambda _: None):
                if isinstance(motion, MotionError):
                    raise SystemExit(f"importers: {name}: {motion}")
                keep(Path(name).stem, "AMC", CMU_AMC.skeleton, motion, CMU_FPS)
        elif path.name.startswith("cmu_expmap"):
            with path.open("rb") as file:
                for _, name, fps, motion in read_expmap(file):
                    keep(name, "expmap", CMU_BVH.skeleton, motion @ Y_UP_TO_Z_UP.T, fps)
        elif path.name.startswith("cmu_bvh"):
            for name, content in members(path, (".bvh",), lambda _: None):
                bvh, skeleton, motion = bvh_motion(content.decode("ascii"), ICLONE)
                keep(Path(name).stem, "BVH", skeleton, motion, bvh.fps)
    missing = wanted - motions.keys()
    if missing:
        raise SystemExit(f"importers: expected the three CMU archives in '{mocap}', lacks {', '.join(sorted(missing))}")
    return motions, families


def compare(a: Floats, b: Floats) -> Difference:
    """Two readings (T, 22, 3) of one recording."""
    a, b = align_time(a, b)
    rotation, shift = rigid_alignment(b, a)
    position = np.linalg.norm(b @ rotation.T + shift - a, axis=-1) * 100
    directions_a, directions_b = directions(a), directions(b) @ rotation.T
    mirrored = directions(b)[:, MIRROR] * [1.0, -1.0, 1.0]
    mirrored = mirrored @ rigid_alignment(mirrored, directions_a)[0].T
    cosine = (directions_a * directions_b).sum(-1).clip(-1, 1)
    return Difference(
        position=position,
        same_bones=np.linalg.norm(rebuild(directions_a) - rebuild(directions_b), axis=-1) * 100,
        mirrored=np.linalg.norm(rebuild(directions_a) - rebuild(mirrored), axis=-1) * 100,
        direction=np.degrees(np.arccos(cosine))[:, 1:],
        bend=np.abs(bends(a) - bends(b)),
    )


def align_time(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """Both on the frames of ``a``, ``b`` shifted so that the bends of elbows and knees differ least, and cut alike."""
    spline = CubicSpline(np.arange(len(b)) / FPS, b)
    time = np.arange(len(a)) / FPS
    best: tuple[float, Floats, Floats] | None = None
    for lag in np.arange(-MAX_LAG, MAX_LAG + 1e-9, 1 / 120):
        inside = (time + lag >= 0) & (time + lag <= (len(b) - 1) / FPS)
        shifted = spline(time[inside] + lag)
        error = float(np.abs(_evenly(bends(a[inside])) - _evenly(bends(shifted))).mean())
        if best is None or error < best[0]:
            best = error, a[inside], shifted
    assert best is not None
    return best[1], best[2]


def _evenly(values: Floats) -> Floats:
    """(T, 2) of elbows and knees, left and right together, so that the lag found does not depend on the side."""
    return values.reshape(len(values), 2, 2).mean(axis=1)


def directions(positions: Floats) -> Floats:
    """(T, 22, 3) unit vectors from each joint's parent to it; 0 for the root."""
    bone = positions - positions[:, [max(p, 0) for p in PARENTS]]
    return bone / np.maximum(np.linalg.norm(bone, axis=-1, keepdims=True), 1e-9)


def rebuild(direction: Floats) -> Floats:
    """Positions (T, 22, 3), pelvis at 0, of a body with the rest skeleton's bone lengths."""
    positions = np.zeros_like(direction)
    for joint, parent in enumerate(PARENTS[1:], start=1):
        positions[:, joint] = positions[:, parent] + BONE_LENGTHS[joint] * direction[:, joint]
    return positions


def bends(positions: Floats) -> Floats:
    """(T, 4) degrees by which elbows and knees are bent."""
    upper, middle, lower = (positions[:, list(k)] for k in zip(*HINGES, strict=True))
    a, b = middle - upper, lower - middle
    cosine = (a * b).sum(-1) / np.linalg.norm(a, axis=-1) / np.linalg.norm(b, axis=-1)
    return np.degrees(np.arccos(cosine.clip(-1, 1)))


def agreement(groups: Mapping[str, Sequence[Difference]]) -> Table:
    """The three pairs of formats, all joints and frames pooled."""
    rows = []
    for group, differences in groups.items():
        pooled = [np.concatenate([getattr(d, field).ravel() for d in differences]) for field in Difference._fields]
        rows.append([group, str(len(differences)), *(_spread(values) for values in pooled)])
    return Table(
        name="importers",
        title="CMU recordings read from two formats: median and 95th percentile of the difference",
        columns=["formats", "recordings", "position, cm", "same bones, cm", "mirrored, cm", "direction, °", "bend, °"],
        rows=rows,
        note="The BVH is a hobbyist's retarget onto a body with longer legs, whose paths are longer in proportion. "
        "'Mirrored' is the control, same bones with left and right exchanged: it must be far worse.",
    )


def joints(groups: Mapping[str, Sequence[Difference]]) -> Table:
    """By joint: left and right together."""
    rows = []
    for name in dict.fromkeys(j.split("_")[-1] for j in JOINTS):
        these = [i for i, j in enumerate(JOINTS) if j.split("_")[-1] == name]
        cells = [
            _spread(np.concatenate([getattr(d, field)[:, these].ravel() for d in differences]))
            for differences in groups.values()
            for field in ("position", "same_bones")
        ]
        rows.append([name, *cells])
    return Table(
        name="importers-joints",
        title="The same by joint: cm, median and 95th percentile",
        columns=["joint", *(f"{group}: {what}" for group in groups for what in ("position", "same bones"))],
        rows=rows,
    )


def bones(motions: Mapping[str, Floats], families: Mapping[str, str]) -> Table:
    """Lengths by format, left and right together."""
    lengths = {
        family: np.median(
            np.concatenate([np.linalg.norm(_bones(m), axis=-1) for n, m in motions.items() if families[n] == family]),
            axis=0,
        )
        for family in dict.fromkeys(families.values())
    }
    rows = []
    for name in dict.fromkeys(j.split("_")[-1] for j in JOINTS[1:]):
        these = [i for i, j in enumerate(JOINTS) if j.split("_")[-1] == name]
        cells = [f"{length[these].mean() * 100:.1f}" for length in (*lengths.values(), BONE_LENGTHS)]
        rows.append([f"to {name}", *cells])
    return Table(
        name="importers-bones",
        title="Bone lengths, cm, medians",
        columns=["bone", *lengths, "rest skeleton"],
        rows=rows,
    )


def _bones(positions: Floats) -> Floats:
    return positions - positions[:, [max(p, 0) for p in PARENTS]]


def _spread(values: Floats) -> str:
    median, high = np.percentile(values, (50, 95))
    return f"{median:.2f} / {high:.2f}"


if __name__ == "__main__":
    main(tyro.cli(Args))
