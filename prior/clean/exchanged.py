"""Left and right exchanged: limbs, or the whole body, are put back.

Detectors take left for right, for a frame or for seconds. Two things tell. A limb that is exchanged jumps to the other
side, so each side is nearer to the other's prediction. And a body whose sides are exchanged is no human posture: its
knees and feet point backwards, or its limbs cross. The jump tells at once, but not what was right before it; the
posture (`prior.models.posture`) tells which of the two labellings is right, at a body's first frame and after a while.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Bools, Floats
from steadypose.prior.body.skeleton import HIPS, MIRROR, SHOULDERS, limbs
from steadypose.prior.compiled import njit
from steadypose.prior.models.posture import LivePosture
from steadypose.prior.timing.rate import FPS

APART = 0.15  # least mean distance of a limb's joints to their predictions to test for an exchange, metres
BETTER = 0.4  # share to which an exchange must reduce that distance
LASTS = 4  # number of frames from which on an exchange lasts: a limb is then exchanged as long as it is nearer so
SIGMA = 0.03  # standard deviation of joints along an axis, when postures are compared, metres
FIRST = 15  # largest number of a body's first frames that are tested, until one order is likelier by far

RATIO, MARGIN = 1.25, 5.0
"""An order is likelier by far if the other's misfit exceeds this multiple of its own by this margin. Of 7,500 right
frames of validation people, none seems exchanged, with noise of 4 cm one; of exchanged bodies 98.6 and 92 % do."""

POSSIBLE = 60.0
"""Largest misfit of a likelier order. 95 % of right postures have at most 50 with 2 cm of noise; with 4 cm, and 12 cm
along a camera's ray, half have more than 90, and chance decides between orders."""

MEMORY = 9  # length of the running mean of misfits, frames

_CHAINS = ("elbow", "wrist"), ("knee", "ankle", "foot")
_LIMBS = tuple(np.concatenate(limbs(chain)) for chain in _CHAINS)
# joints that detectors may or may not exchange with the limb
_BASES = ("collar", "shoulder"), ("hip",)
_CORNERS = [*HIPS, *SHOULDERS]


def _orders() -> NDArray[np.intp]:
    """(3, 3, 22) orders of a body's joints in which arms and legs are as given, exchanged, or exchanged with their
    bases."""
    orders = np.tile(np.arange(22), (3, 3, 1))
    arms, legs = ((*base, *chain) for base, chain in zip(_BASES, _CHAINS, strict=True))
    for a, of_arms in enumerate(((), _CHAINS[0], arms)):
        for b, of_legs in enumerate(((), _CHAINS[1], legs)):
            for joint in np.concatenate(limbs(of_arms, of_legs)).astype(int):
                orders[a, b, joint] = MIRROR[joint]
    return orders


_ORDERS = _orders().reshape(9, 22)
_EXCHANGED = np.array(np.unravel_index(np.arange(9), (3, 3))) > 0
"""(2, 9) whether arms, and legs, are exchanged in each order."""
_FIRST_ORDERS = np.array([0, 2, 3, 5, 6, 8])
"""Orders that are tested in a body's first frames, where no jump tells. Not exchanged are legs without their hips: a
dancer's crossed legs seem to be."""


