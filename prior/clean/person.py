"""This person's bones: what was measured, weighed against human proportions, frozen once sure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.body.inverse_kinematics import solve_rotations
from steadypose.prior.body.kinematics import global_rotations
from steadypose.prior.body.skeleton import JOINTS, MIRROR, PARENTS, REST_OFFSETS, J, finite_joints
from steadypose.prior.clean.frame import Window

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class BonesSettings:
    """How long to measure.

    Attributes:
        enabled: whether to measure at all; off, everybody has a generic adult's bones.
        samples: frames to measure before the estimate is frozen.
        every: frames between two of them, so that their errors are not the same one.
    """

    enabled: bool = True
    samples: int = 64
    every: int = 5


STATURE_SPREAD = 0.1
"""Standard deviation of the log of a person's size against the generic adult's."""

LIMB_SPREAD, TRUNK_SPREAD = 0.05, 0.12
"""Standard deviations of the log of a bone's length about the person's size: 2 to 7 % for the arms and legs of 22
people measured by motion capture; more in trunk, head and feet, where sensors mean different places by one name."""

TRUNK_PLACE_SPREAD = 0.05
"""Metres along each axis, by which sensors differ in where hips, neck and shoulders leave the trunk."""

LENGTH_BIASES = 3.0
"""Times the sensor's bias: how wrong a single sample of a bone is at least, most of it an error that its neighbours
share."""

LIKE_SAMPLES = 12
"""So many samples in a row, two seconds, err alike and tell as much as one."""

_ENOUGH_JOINTS = 8
_RENEWAL = 1.5
_RENEWED = 8  # one in so many slots, at most, in one frame
_SURE = 0.05  # metres: a joint whose place is known less well, hidden for a while, measures no bone
_APPROACH = 0.1  # of the way to a renewed estimate, a frame: bones that jump would shake the whole limb
_ENOUGH_SAMPLES = 4


class Measured(NamedTuple):
    """A person's bones.

    Attributes:
        offsets: (22, 3) metres, each joint in its parent's frame.
        give: (22,) metres^2, how much of the variance of each bone's length more samples will take away.
    """

    offsets: Floats
    give: Floats


class Bones:
    """Keeps each slot's ``window.offsets``: `estimate_bones` over frames sampled from the person's first ten seconds.

    The estimate is renewed each time there are half as many samples more, so that it costs little and soon stands
    still, and is approached smoothly. ``window.give`` says how far lengths are still to be learned.
    """

    delay_frames = 0

    def __init__(self, settings: BonesSettings, bias_sigma: float, slots: int) -> None:
        self._settings, self._bias_sigma = settings, bias_sigma
        self._samples = np.full((slots, settings.samples, 22, 3), np.nan)
        self._target = np.zeros((slots, 22, 3))
        self._give = np.zeros((slots, 22))
        self._count = np.zeros(slots, dtype=np.int64)
        self._used = np.zeros(slots, dtype=np.int64)
        self._wait = np.zeros(slots, dtype=np.int64)

    def reset(self, slot: NDArray[np.bool_]) -> None:
        """Forget the people in these slots."""
        self._samples[slot] = np.nan
        self._count[slot] = self._used[slot] = 0
        self._wait[slot] = 0

    def update(self, window: Window) -> Window:
        """Sample the smoother's newest frame, where it is due, and renew the estimate."""
        if not self._settings.enabled or window.smoothed is None:
            return window
        # Smoothed, for noise makes bones longer.
        sure = window.smoothed.sigma < _SURE
        positions = np.where(sure[..., None], window.smoothed.positions, np.nan)
        enough = sure.sum(axis=1) >= _ENOUGH_JOINTS
        self._wait -= 1
        due = window.present & enough & (self._wait < 0) & (self._count < self._settings.samples)
        for slot in np.flatnonzero(due):
            self._samples[slot, self._count[slot]] = positions[slot]
            self._count[slot] += 1
            self._wait[slot] = self._settings.every - 1
        full = self._count == self._settings.samples
        renew = (self._count >= _RENEWAL * self._used) | (full & (self._count > self._used))
        # People who came together would all be due in the same frame: after the first estimate, a few at a time.
        stale = np.flatnonzero(renew & (self._count > 0) & window.present & enough)
        for slot in [
            *stale[self._used[stale] == 0],
            *stale[self._used[stale] > 0][: max(1, len(self._count) // _RENEWED)],
        ]:
            count = self._used[slot] = self._count[slot]
            noise = float(np.median(window.smoothed.sigma[slot, sure[slot]]))
            samples = self._samples[slot, :count]
            self._target[slot], self._give[slot] = estimate_bones(
                samples, self._bias_sigma, noise, self._settings.samples
            )
            window.measured[slot] = count >= _ENOUGH_SAMPLES
            if count == 1:
                window.offsets[slot], window.give[slot] = self._target[slot], self._give[slot]
        known = self._used > 0
        window.offsets[known] += _APPROACH * (self._target[known] - window.offsets[known])
        window.give[known] += _APPROACH * (self._give[known] - window.give[known])
        return window


def estimate_bones(positions: Floats, bias_sigma: float, noise_sigma: float, samples: int) -> Measured:
    """This person's bones, the same on both sides, from a few poses in a row.

    Lengths are the posterior mean of a log-normal model: a person's size varies about the generic adult's, each bone
    about the person's size, and the median length over the samples of both sides about the bone, the less the more
    samples there are. A body first seen from the side, with the far limbs guessed, so starts with human proportions.
    A joint never seen is placed by scaling the rest pose between its neighbours seen. Bones that leave pelvis and
    chest rigidly (hips, neck, collars) go the way of the median vector in the trunk's frame, weighed likewise.

    Args:
        positions: (T, 22, 3) metres, NaN where unobserved; samples of about 6 Hz.
        bias_sigma: metres along an axis, the sensor's slow error.
        noise_sigma: metres along an axis, the positions' other error.
        samples: how many there will be in the end.
    """
    counts = np.array([len(positions), max(samples, len(positions))])
    same = 1.0 + counts / LIKE_SAMPLES
    bias, noise = LENGTH_BIASES * bias_sigma, np.sqrt(2.0) * noise_sigma
    seen = np.asarray(finite_joints(positions).any(axis=0))
    seen |= seen[MIRROR]
    bones = _bones(seen)
    log_ratio, sigma = np.zeros(len(bones)), np.full((2, len(bones)), np.inf)  # now, and in the end
    for k, paths in enumerate(bones):
        generic = float(np.linalg.norm(REST_OFFSETS[paths[0]].sum(axis=0)))
        ends = [(path[0], max(PARENTS[path[-1]], 0)) for path in paths]
        lengths = np.concatenate([np.linalg.norm(positions[:, a] - positions[:, b], axis=-1) for a, b in ends])
        lengths = lengths[np.isfinite(lengths)]
        if len(lengths):
            median = _median(lengths)
            deviation = 1.4826 * _median(np.abs(lengths - median))
            log_ratio[k] = np.log(max(median, 0.1 * generic) / generic)
            # What noise does not explain of the deviation is as lasting as the bias.
            lasting = max(deviation**2 - noise**2, bias**2)
            sigma[:, k] = np.sqrt(lasting / same + noise**2 / len(lengths) * counts[0] / counts) / generic
    spread = np.array([LIMB_SPREAD if paths[0][0] in _LIMBS else TRUNK_SPREAD for paths in bones])
    weight = 1.0 / (spread**2 + sigma**2)
    stature = 1.0 / (weight.sum(axis=1) + STATURE_SPREAD**-2)
    size = stature[0] * (weight[0] * log_ratio).sum()
    own = spread**2 * weight[0] * (log_ratio - size)
    variance = spread**2 * (1.0 - spread**2 * weight) + stature[:, None] * (1.0 - spread**2 * weight) ** 2
    offsets, to_learn = REST_OFFSETS * np.exp(size), np.zeros(22)
    for paths, factor, (now, then) in zip(bones, np.exp(own), variance.T, strict=True):
        offsets[np.concatenate(paths)] *= factor
        to_learn[np.concatenate(paths)] = max(now - then, 0.0)
    give = to_learn * (offsets**2).sum(axis=-1)
    doubt = bias**2 / same + noise**2 / counts
    trust = TRUNK_PLACE_SPREAD**2 / (TRUNK_PLACE_SPREAD**2 + doubt)
    give[_ON_TRUNK] = TRUNK_PLACE_SPREAD**2 * (trust[1] - trust[0])
    return Measured(_place_on_trunk(positions, seen, offsets, trust[0]), give)


_LIMBS = frozenset(j for j, name in enumerate(JOINTS) if name.endswith(("knee", "ankle", "elbow", "wrist")))
_TRUNKS = ((J["pelvis"], (J["left_hip"],)), (J["spine3"], (J["neck"], J["left_collar"])))
_ON_TRUNK = sorted({int(end) for _, joints in _TRUNKS for joint in joints for end in (joint, MIRROR[joint])})
_COLLAR_TO_SHOULDER = J["left_shoulder"] - J["left_collar"]


def _bones(seen: NDArray[np.bool_]) -> list[list[list[int]]]:
    """What can be measured: for each, the one or two (left and right) paths of joints up to, not with, one seen.

    Args:
        seen: (22,) which joints ever are, on either side.
    """
    measurable: list[list[list[int]]] = []
    for joint in range(1, len(PARENTS)):
        if not seen[joint]:
            continue
        path = [joint]
        while PARENTS[path[-1]] > 0 and not seen[PARENTS[path[-1]]]:
            path.append(PARENTS[path[-1]])
        if not seen[PARENTS[path[-1]]]:
            continue
        mirrored = MIRROR[path].tolist()
        twin = next((paths for paths in measurable if paths[0] == mirrored), None)
        if twin is None:
            measurable.append([path])
        else:
            twin.append(path)
    return measurable


def _median(values: Floats) -> Floats:
    """Along the first axis, in a tenth of the time that numpy's takes for as few."""
    ordered = np.sort(values, axis=0)
    return 0.5 * (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2])


def _place_on_trunk(positions: Floats, seen: NDArray[np.bool_], offsets: Floats, trust: float) -> Floats:
    """Offsets (22, 3) with hips, neck and collars moved by ``trust`` towards where the samples (T, 22, 3) have them."""
    placed = offsets.copy()
    world = global_rotations(solve_rotations(positions, offsets))
    for trunk, children in _TRUNKS:
        for joint in children:
            both = []
            for end, side in ((joint, 1.0), (int(MIRROR[joint]), -1.0)):
                beyond = 0 if seen[end] or joint != J["left_collar"] else _COLLAR_TO_SHOULDER
                vectors = np.einsum("tji,tj->ti", world[:, trunk], positions[:, end + beyond] - positions[:, trunk])
                vectors -= offsets[end + beyond] if beyond else 0.0
                both.append(vectors[finite_joints(vectors)] * [1.0, side, 1.0])
            vectors = np.concatenate(both)
            if len(vectors):
                moved = offsets[joint] + trust * (_median(vectors) - offsets[joint])
                if MIRROR[joint] == joint:
                    moved[1] = 0.0
                placed[joint], placed[MIRROR[joint]] = moved, moved * [1.0, -1.0, 1.0]
    return placed
