"""Contacts against force plates: OpenCap's validation subjects, who walk, jump and squat.

The joints are skin markers of ankle and toe, at 100 frames a second, split into three streams of 30 Hz; the network
receives no other joints. A foot bears load where its plate measures more than 30 N. Noise is independent between frames
(HuMoR's 4 cm) and passes through the smoother that ships. Nothing was trained on these recordings. But the rule that
labels load, on which the network was trained with other people, takes its 0.7 m/s from them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.provenance import WORLD_22
from steadypose.benchmarks.results import Result, Table
from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.kinematics import CONTACT_JOINTS, LOAD_SPEED, REST_HEIGHT, REST_SPEED, label_contacts
from steadypose.prior.body.skeleton import J, finite_joints
from steadypose.prior.models.contacts import LiveContacts, contact_features
from steadypose.prior.models.mixture.inference import MixtureSmoother
from steadypose.prior.timing.rate import FPS

DEPENDS_ON = WORLD_22

LOADED_N = 30.0  # force above which a foot bears load, newtons
PHASES = 3  # number of 30 Hz streams from one recording
NOISES = (0.0, 0.02, 0.04)  # standard deviations of the noise, metres
DELAY = 4
KINDS: Mapping[str, Callable[[str], bool]] = {
    "walking": lambda trial: trial.startswith("walking"),
    "drop jumps": lambda trial: trial.startswith("DJ"),
    "squats, chair": lambda trial: not trial.startswith(("walking", "DJ")),
}
_MARKERS = [("left_ankle", "left_ankle"), ("left_toe", "left_foot"), ("right_ankle", "right_ankle"),
            ("right_toe", "right_foot")]  # fmt: skip
_SIDES = [[CONTACT_JOINTS.index(J[f"{side}_{part}"]) for part in ("ankle", "foot")] for side in ("left", "right")]
_HEIGHT = {joint: float(REST_HEIGHT[CONTACT_JOINTS.index(J[joint])]) for _, joint in _MARKERS}


class Trial(NamedTuple):
    """One stream of 30 Hz."""

    kind: str  # one of `KINDS`
    joints: Floats  # (T, 22, 3) metres, floor at 0; NaN except for ankles and toes
    loaded: Bools  # (T, 2) whether the left and the right foot bear load
    valid: Bools  # (T, 2) where the plates measure


def read_trials(path: Path) -> list[Trial]:
    """Read all streams. Heights of markers are relative to where each subject's markers usually are at their lowest."""
    trials = []
    with np.load(path) as data:
        names, fps = [str(name) for name in data["names"]], float(data["fps"])
        keys = sorted({key.rsplit("/", 1)[0] for key in data.files if key.count("/") == 2})
        feet = {key: data[f"{key}/feet"].astype(np.float64) for key in keys}
        for subject in sorted({key.split("/")[0] for key in keys}):
            own = [key for key in keys if key.split("/")[0] == subject]
            lowest = np.nanpercentile(np.concatenate([feet[key][..., 2] for key in own]), 10, axis=0)
            for key in own:
                kind = next(kind for kind, belongs in KINDS.items() if belongs(key.split("/")[1]))
                count = len(feet[key])
                for phase in range(PHASES):
                    times = phase + np.arange(int((count - 1 - phase) * FPS / fps), dtype=np.float64) * (fps / FPS)
                    rows = np.round(times).astype(int)
                    joints = np.full((len(times), 22, 3), np.nan)
                    for marker, joint in _MARKERS:
                        k = names.index(marker)
                        joints[:, J[joint]] = _at(feet[key][:, k], times)
                        joints[:, J[joint], 2] += _HEIGHT[joint] - lowest[k]
                    loaded = np.asarray(data[f"{key}/force"])[rows] > LOADED_N
                    seen = np.asarray(finite_joints(joints[:, [J[joint] for _, joint in _MARKERS]]).all(axis=1))
                    trials.append(Trial(kind, joints, loaded, data[f"{key}/valid"][rows] & seen[:, None]))
    return trials


def _at(places: Floats, times: Floats) -> Floats:
    rows = np.arange(len(places))
    return np.stack([np.interp(times, rows, places[:, axis]) for axis in range(3)], axis=-1)


