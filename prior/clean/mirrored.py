"""Detects limbs that are mirrored about the image plane, and mirrors them back.

An image hardly shows whether an arm points to the camera or away from it, so estimators of depth may give a limb's
depth relative to its root the wrong sign, for seconds. Most mirrored limbs are possible poses with the right bone
lengths. But the onset is no possible movement: from one frame to the next, the limb continues better if it is mirrored
back. The same test detects the end. If the root jumps along the ray too, the whole body jumped, and nothing is
mirrored. Onset and end do not show near the image plane, so no limb is mirrored back for long, nor after a gap in the
observations, so a limb is accepted as it reappears.
"""

from __future__ import annotations

import math

import numpy as np

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.skeleton import limbs
from steadypose.prior.compiled import njit

LEAST, DEVIATIONS = 0.08, 5.0
"""Least distance of a limb to its prediction, along the ray, for an onset or an end: metres, and multiples of its root
mean square so far (chosen on validation, benchmarks/NOTEBOOK.md)."""

MOVED = 0.03
"""Least such distance of two joints at an onset, metres. If a single joint is far, it has jumped."""

BETTER = 0.5  # share to which mirroring must reduce the limb's distance to its prediction

MEMORY, FIRST = 20, 10
"""Length of the running mean square of that distance, and number of frames before a limb is judged."""

IN_A_ROW = 3
"""Number of frames for which a joint must have been observed before its prediction is used, and for which a limb
must be hidden before its fault is over."""

LONGEST, REMEMBERED = 30, 300
"""Longest time for which a limb is mirrored back, and time after this in which the next onset is taken for the end of
the fault, frames."""

MIN_RANGE = 0.8
"""Least distance of a limb's root from the sensor, metres. Nearer joints are assumed to be relative to the body, not to
a camera, so that no ray is known."""

_PARTS = ("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle", "foot")
_LIMBS = np.array([[*limb, -1][:4] for limb in limbs(*_PARTS)])
"""(4, 4) root and joints of each limb; -1 where a limb has fewer."""


class MirroredLimbs:
    """Mirrors arms and legs of ``slots`` bodies back, relative to their shoulders and hips."""

    def __init__(self, slots: int) -> None:
        self._square = np.zeros((slots, len(_LIMBS)))
        self._frames = np.zeros((slots, len(_LIMBS)), dtype=np.int64)
        self._since = np.zeros((slots, len(_LIMBS)), dtype=np.int64)
        self._observed = np.zeros((slots, 22), dtype=np.int64)  # frames in a row; negative, frames hidden

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        for values in (self._square, self._frames, self._since, self._observed):
            values[slot] = 0

    def update(self, positions: Floats, expected: Floats, camera: Floats) -> tuple[Bools, Bools]:
        """Mirror limbs of bodies (S, 22, 3) metres, NaN where unobserved, back, in place, given the joints' predictions
        (S, 22, 3), NaN where unknown, and the sensor's position (3,).

        Returns which joints (S, 22) were mirrored back, and for which (S, 22) this ends in this frame although the
        fault may last, because the limb was mirrored back for too long or hidden.
        """
        back = np.zeros(positions.shape[:2], dtype=np.bool_)
        given_up = np.zeros_like(back)
        observed, frames = np.isfinite(positions[..., 0]), self._observed
        self._observed = np.where(observed, np.maximum(frames, 0) + 1, np.minimum(frames, 0) - 1)
        _mirror_back(
            positions, expected, camera, self._observed, self._square, self._frames, self._since, back, given_up
        )
        return back, given_up


@njit(cache=True)
def _mirror_back(positions, expected, camera, observed, square, frames, since, back, given_up):
    """Compute `MirroredLimbs.update`. ``observed`` (S, 22) is the number of frames in a row in which each joint was
    observed; negative, hidden. ``since`` (S, 4) is the number of frames for which a limb has been mirrored back;
    negative, the number of frames that are left of `REMEMBERED`."""
    ray = np.empty(3)
    for row in range(len(positions)):
        for limb in range(len(_LIMBS)):
            root, joints, now = _LIMBS[limb, 0], _LIMBS[limb, 1:], since[row, limb]
            if now != 0:
                now += 1
            away = _to_limb(positions[row, root], camera, ray)
            known, moved, kept, mirrored, across = _distances(
                positions[row], expected[row], observed[row], root, joints, ray, now > 0
            )
            shift = 0.0
            for axis in range(3):
                shift += (positions[row, root, axis] - expected[row, root, axis]) * ray[axis]
            if known > 0 and away > MIN_RANGE and (now > 0 or abs(shift) < LEAST):
                far = frames[row, limb] >= FIRST and kept > max(LEAST**2, DEVIATIONS**2 * square[row, limb])
                if far and (now > 0 or moved >= 2) and mirrored + across < BETTER**2 * (kept + across):
                    kept, now = mirrored, 1 if now == 0 else 0
                frames[row, limb] = min(frames[row, limb] + 1, MEMORY)
                square[row, limb] += (kept - square[row, limb]) / frames[row, limb]
            hidden = True
            for joint in joints:
                hidden &= joint < 0 or observed[row, joint] <= -IN_A_ROW
            if now > LONGEST or (now > 0 and hidden):
                now = -REMEMBERED
                for joint in joints:
                    given_up[row, joint] |= joint >= 0
            since[row, limb] = now
            if now > 0:
                _reflect(positions[row], root, joints, ray, back[row])


@njit(cache=True)
def _to_limb(root, camera, ray):
    """Write the direction from the camera to a limb's root and return the distance, metres."""
    away = 0.0
    for axis in range(3):
        ray[axis] = root[axis] - camera[axis]
        away += ray[axis] ** 2
    away = math.sqrt(away)
    for axis in range(3):
        ray[axis] /= away
    return away


@njit(cache=True)
def _distances(positions, expected, observed, root, joints, ray, held):
    """Return how many joints have a prediction, how many moved, and mean squared distances from predictions, m²: along
    the ray as observed, along the ray if mirrored, and across it.

    ``held`` is whether the limb is being mirrored back. A mirrored depth is relative to the root, and so contains the
    root's noise; a depth as observed is compared without the root.
    """
    count, moved, kept, mirrored, across = 0, 0, 0.0, 0.0, 0.0
    for joint in joints:
        depth, ahead, off, square = 0.0, 0.0, 0.0, 0.0
        for axis in range(3):
            depth += (positions[joint, axis] - positions[root, axis]) * ray[axis]
            ahead += (expected[joint, axis] - expected[root, axis]) * ray[axis]
            away = positions[joint, axis] - expected[joint, axis]
            off += away * ray[axis]
            square += away**2
        known = joint >= 0 and min(observed[joint], observed[root]) > IN_A_ROW
        if known and math.isfinite(square + depth + ahead):
            count += 1
            across += square - off**2
            one = (depth + ahead) ** 2 if held else off**2
            other = (depth - ahead) ** 2 if held else (depth + ahead) ** 2
            kept += one
            mirrored += other
            moved += one > max(other, MOVED**2)
    return count, moved, kept / count, mirrored / count, across / count


@njit(cache=True)
def _reflect(positions, root, joints, ray, back):
    """Mirror a limb about the plane through its root across the ray, in place, and mark its observed joints."""
    for joint in joints:
        depth = 0.0
        for axis in range(3):
            depth += (positions[joint, axis] - positions[root, axis]) * ray[axis]
        if joint >= 0 and math.isfinite(depth):
            back[joint] = True
            for axis in range(3):
                positions[joint, axis] -= 2 * depth * ray[axis]
