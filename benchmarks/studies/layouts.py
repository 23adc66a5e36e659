"""Sensors' joint layouts: joints that a sensor lacks, and what is made of them, in 2 cm of noise.

Other studies give all canonical joints. Here a layout's joints are placed on true bodies as in the simulator
(`prior.body.capsules.mount`), with all of them seen or, as behind a counter, without hips and legs. The baseline
smooths what is given by the whole-body bank and takes the other joints from one Gaussian over training poses.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from steadypose.benchmarks.baselines.body import ConditionalGaussian
from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.motion import MotionClips
from steadypose.benchmarks.product import run as clean
from steadypose.benchmarks.provenance import CLEAN
from steadypose.benchmarks.results import Result, Table
from steadypose.benchmarks.scores import acceleration_error, position_error, sigma_ratio
from steadypose.benchmarks.studies.hidden_joints import given_the_seen
from steadypose.prior.arrays import Floats
from steadypose.prior.body.capsules import mount, stature
from steadypose.prior.body.kinematics import global_rotations
from steadypose.prior.body.layouts import SKELETONS, to_canonical
from steadypose.prior.body.skeleton import REST_OFFSETS, J, limbs
from steadypose.prior.clean.settings import PriorSettings

DEPENDS_ON = CLEAN

LAYOUTS = ("smpl22", "kinect22", "blazepose33", "coco17")
NOISE = 0.02  # standard deviation of the noise along an axis, metres
DELAY = PriorSettings().delay
SETTLED = 30  # number of frames at the start that are not scored

_LOWER = [J["pelvis"], *np.ravel(limbs(("hip", "knee", "ankle", "foot")))]
GROUPS = {
    "all": list(range(22)),
    "pelvis": [J["pelvis"]],
    "spine": [J["spine1"], J["spine2"], J["spine3"]],
    "neck, collars": [J["neck"], J["left_collar"], J["right_collar"]],
}
"""Joints that are scored together."""


def sensed(clips: MotionClips, layout: str, rng: np.random.Generator, *, counter: bool) -> Floats:
    """Return a layout's joints (T, C, J, 3) with noise; NaN for those on hips and legs behind a counter."""
    on_body, orientations = mount(layout), global_rotations(clips.rotations)
    scales = [stature(offsets) / stature(REST_OFFSETS) for offsets in clips.offsets]
    joints = np.stack(
        [on_body.positions(clips.positions[:, c], orientations[:, c], scale) for c, scale in enumerate(scales)], axis=1
    )
    joints += rng.normal(0.0, NOISE, joints.shape)
    joints[:, :, np.isin(on_body.joint, _LOWER) & counter] = np.nan
    return joints


def run(bench: Bench) -> Result:
    clips = bench.clips()
    gaussian = ConditionalGaussian(bench.training_clips().positions.reshape(-1, 22, 3))
    records: list[dict[str, Any]] = []
    for number, layout in enumerate(LAYOUTS):
        for counter in (False, True):
            joints = sensed(clips, layout, np.random.default_rng((number, counter)), counter=counter)
            head = {"layout": layout, "case": "no hips or legs" if counter else "all observed"}
            seen, _ = to_canonical(SKELETONS[layout], joints)
            if not counter:  # without hips, a Gaussian about the root has no answer
                filtered = given_the_seen(seen, clips.stamps_s, DELAY, gaussian)
                records.append({**head, "method": "bank and Gaussian", **_score(filtered, None, clips)})
            cleaned = clean(PriorSettings(), joints, clips.stamps_s, DELAY, layout)
            records.append({**head, "method": "steadypose", **_score(cleaned.positions, cleaned.sigma, clips)})
    note = (
        f"{clips.positions.shape[1]} clips of {len(clips.positions)} frames, {NOISE * 100:g} cm of independent noise, "
        f"delay {DELAY}, without the first second. Ratio: the error of all joints by the stated deviation. Bank and "
        "Gaussian: the whole-body bank, and the mean of the joints that the layout lacks given the others."
    )
    return Result([_table(records, note)], {"records": records, "data": clips.source})


def _score(answer: Floats, sigma: Floats | None, clips: MotionClips) -> dict[str, float]:
    found, truth = answer[SETTLED:], clips.positions[SETTLED:]
    error = position_error(found, truth)
    figures = {name: 1e3 * float(np.nanmean(error[..., joints])) for name, joints in GROUPS.items()}
    figures["acceleration"] = 1e3 * float(np.nanmean(acceleration_error(found, truth)))
    return figures | ({} if sigma is None else {"ratio": sigma_ratio(error, sigma[SETTLED:])})


def _table(records: list[dict[str, Any]], note: str) -> Table:
    columns = [*GROUPS, "acceleration", "ratio"]
    rows = [
        [f"{r['layout']}, {r['case']}: {r['method']}",
         *("–" if key not in r else f"{r[key]:.{2 if key == 'ratio' else 1}f}" for key in columns)]
        for r in records
    ]  # fmt: skip
    headers = ["layout: method", *(f"{name}, mm" for name in GROUPS), "acceleration, mm/frame²", "ratio"]
    return Table("layouts", "Sensors' layouts: position error, mm", headers, rows, note)
