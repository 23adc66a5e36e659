"""UI-PRMD: a Kinect and a Vicon system on the same movements, our only source of real noise with ground truth.

Vakanski et al. 2018, "A data set of human body movements for physical rehabilitation exercises", Data 3(1):2.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.mocap.clip import Y_UP_TO_Z_UP, MotionError
from steadypose.prior.mocap.plug_in_gait import calibrate, joint_centres
from steadypose.prior.npz import open_npz

TRAIN_SUBJECTS = ("s01", "s02", "s03", "s04", "s05", "s06")
VALIDATION_SUBJECTS = ("s07", "s08")

_METRES_PER_COUNT = 1e-4
_MISSING = -32768


@dataclass(frozen=True)
class KinectPair:
    """One repetition of a movement, observed by both systems at the same times.

    They agree in time but not in space: align them with one rotation and translation per clip.
    """

    name: str
    """name in the file, such as ``m01_s01_e01``; with ``_inc``, the movement is deliberately incorrect"""
    subject: str
    """``s01`` to ``s08``"""
    movement: str
    """``m01`` to ``m10``"""
    fps: float
    """frames per second"""
    kinect: NDArray[np.float64]
    """(T, 22, 3) metres, skeleton ``kinect22``. z up, the camera at the origin looking along +y"""
    vicon: NDArray[np.float64]
    """(T, 22, 3) metres, canonical joint centres, z up; NaN where markers were lost"""


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
