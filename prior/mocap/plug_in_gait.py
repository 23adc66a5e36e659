"""Joint centres from the skin markers of Vicon's Plug-in-Gait set.

Markers lie on the skin, half a joint's width from the joint's centre. The centres follow published methods:

- hips: regression on the pelvis' width and depth (Harrington et al. 2007, J. Biomech. 40:595, the simple
  equations, without the leg's length);
- knees and elbows: the chord function of Davis et al. 1991 (Hum. Mov. Sci. 10:575) that Plug-in-Gait uses,
  half a joint's width inwards from the lateral marker. Plug-in-Gait takes the lateral direction from a wand
  marker, whose placement is wrong by up to 50 degrees in these recordings. Here, the direction is turned about
  the limb to agree with the axis about which the joint bends, once for each subject (functional axes, after
  Schwartz & Rozumalski 2005, J. Biomech. 38:107);
- ankles: half a joint's width inwards from the malleolus, square to shank and foot;
- shoulders: 17 % of the distance between the acromia below the acromion (Rab et al. 2002, Gait & Posture
  15:113);
- wrists: half way between the wrist's two markers.

The joints of trunk and head are not anatomical points but defined by the canonical skeleton. They are weighted means of
the markers around them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.body.skeleton import JOINTS

MARKER_RADIUS = 0.007  # distance from the skin to a marker's centre, metres (14 mm markers)

KNEE_WIDTH, ANKLE_WIDTH, ELBOW_WIDTH = 0.105, 0.072, 0.072
"""Widths of joints, adult means, metres. Plug-in-Gait expects measured widths, which the recordings lack."""

TOE_DEPTH = 0.02
"""Distance from the toe marker down to the forefoot's joint, metres (marker radius and half the foot's thickness)."""

BAND_TO_EARS = 0.08  # distance from the band with the head's markers down to the height of the ears, metres

MAX_PELVIS_WIDTH, MAX_PELVIS_DEPTH = 0.30, 0.22
"""Largest width and depth of the pelvis in the regression, metres. Soft tissue displaces the front markers of heavy
subjects outwards and forwards (46 by 27 cm for one subject); the regression, fitted to lean subjects, would then place
the hips 32 cm apart."""

MIN_BEND = 0.3  # sine of the bend below which a limb is too straight to show its axis of bending

MIN_BEND_WEIGHT = 20.0
"""Least sum of sin(bend) over frames for a subject's functional axis; with less, the wand's direction is used."""

_SIDED = ("FHD", "BHD", "SHO", "UPA", "ELB", "WRA", "WRB", "ASI", "PSI", "THI", "KNE", "TIB", "ANK", "HEE", "TOE")
MARKERS = ("C7", "T10", "CLAV", "STRN", *(side + name for side in "LR" for name in _SIDED))
"""Markers of the set that joints are computed from."""

Markers = Mapping[str, NDArray[np.float64]]
Array = NDArray[np.float64]


@dataclass(frozen=True)
class _Hinge:
    """A limb whose middle joint has a lateral marker and, on its upper segment, a wand."""

    marker: str
    wand: str
    width: float


_SIDES = (("left", "L"), ("right", "R"))

_HINGES: Mapping[str, _Hinge] = {
    f"{side}_{joint}": _Hinge(s + marker, s + wand, width)
    for side, s in _SIDES
    for joint, marker, wand, width in (("knee", "KNE", "THI", KNEE_WIDTH), ("elbow", "ELB", "UPA", ELBOW_WIDTH))
}


@dataclass(frozen=True)
class Calibration:
    """Measurements of a subject."""

    pelvis_width: float  # metres between the front markers of the pelvis
    pelvis_depth: float  # metres from their midpoint to the midpoint of the back markers
    acromia: float  # metres between the shoulder markers
    axis: Mapping[str, float]
    """for each knee and elbow, the angle about the upper limb from its wand to the axis of bending, radians"""


def _unit(v: Array) -> Array:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def _reject(v: Array, along: Array) -> Array:
    """Unit vector of the component of ``v`` perpendicular to the unit vector ``along``."""
    return _unit(v - (v * along).sum(-1, keepdims=True) * along)


def _mean(m: Markers, names: Sequence[str]) -> Array:
    return np.mean([m[n] for n in names], axis=0)


def _pelvis(m: Markers) -> tuple[Array, Array, Array, Array]:
    """Mid-point of the back markers, and the pelvis' unit axes forward, left, up; (T, 3) each."""
    back = _mean(m, ("LPSI", "RPSI"))
    left = _unit(m["LASI"] - m["RASI"])
    forward = _reject(_mean(m, ("LASI", "RASI")) - back, left)
    return back, forward, left, np.cross(forward, left)


