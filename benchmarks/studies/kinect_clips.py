"""Clips of a Kinect beside Vicon (UI-PRMD), and scores against Vicon.

An estimate is aligned by one rotation and translation per clip, then by a constant offset per joint in the trunk's
frame. The offset is learned on other people. The rest of it, which differs between persons, is most of the error of a
method that does not know it. So each clip is also scored with its own offset.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata
from sklearn.metrics import roc_auc_score

from steadypose.benchmarks.metrics import acceleration_error, length_variation, position_error, sigma_ratio
from steadypose.benchmarks.scores import interval
from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import rigid_alignment
from steadypose.prior.body.layouts import KINECT22, to_canonical
from steadypose.prior.body.skeleton import JOINTS, MIRROR, J
from steadypose.training.data.recordings import trunk_frame
from steadypose.training.data.ui_prmd import TRAIN_SUBJECTS, VALIDATION_SUBJECTS, load_pairs

SUBJECTS = TRAIN_SUBJECTS + VALIDATION_SUBJECTS

OUT_OF_STEP = ("s01",)
"""People whose Kinect and Vicon are not synchronised. For 12 % of s01's clips the best lag is three frames or more. Its
error measures the lag, so no mean includes it."""

SIDED = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
SCORED = ("head", *(f"{side}_{joint}" for joint in SIDED for side in ("left", "right")))
"""The 13 scored joints: those that both systems have and that are points of the body."""
_CORNERS = [SCORED.index(f"{side}_{part}") for part in ("hip", "shoulder") for side in ("left", "right")]
OTHER_SIDE = tuple(SCORED.index(JOINTS[MIRROR[J[name]]]) for name in SCORED)
BONES = tuple(
    (SCORED.index(f"{side}_{a}"), SCORED.index(f"{side}_{b}"))
    for side in ("left", "right")
    for a, b in (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))
)


class Clip(NamedTuple):
    """One repetition of a movement."""

    name: str
    subject: str
    kinect: Floats  # (T, 22, 3) metres, skeleton kinect22, z up
    raw: Floats  # (T, 13, 3) metres, its scored joints
    centres: Floats  # (T, 13, 3) metres, the truth


def read_clips(path: Path, subjects: Sequence[str], every: int) -> list[Clip]:
    """Read every n-th clip of each of these subjects."""
    scored, clips = [J[name] for name in SCORED], []
    for pair in (pair for subject in subjects for pair in load_pairs(path, (subject,))[::every]):
        raw = to_canonical(KINECT22, pair.kinect)[0][:, scored]
        clips.append(Clip(pair.name, pair.subject, pair.kinect, raw, pair.vicon[:, scored]))
    return clips


OFF = 0.10
"""Error that the predicted standard deviation should indicate, metres."""
WORST = 0.1
"""Share of frames, the worst by mean error, that the anomaly should indicate."""


class Scores(NamedTuple):
    """Scores of a method, one number per clip."""

    position: Floats  # (C,) metres
    moving: Floats  # (C,) metres, with this clip's own offset: the part of the error that changes with the pose
    acceleration: Floats  # (C,) metres/frame²
    variation: Floats  # (C,) of bone lengths, relative


def learn_offset(truths: Sequence[Floats], aligned: Sequence[Floats]) -> Floats:
    """Return the offset (13, 3) in the trunk's frame that moves aligned estimates of each joint to the truth,
    metres."""
    apart = [(t - a) @ trunk_frame(a, _CORNERS) for t, a in zip(truths, aligned, strict=True)]
    return np.nanmean(np.concatenate(apart), axis=0)


def score(truths: Sequence[Floats], aligned: Sequence[Floats], offset: Floats) -> Scores:
    """Score each clip's aligned estimate, moved by the offset."""
    found = []
    for truth, estimate in zip(truths, aligned, strict=True):
        placed, own = move(estimate, offset), move(estimate, learn_offset([truth], [estimate]))
        errors = position_error(placed, truth), position_error(own, truth), acceleration_error(placed, truth)
        found.append((*map(np.nanmean, errors), length_variation(estimate, BONES)))
    return Scores(*np.array(found).T)


