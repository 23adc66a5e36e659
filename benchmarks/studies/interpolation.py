"""Motion between two ends (HM-VAE, table 2): gaps of 5 to 45 frames, with 10 known frames before and one after.

The protocol and figures are LAFAN1's (Harvey et al. 2020): L2Q of global rotations, L2P of global joints normalised by
each joint's deviation in training, and NPSS. Our motion and skeleton differ from LAFAN1's protocol, so only ratios to
slerp and lerp are comparable with its figures. On a few clips, HM-VAE's latents are also searched, as in the paper's
section 4.
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.benchmarks.baselines import inbetween
from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.motion import MotionClips, as_set, prepared_set
from steadypose.benchmarks.provenance import COMPLETE
from steadypose.benchmarks.results import Result, Table
from steadypose.benchmarks.scores import contact_speed, npss, quaternion_distance
from steadypose.benchmarks.studies.interpolation_noise import in_noise
from steadypose.prior.arrays import Floats
from steadypose.prior.body.inverse_kinematics import place_joints
from steadypose.prior.body.kinematics import (
    CONTACT_JOINTS,
    global_rotations,
    heading,
    quaternions,
    rotation_matrices,
    yaw_matrix,
)
from steadypose.prior.body.skeleton import JOINTS
from steadypose.prior.complete.body import Fill, complete
from steadypose.prior.complete.parts import PartsCompleter
from steadypose.prior.fit.optimise import Optimiser
from steadypose.prior.models.completer import LiveCompleter
from steadypose.prior.models.completer_features import solved_rotations
from steadypose.training.data.dataset import MotionSet

DEPENDS_ON = (COMPLETE, "completer weights", "hmvae64 weights", "prior.fit.optimise")

GAPS = (5, 15, 30, 45)
BEFORE, AFTER = 10, 1
SEARCHED = 8  # number of clips on which HM-VAE is searched, which takes seconds for each
FRAMES = BEFORE + max(GAPS) + AFTER

JOINTS_GIVEN = "cubic spline, joints given"
"""Row of the spline through rotations solved from joints, which are all that the completer is given."""

_FEET = [k for k, joint in enumerate(CONTACT_JOINTS) if JOINTS[joint].endswith(("ankle", "foot"))]
_FOOT_JOINTS = [CONTACT_JOINTS[k] for k in _FEET]


class Truth(NamedTuple):
    """C clips of T frames, with the gap to be filled."""

    positions: Floats  # (C, T, 22, 3) metres
    rotations: Floats  # (C, T, 22, 3, 3) local
    offsets: Floats  # (C, 22, 3) metres, bones
    contacts: NDArray[np.bool_]  # (C, T, 8) labels of `CONTACT_JOINTS`
    gap: slice  # frames of the gap

    @classmethod
    def of(cls, clips: MotionClips, gap: int) -> Truth:
        """Take the first frames of clips, with joints placed by forward kinematics."""
        rows = slice(0, BEFORE + gap + AFTER)
        rotations = clips.rotations[rows].swapaxes(0, 1)
        joints = place_joints(rotations, clips.offsets[:, None]) + clips.positions[rows].swapaxes(0, 1)[:, :, :1]
        contacts = clips.contacts[rows].swapaxes(0, 1)
        return cls(joints, rotations, clips.offsets, contacts, slice(BEFORE, BEFORE + gap))

    def some(self, count: int) -> Truth:
        """Return ``count`` of the clips, spread evenly."""
        clips = np.unique(np.linspace(0, len(self.offsets) - 1, count).round().astype(int))
        return Truth(self.positions[clips], self.rotations[clips], self.offsets[clips], self.contacts[clips], self.gap)

    @property
    def given(self) -> Floats:
        """Joints (C, T, 22, 3) metres, NaN in the gap."""
        given = self.positions.copy()
        given[:, self.gap] = np.nan
        return given


def run(bench: Bench) -> Result:
    clips = bench.clips(FRAMES, 96)
    train = prepared_set(bench.data, "train") if bench.data.is_file() else as_set(bench.training_clips())
    deviation = place_deviation(train)
    completer = LiveCompleter.load("default")
    methods: dict[str, inbetween.InBetween] = {
        "zero velocity": inbetween.zero_velocity,
        "slerp and lerp": inbetween.slerp_and_lerp,
        "cubic spline": inbetween.cubic_spline,
        "nearest training window": inbetween.NearestWindow(train),
        "slerp and lerp, joints given": from_joints(inbetween.slerp_and_lerp, completer),
        JOINTS_GIVEN: from_joints(inbetween.cubic_spline, completer),
        "completer": lambda positions, rotations, offsets: completer(positions, offsets),
        "complete": by_command(completer),
    }
    records: list[dict[str, Any]] = []
    for gap in bench.progress.track(GAPS, description="interpolation"):
        truth = Truth.of(clips, gap)
        records.append(
            {"method": "truth", "gap": gap, **measure(truth, truth.rotations, truth.positions[:, :, 0], deviation)}
        )
        for name, method in methods.items():
            rotations, root = method(truth.given, truth.rotations, truth.offsets)
            records.append({"method": name, "gap": gap, **measure(truth, rotations, root, deviation)})
    relate(records)
    searches = search(bench, clips, completer, deviation)
    noisy, noisy_table = in_noise(bench, PartsCompleter(completer))
    source = {**clips.source, "gaps": GAPS, "known before and after": (BEFORE, AFTER)}
    return Result(
        [_table(records, len(clips.offsets)), _search_table(searches), noisy_table],
        {"data": source, "records": records, "searches": searches, "noisy": noisy},
    )


def from_joints(method: inbetween.InBetween, completer: LiveCompleter) -> inbetween.InBetween:
    """Return the method on rotations solved from the joints, as the completer solves them."""
    usual = rotation_matrices(completer.usual)

    def fill(positions: Floats, rotations: Floats, offsets: Floats) -> tuple[Floats, Floats]:
        solved = solved_rotations(positions, np.broadcast_to(offsets[:, None], positions.shape), usual)[0]
        return method(positions, solved, offsets)

    return fill


def by_command(completer: LiveCompleter) -> inbetween.InBetween:
    """Return what `steadypose complete` makes of each clip: the completer and splines of joints."""
    parts = PartsCompleter(completer)

    def fill(positions: Floats, rotations: Floats, offsets: Floats) -> tuple[Floats, Floats]:
        done = [complete(parts, *clip) for clip in zip(positions, offsets, strict=True)]
        return np.stack([each.rotations for each in done]), np.stack([each.positions[:, 0] for each in done])

    return fill


def place_deviation(train: MotionSet, windows: int = 4000) -> Floats:
    """Return the standard deviations (22, 3) of joints over training windows, in the root's frame before a gap,
    metres."""
    rows = train.all_windows(FRAMES, 7)
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, windows).round().astype(int))]
    joints = train.positions[rows].double().numpy()
    turn = yaw_matrix(heading(train.rotations[rows[:, BEFORE - 1], 0].double().numpy()))
    origin = joints[:, BEFORE - 1, None, :1] * [1.0, 1.0, 0.0]
    return ((joints - origin) @ turn[:, None]).std(axis=(0, 1))


def measure(truth: Truth, rotations: Floats, root: Floats, deviation: Floats) -> dict[str, Any]:
    """Return the figures of an estimate in the gap, of local rotations (C, T, 22, 3, 3) and root (C, T, 3) metres;
    accelerations include the gap's ends. L2P is normalised by ``deviation`` (22, 3) of `place_deviation`.
    """
    joints = place_joints(rotations, truth.offsets[:, None]) + root[:, :, None]
    gap = truth.gap
    around = slice(gap.start - 2, gap.stop + AFTER)
    turned = [quaternions(global_rotations(np.asarray(r[:, gap]))) for r in (rotations, truth.rotations)]
    l2q = np.stack([quaternion_distance(a, b) for a, b in zip(*turned, strict=True)]).mean(axis=1)
    turn = yaw_matrix(heading(truth.rotations[:, gap.start - 1, 0]))[:, None]
    off = joints - truth.positions
    l2p = np.sqrt(((off[:, gap] @ turn / deviation) ** 2).sum(axis=(-1, -2))).mean(axis=1)
    sign = np.where((turned[0] * turned[1]).sum(axis=-1, keepdims=True) < 0, -1.0, 1.0)
    shape = (len(root), gap.stop - gap.start, -1)
    error, local = (np.linalg.norm(x[:, gap], axis=-1) for x in (off, off - off[:, :, :1]))
    bend, missed = (np.linalg.norm(np.diff(x[:, around], n=2, axis=1), axis=-1) for x in (joints, off))
    stamps = np.arange(gap.stop - gap.start + 2) / 30.0
    edges = slice(gap.start - 1, gap.stop + 1)
    skate = [
        contact_speed(x[edges][:, _FOOT_JOINTS], c[edges][:, _FEET], stamps)
        for x, c in zip(joints, truth.contacts, strict=True)
    ]
    return {
        "l2q": round(float(l2q.mean()), 4),
        "l2p": round(float(l2p.mean()), 4),
        "npss": round(npss((sign * turned[0]).reshape(shape), turned[1].reshape(shape)), 4),
        "position_mm": round(float(error.mean()) * 1e3, 2),
        "local_mm": round(float(local.mean()) * 1e3, 2),
        "own_acceleration_mm": round(float(bend.mean()) * 1e3, 3),
        "acceleration_mm": round(float(missed.mean()) * 1e3, 3),
        "skate_m_s": round(float(np.nanmean(np.stack(skate))), 4),
        "clips": len(root),
    }


def relate(records: list[dict[str, Any]]) -> None:
    """Add to each record the ratios of its errors to slerp's and lerp's, and of its acceleration to the truth's."""
    for record in records:
        line, true = (
            next(r for r in records if r["gap"] == record["gap"] and r["method"] == name)
            for name in ("slerp and lerp", "truth")
        )
        for key in ("l2q", "l2p"):
            record[f"{key}_of_line"] = round(record[key] / line[key], 3)
        record["acceleration_of_true"] = round(record["own_acceleration_mm"] / true["own_acceleration_mm"], 3)