def _hips(m: Markers, c: Calibration) -> tuple[Array, Array, Array]:
    """Left hip, right hip, and the pelvis: between the hips, raised to the height of the pelvis' markers."""
    back, forward, left, up = _pelvis(m)
    width, depth = min(c.pelvis_width, MAX_PELVIS_WIDTH), min(c.pelvis_depth, MAX_PELVIS_DEPTH)
    front = back + depth * forward
    middle = front - (0.24 * depth + 0.0099) * forward - (0.30 * width + 0.0109) * up
    aside = (0.33 * width + 0.0073) * left
    return middle + aside, middle - aside, middle + 0.30 * width * up


def _shoulders(m: Markers, c: Calibration) -> tuple[Array, Array]:
    up = _unit(_mean(m, ("C7", "CLAV")) - _mean(m, ("T10", "STRN")))
    drop = 0.17 * c.acromia * up
    return m["LSHO"] - drop, m["RSHO"] - drop


def _limb_axes(upper: Array, m: Markers, hinge: _Hinge) -> tuple[Array, Array, Array]:
    """Unit vectors along the upper limb (towards the trunk), towards its wand, and square to both."""
    along = _unit(upper - m[hinge.marker])
    wand = _reject(m[hinge.wand] - m[hinge.marker], along)
    return along, wand, np.cross(along, wand)


def _chord(upper: Array, marker: Array, along: Array, lateral: Array, offset: float) -> Array:
    """Joint at ``offset`` from its marker, away from ``lateral``, with 90 degrees between marker and upper joint."""
    cos = offset / np.linalg.norm(upper - marker, axis=-1, keepdims=True)
    return marker + offset * (cos * along - np.sqrt(1 - cos**2) * lateral)


def _hinge_joint(upper: Array, m: Markers, hinge: _Hinge, axis: float) -> Array:
    along, wand, third = _limb_axes(upper, m, hinge)
    lateral = np.cos(axis) * wand + np.sin(axis) * third
    return _chord(upper, m[hinge.marker], along, lateral, hinge.width / 2 + MARKER_RADIUS)


def _ankle(knee: Array, m: Markers, s: str) -> tuple[Array, Array]:
    """The ankle of side ``L`` or ``R``, and the unit vector of the foot that points to its sole."""
    shank = _unit(knee - m[s + "ANK"])
    forward = _unit(m[s + "TOE"] - m[s + "HEE"])
    lateral = (1.0 if s == "L" else -1.0) * _unit(np.cross(shank, forward))
    return _chord(knee, m[s + "ANK"], shank, lateral, ANKLE_WIDTH / 2 + MARKER_RADIUS), -_reject(shank, forward)


def _below(joint: str, place: Array, m: Markers) -> Array:
    """The ankle of a knee, the wrist of an elbow."""
    s = "L" if joint.startswith("left") else "R"
    return _ankle(place, m, s)[0] if joint.endswith("knee") else _mean(m, (s + "WRA", s + "WRB"))