class ExchangedLimbs:
    """Puts exchanged limbs of ``slots`` bodies back. An exchange that lasts longer than ``patience_s`` is accepted,
    unless it makes a posture less likely."""

    def __init__(self, patience_s: float, slots: int) -> None:
        self._patience = patience_s * FPS
        self._posture = LivePosture.load("default")
        self._tests = np.full(slots, FIRST)
        self._since = np.zeros((slots, len(_LIMBS)))  # frames put back less frames not put back
        self._misfit = np.zeros((slots, len(_ORDERS)))
        self._frames = np.zeros(slots)

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        self._tests[slot] = FIRST
        for values in (self._since, self._misfit, self._frames):
            values[slot] = 0

    def begin(self, positions: Floats) -> Bools:
        """Put back, in place, limbs of (S, 22, 3) metres, NaN where unobserved, of bodies in whose first frames another
        order of `_FIRST_ORDERS` is likelier. Return the joints (S, 22) that were.
        """
        back = np.zeros(positions.shape[:2], dtype=bool)
        seen = np.isfinite(positions[:, _CORNERS, 0]).all(axis=1)
        for slot in np.flatnonzero((self._tests > 0) & seen):
            self._tests[slot] -= 1
            misfit = self._posture.misfit(positions[slot, _ORDERS], SIGMA)
            best = _FIRST_ORDERS[misfit[_FIRST_ORDERS].argmin()]
            if misfit[best] < POSSIBLE and misfit[0] > RATIO * misfit[best] + MARGIN:
                positions[slot] = positions[slot, _ORDERS[best]]
                back[slot] = _ORDERS[best] != np.arange(22)
                self._since[slot], self._misfit[slot], self._frames[slot] = (LASTS + 1) * _EXCHANGED[:, best], misfit, 1
            if back[slot].any() or misfit[_FIRST_ORDERS[1:]].min() > RATIO * misfit[0] + MARGIN:
                self._tests[slot] = 0
        return back

    def update(self, positions: Floats, expected: Floats, distance: Floats) -> tuple[int, Bools]:
        """Put limbs of (S, 22, 3) metres back, in place, given their predictions (S, 22, 3), NaN where unknown, and
        their distances (S, 22) to these.

        Returns how many pairs of limbs were put back, and the joints (S, 22) for which this is given up in this frame.
        """
        given_up = np.zeros(distance.shape, dtype=bool)
        if not (self._since.any() or (distance > APART).any()):
            return 0, given_up
        keep, swap = np.stack([_kept_and_exchanged(positions, expected, pair) for pair in _LIMBS], axis=-1)
        hidden = np.isfinite(expected[..., 0]) & np.isnan(distance)
        whole = np.stack([~hidden[:, pair].any(axis=1) for pair in _LIMBS], axis=-1)
        far = whole & (keep > APART) & (swap < BETTER * keep)
        # while an exchange lasts, or if other limbs are exchanged, limbs beside each other are too
        jumped = far | (swap < keep) & ((self._since >= LASTS) | far.any(axis=1, keepdims=True))
        # most frames are right, so one exchanged frame does not confirm another at the beginning
        self._since = np.maximum(self._since + np.where(jumped, 1, -1), 0)
        self._compare(positions)
        supported = _EXCHANGED[:, self._misfit.argmin(axis=1)].T
        overruled = (self._since > self._patience) & ~supported
        self._since[overruled] = 0
        jumped &= ~overruled
        for k, pair in enumerate(_LIMBS):
            given_up[np.ix_(overruled[:, k], pair)] = True
            _put_back(positions, jumped[:, k], pair)
            for joint in _BASES[k]:
                base = np.concatenate(limbs((joint,)))
                keep, swap = _kept_and_exchanged(positions, expected, base)
                _put_back(positions, jumped[:, k] & (swap < keep), base)
        return int(jumped.sum()), given_up

    def _compare(self, positions: Floats) -> None:
        """Update the misfits of bodies (S, 22, 3), as observed, with limbs that are being put back."""
        active = self._since.any(axis=1)
        self._frames[~active], self._misfit[~active] = 0, 0.0
        for slot in np.flatnonzero(active & np.isfinite(positions[:, _CORNERS, 0]).all(axis=1)):
            self._frames[slot] = min(self._frames[slot] + 1, MEMORY)
            misfit = self._posture.misfit(positions[slot, _ORDERS], SIGMA)
            self._misfit[slot] += (misfit - self._misfit[slot]) / self._frames[slot]


def _kept_and_exchanged(positions: Floats, expected: Floats, pair: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """(S,) metres, mean distance of the joints ``pair`` that are observed on both sides to their predictions: as
    observed, and with sides exchanged; NaN if there is none."""
    keep = distances(positions[:, pair], expected[:, pair])
    swap = distances(positions[:, MIRROR[pair]], expected[:, pair])
    both = np.isfinite(keep + swap)
    count = np.where(both.any(axis=1), both.sum(axis=1), np.nan)
    return np.where(both, keep, 0.0).sum(axis=1) / count, np.where(both, swap, 0.0).sum(axis=1) / count


def _put_back(positions: Floats, exchanged: Bools, pair: NDArray[np.intp]) -> None:
    """Exchange the joints ``pair`` of both sides of the bodies ``exchanged`` (S,), in place."""
    rows = np.flatnonzero(exchanged)[:, None]
    positions[rows, pair] = positions[rows, MIRROR[pair]]


@njit(cache=True)
def distances(a, b):
    """(S, J) metres between joints (S, J, 3)."""
    apart = np.empty(a.shape[:2])
    for row in range(len(a)):
        for joint in range(a.shape[1]):
            square = 0.0
            for axis in range(3):
                square += (a[row, joint, axis] - b[row, joint, axis]) ** 2
            apart[row, joint] = math.sqrt(square)
    return apart
