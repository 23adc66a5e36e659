"""Clips of a Kinect beside Vicon (UI-PRMD), and the joints that are scored."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.body.layouts import KINECT22, to_canonical
from steadypose.prior.body.skeleton import JOINTS, MIRROR, J
from steadypose.training.data.ui_prmd import TRAIN_SUBJECTS, VALIDATION_SUBJECTS, KinectPair, load_pairs

SUBJECTS = TRAIN_SUBJECTS + VALIDATION_SUBJECTS

OUT_OF_STEP = ("s01",)
"""Whose Kinect and Vicon do not agree in time, as all others' do: of 12 % of s01's clips the best lag is three frames
or more. What is measured there is the lag; no mean counts them."""

SIDED = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
SCORED = ("head", *(f"{side}_{joint}" for joint in SIDED for side in ("left", "right")))
"""The 13 joints that are scored: those that both systems have and that are points of the body."""
OTHER_SIDE = tuple(SCORED.index(JOINTS[MIRROR[J[name]]]) for name in SCORED)
BONES = tuple(
    (SCORED.index(f"{side}_{a}"), SCORED.index(f"{side}_{b}"))
    for side in ("left", "right")
    for a, b in (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))
)
MARKERS = {
    "head": ("LFHD", "RFHD", "LBHD", "RBHD"),
    **{f"{side}_shoulder": (f"{s}SHO",) for side, s in (("left", "L"), ("right", "R"))},
    **{f"{side}_elbow": (f"{s}ELB",) for side, s in (("left", "L"), ("right", "R"))},
    **{f"{side}_wrist": (f"{s}WRA", f"{s}WRB") for side, s in (("left", "L"), ("right", "R"))},
    **{f"{side}_hip": (f"{s}ASI",) for side, s in (("left", "L"), ("right", "R"))},
    **{f"{side}_knee": (f"{s}KNE",) for side, s in (("left", "L"), ("right", "R"))},
    **{f"{side}_ankle": (f"{s}ANK",) for side, s in (("left", "L"), ("right", "R"))},
}
"""The skin markers nearest to each joint: a second truth, to compare with work that did not find joint centres."""


class Clip(NamedTuple):
    """One repetition of a movement."""

    name: str
    subject: str
    kinect: Floats  # (T, 22, 3) metres, skeleton kinect22, z up
    raw: Floats  # (T, 13, 3) metres, the scored joints of it
    centres: Floats  # (T, 13, 3) metres, the truth
    markers: Floats  # (T, 13, 3) metres, the other truth


def read_clips(path: Path, subjects: Sequence[str], every: int) -> list[Clip]:
    """Every n-th clip of each of these subjects."""
    with np.load(path) as archive:
        marker_names = [str(name) for name in archive["vicon_names"]]
    return [_clip(pair, marker_names) for subject in subjects for pair in load_pairs(path, (subject,))[::every]]


def _clip(pair: KinectPair, marker_names: Sequence[str]) -> Clip:
    scored = [J[name] for name in SCORED]
    markers = [pair.markers[:, [marker_names.index(m) for m in MARKERS[name]]].mean(axis=1) for name in SCORED]
    raw = to_canonical(KINECT22, pair.kinect)[0][:, scored]
    centres, skin = pair.vicon[:, scored], np.stack(markers, axis=1)
    return Clip(pair.name, pair.subject, pair.kinect, raw, centres, skin)


def side_by_side(clips: Sequence[Floats]) -> Floats:
    """(T, C, J, 3) of clips (T, J, 3) of different lengths, NaN after their ends."""
    batch = np.full((max(map(len, clips)), len(clips), *clips[0].shape[1:]), np.nan)
    for number, clip in enumerate(clips):
        batch[: len(clip), number] = clip
    return batch