def calibrate(recordings: Iterable[Markers]) -> Calibration:
    """Measure a subject on all of its recordings, of markers (T, 3) metres by name, z up, NaN where lost. The more the
    subject moves, the better the axes."""
    recordings = list(recordings)
    joined = {name: np.concatenate([r[name] for r in recordings]) for name in recordings[0]}
    back, forward, _, _ = _pelvis(joined)
    front = _mean(joined, ("LASI", "RASI"))
    measured = Calibration(
        pelvis_width=float(np.nanmedian(np.linalg.norm(joined["LASI"] - joined["RASI"], axis=-1))),
        pelvis_depth=float(np.nanmedian(((front - back) * forward).sum(-1))),
        acromia=float(np.nanmedian(np.linalg.norm(joined["LSHO"] - joined["RSHO"], axis=-1))),
        axis={},
    )
    left_hip, right_hip, _ = _hips(joined, measured)
    left_shoulder, right_shoulder = _shoulders(joined, measured)
    upper = {"left_knee": left_hip, "right_knee": right_hip, "left_elbow": left_shoulder, "right_elbow": right_shoulder}
    return replace(measured, axis={joint: _bend_axis(joint, upper[joint], joined) for joint in _HINGES})


def _bend_axis(joint: str, upper: Array, m: Markers) -> float:
    """Angle from the wand to the axis of bending, radians: the mean over frames, with the axis normal to the bent limb.

    The joint's centre and the limb's plane depend on the axis, so the estimate is iterated a few times.
    """
    hinge = _HINGES[joint]
    _, wand, third = _limb_axes(upper, m, hinge)
    angle = 0.0
    for _ in range(4):
        place = _hinge_joint(upper, m, hinge, angle)
        # its length is the sine of the bend, so the mean weights frames by how well they show the axis
        normal = np.cross(_unit(upper - place), _unit(_below(joint, place, m) - place))
        x, y = (normal * wand).sum(-1), (normal * third).sum(-1)
        bent = np.hypot(x, y) > MIN_BEND
        # of the normal's two directions, take the one on the wand's side
        sign = np.where(x < 0, -1.0, 1.0)[bent]
        x, y = (x[bent] * sign).sum(), (y[bent] * sign).sum()
        if np.hypot(x, y) < MIN_BEND_WEIGHT:
            return 0.0
        angle = float(np.arctan2(y, x))
    return angle


def joint_centres(m: Markers, calibration: Calibration) -> NDArray[np.float64]:
    """Canonical joints (T, 22, 3) metres from a subject's markers (T, 3) metres by name, z up, NaN where lost; NaN
    where a marker that the joint needs is lost."""
    p: dict[str, Array] = {}
    p["left_hip"], p["right_hip"], p["pelvis"] = _hips(m, calibration)
    p["left_shoulder"], p["right_shoulder"] = _shoulders(m, calibration)
    for joint, hinge in _HINGES.items():
        upper = p[joint.replace("knee", "hip").replace("elbow", "shoulder")]
        p[joint] = _hinge_joint(upper, m, hinge, calibration.axis[joint])
    for side, s in _SIDES:
        p[f"{side}_ankle"], sole = _ankle(p[f"{side}_knee"], m, s)
        p[f"{side}_foot"] = m[s + "TOE"] + TOE_DEPTH * sole
        p[f"{side}_wrist"] = _mean(m, (s + "WRA", s + "WRB"))
    band = _mean(m, ("LFHD", "RFHD", "LBHD", "RBHD"))
    facing = _mean(m, ("LFHD", "RFHD")) - _mean(m, ("LBHD", "RBHD"))
    up = _unit(np.cross(facing, _mean(m, ("LFHD", "LBHD")) - _mean(m, ("RFHD", "RBHD"))))
    p["head"] = band - BAND_TO_EARS * up
    p["neck"] = 0.7 * m["C7"] + 0.3 * m["CLAV"]
    p["spine3"] = 0.7 * m["T10"] + 0.3 * m["STRN"]
    # proportions of the rest skeleton, because no marker shows spine and collars
    p["spine1"] = p["pelvis"] + 0.37 * (p["spine3"] - p["pelvis"])
    p["spine2"] = p["pelvis"] + 0.80 * (p["spine3"] - p["pelvis"])
    for side, _ in _SIDES:
        p[f"{side}_collar"] = 0.33 * p["spine3"] + 0.28 * p["neck"] + 0.39 * p[f"{side}_shoulder"]
    return np.stack([p[name] for name in JOINTS], axis=-2)