def search(bench: Bench, clips: MotionClips, completer: LiveCompleter, deviation: Floats) -> list[dict[str, Any]]:
    """Run section 4's search on `SEARCHED` clips, from the completer's output and from random latents, beside its
    start."""
    parts = PartsCompleter(completer)
    fills: dict[str, Fill] = {
        "completer": completer,
        "HM-VAE searched from there": Optimiser.load("default", parts),
        "HM-VAE searched from random latents": Optimiser.load("default", parts, seed=0),
    }
    records: list[dict[str, Any]] = []
    for gap in bench.progress.track(GAPS[-1:] if bench.quick else GAPS, description="search"):
        truth = Truth.of(clips, gap).some(1 if bench.quick else SEARCHED)
        line = inbetween.slerp_and_lerp(truth.given, truth.rotations, truth.offsets)
        for name, poses in (("truth", (truth.rotations, truth.positions[:, :, 0])), ("slerp and lerp", line)):
            records.append({"method": name, "gap": gap, **measure(truth, *poses, deviation)})
        for name, fill in fills.items():
            began = time.process_time()
            answer = fill(truth.given, truth.offsets)
            seconds = (time.process_time() - began) / len(truth.offsets)
            records.append(
                {"method": name, "gap": gap, **measure(truth, *answer, deviation), "seconds": round(seconds, 2)}
            )
    relate(records)
    return records