def run(bench: Bench) -> Result:
    assert bench.mocap is not None
    trials = read_trials(bench.mocap / "contacts_grf.npz")[:: 10 if bench.quick else 1]
    network = LiveContacts.load("default")
    records = []
    for noise in bench.progress.track(NOISES, description="contacts"):
        counts: dict[tuple[str, str], NDArray[np.int64]] = {}
        for number, trial in enumerate(trials):
            seen, sigma = _smoothed(trial.joints, noise, np.random.default_rng((0, number)))
            frames = slice(1, len(seen))
            said = {
                "slower than 0.15 m/s and low (HuMoR's label)": _rule(seen, REST_SPEED),
                "slower than 0.7 m/s and low": _rule(seen, LOAD_SPEED),
                "network": _asked(network, seen, sigma),
            }
            for method, feet in said.items():
                for kind in (trial.kind, "all"):
                    found, true = feet[frames], trial.loaded[: len(seen)][frames]
                    valid = trial.valid[: len(seen)][frames]
                    of_both = (found & true & valid).sum(), (found & valid).sum(), (true & valid).sum()
                    counts[method, kind] = counts.get((method, kind), np.zeros(3, np.int64)) + of_both
        for method in dict.fromkeys(method for method, _ in counts):
            records.append({"noise_m": noise, "method": method} | {
                kind: _scores(*counts[method, kind]) for kind in (*KINDS, "all") if (method, kind) in counts
            })  # fmt: skip
    return Result([_table(records)], {"records": records, "streams": len(trials)})


def _smoothed(joints: Floats, noise: float, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return joints and their deviations after the smoother, for all frames except the last `DELAY`."""
    smoother = MixtureSmoother(DELAY, 1)
    seen = joints + noise * rng.standard_normal(joints.shape)
    answers = [smoother.update(frame[None], t / FPS) for t, frame in enumerate(seen)]
    kept = [answer for answer in answers if answer is not None]
    return np.stack([a.positions[0] for a in kept]), np.stack([a.sigma[0] for a in kept])


def _rule(seen: Floats, speed: float) -> Bools:
    contacts = label_contacts(seen, FPS, speed)
    return np.stack([contacts[:, side].any(axis=1) for side in _SIDES], axis=1)


def _asked(network: LiveContacts, seen: Floats, sigma: Floats) -> Bools:
    """Run the network frame by frame. A foot bears load where its ankle or its toe does."""
    ways = seen[:, [J["left_foot"], J["right_foot"]]] - seen[:, [J["left_ankle"], J["right_ankle"]]]
    way = np.nansum(ways, axis=1)
    yaw = np.arctan2(way[:, 1], way[:, 0])
    count = len(seen) - 1
    sigma = np.where(np.isfinite(sigma), sigma, 1.0)
    features = contact_features(
        seen[1:], seen[:-1], 1.0 / FPS, yaw[1:], sigma[1:], np.ones(count), np.zeros((count, len(CONTACT_JOINTS)))
    )
    state, said = np.zeros((1, network.hidden), dtype=np.float32), [np.zeros(2, dtype=bool)]
    for row in features:
        load, _, state = network(row[None], state)
        said.append(np.array([load[0, side].max() > 0.5 for side in _SIDES]))
    return np.array(said)


def _scores(both: int, found: int, true: int) -> dict[str, float]:
    return {
        "f1": round(2 * both / max(found + true, 1), 4),
        "recall": round(both / max(true, 1), 4),
        "precision": round(both / max(found, 1), 4),
    }


def _table(records: list[dict]) -> Table:
    kinds = [kind for kind in (*KINDS, "all") if kind in records[0]]
    return Table(
        "contacts", "Feet under load, against force plates: F1",
        ["method", "noise, cm", *kinds, "walking: recall", "walking: precision"],
        [[r["method"], f"{100 * r['noise_m']:.0f}", *(f"{r[kind]['f1']:.3f}" for kind in kinds),
          *(f"{r.get('walking', r['all'])[key]:.3f}" for key in ("recall", "precision"))] for r in records],
        "Markers of ankle and toe alone, in three streams of 30 Hz each; noise is independent from frame to "
        f"frame and goes through the smoother, delay {DELAY}. Two subjects, on whom nothing was trained; the rule "
        "has its 0.7 m/s from them.",
    )  # fmt: skip