def align(truths: Sequence[Floats], estimates: Sequence[Floats]) -> list[Floats]:
    """Rotate and translate each clip's estimate as a whole to be nearest to the truth."""
    aligned = []
    for truth, estimate in zip(truths, estimates, strict=True):
        rotation, translation = rigid_alignment(estimate, truth)
        aligned.append(estimate @ rotation.T + translation)
    return aligned


def move(estimate: Floats, offset: Floats) -> Floats:
    """Add a constant offset (13, 3) in the trunk's frame to an estimate (T, 13, 3)."""
    return estimate + np.einsum("tab,jb->tja", trunk_frame(estimate, _CORNERS), offset)


def quick_score(clips: Sequence[Clip], answers: Sequence[Floats]) -> dict[str, float]:
    """Return errors (mm, mm/frame²) with the offset learned on the same clips, for tuning."""
    truths = [clip.centres for clip in clips]
    aligned = align(truths, answers)
    scores = score(truths, aligned, learn_offset(truths, aligned))
    return {"position_mm": _mm(scores.position), "acceleration_mm": _mm(scores.acceleration)}


def _mm(values: Floats) -> float:
    return round(float(np.mean(values)) * 1000, 3)


def summary(clips: Sequence[Clip], scores: Scores) -> dict[str, Any]:
    """Return a method's figures: mm, mm/frame², per cent, with 95 % intervals over people; and each subject's position.

    Subjects `OUT_OF_STEP` are left out of all means.
    """
    subject = np.array([clip.subject for clip in clips])
    kept = ~np.isin(subject, OUT_OF_STEP)
    found: dict[str, Any] = {"bone_variation_percent": round(float(scores.variation[kept].mean()) * 100, 3)}
    for name in ("position", "moving", "acceleration"):
        values = getattr(scores, name)
        found[f"{name}_mm"] = _mm(values[kept])
        found[f"{name}_ci_mm"] = [round(1e3 * end, 3) for end in interval(values[kept], subject[kept])[1:3]]
    return found | {"people_mm": {str(who): _mm(scores.position[subject == who]) for who in np.unique(subject)}}


def deviation(error: Floats, sigma: Floats, anomaly: Floats, flagged: NDArray[np.bool_]) -> dict[str, float | None]:
    """Measure how well the predicted deviation and the anomaly indicate the error.

    Args:
        error: (N, 13) metres, NaN where Vicon has no joint.
        sigma: (N, 13) metres, predicted.
        anomaly: (N,) score of each frame.
        flagged: (N,) whether a frame is flagged as an anomaly.

    Returns:
        the rank correlation of sigma with the error; areas under the ROC curve of sigma for joints off by more than 10
            cm, and for the worst tenth of the frames by mean error, of the root mean square of sigma over the joints
            and of the anomaly (None if there is no such joint); the error-to-sigma ratio; the share flagged.
    """
    known = np.isfinite(error) & np.isfinite(sigma)
    off = error[known] > OFF
    frames = np.isfinite(anomaly) & known.any(axis=1)
    mean = np.nanmean(error[frames], axis=1)
    worst = mean > np.quantile(mean, 1 - WORST)
    squared = np.where(known, sigma, np.nan)[frames] ** 2
    return {
        "rank_correlation": round(float(np.corrcoef(rankdata(sigma[known]), rankdata(error[known]))[0, 1]), 3),
        "auroc_off": _auroc(off, sigma[known]),
        "off_percent": round(100 * float(off.mean()), 2),
        "auroc_worst": _auroc(worst, np.sqrt(np.nanmean(squared, axis=1))),
        "auroc_worst_anomaly": _auroc(worst, anomaly[frames]),
        "found_by_stated": round(sigma_ratio(error, sigma), 3),
        "flagged_percent": round(100 * float(flagged.mean()), 2),
    }


def _auroc(wrong: NDArray[np.bool_], score: Floats) -> float | None:
    return round(float(roc_auc_score(wrong, score)), 3) if 0 < wrong.sum() < len(wrong) else None