def _table(records: list[dict[str, Any]], clips: int) -> Table:
    return Table.of(
        "interpolation", "Motion in gaps, 10 frames known before and one after (HM-VAE, table 2)",
        sorted(records, key=lambda r: r["gap"]),
        {"method": "{method}", "gap, frames": "{gap}", "L2Q": "{l2q:.3f}", "of slerp's": "{l2q_of_line:.2f}",
         "L2P": "{l2p:.3f}", "of lerp's": "{l2p_of_line:.2f}", "NPSS": "{npss:.3f}", "MPJPE, mm": "{position_mm:.1f}",
         "about the root, mm": "{local_mm:.1f}", "acceleration, of the true": "{acceleration_of_true:.2f}",
         "its error, mm/frame²": "{acceleration_mm:.2f}", "feet that stand, m/s": "{skate_m_s:.3f}"},
        f"{clips} clips, spread evenly over the sources. Baselines have the rotations of the file; where joints "
        "are given, those solved from them, as the completer. On LAFAN1, which is another skeleton and motion, "
        "the two-stage transformer of Qin et al. 2022 has 0.45, 0.46, 0.56, 0.70 of slerp's L2Q at 5, 15, 30 and "
        "45 frames, and 0.28, 0.32, 0.39 and 0.49 of lerp's L2P; HM-VAE 1.09, 0.87, 0.96 and 1.00 of slerp's.",
    )  # fmt: skip


def _search_table(records: list[dict[str, Any]]) -> Table:
    rows = [r for r in sorted(records, key=lambda r: r["gap"]) if r["method"] != "truth"]
    return Table.of(
        "interpolation-search",
        "HM-VAE of 64 frames searched for a motion that meets what is known (HM-VAE, section 4)",
        [{**r, "spent": f"{r['seconds']:.2f}" if "seconds" in r else ""} for r in rows],
        {"method": "{method}", "gap, frames": "{gap}", "L2Q": "{l2q:.3f}", "of slerp's": "{l2q_of_line:.2f}",
         "MPJPE, mm": "{position_mm:.1f}", "about the root, mm": "{local_mm:.1f}",
         "acceleration, of the true": "{acceleration_of_true:.2f}", "s a clip": "{spent}"},
        f"{rows[0]['clips']} of the clips; equation 14 over the latents, then equation 15 over the decoder too.",
    )  # fmt: skip
