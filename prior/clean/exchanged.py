"""Detects limbs, or whole bodies, whose left and right are exchanged, and swaps them back.

Detectors take left for right, for a frame or for seconds. Two cues show it. An exchanged limb jumps to the other side,
so each side is nearer to the other's prediction. And a body with exchanged sides is no human posture: its knees and
feet point backwards, or its limbs cross. The jump shows at once, but not which labelling was right before it. The
Gaussian of postures (`prior.models.posture`) shows which labelling is right, in a body's first frames and after a
while.
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
CONFIRMED = 4  # frames after which an exchange is confirmed: from then on it ends when the limb is no longer nearer so
SIGMA = 0.03  # standard deviation of joints along an axis, when postures are compared, metres
FIRST = 15  # largest number of a body's first frames that are tested, until one labelling is far likelier

RATIO, MARGIN = 1.25, 5.0
"""A labelling is far likelier if the other's misfit exceeds this multiple of its own by this margin. Of 7,500 right
frames of validation people, none seems exchanged, with noise of 4 cm one; of exchanged bodies 98.6 and 92 % do."""

POSSIBLE = 60.0
"""Largest misfit of a likelier labelling. 95 % of right postures have at most 50 with 2 cm of noise; with 4 cm, and 12
cm along a camera's ray, half have more than 90, and misfits do not distinguish labellings."""

CROSSED = 45.0
"""The same in a body's first frames, where no jump shows, if legs are exchanged without their hips: crossed legs
look so. Validation people need no bound below `POSSIBLE`, and 2 to 4 % less of their exchanged legs are found; it is
there for one test person, a dancer, whose crossed legs have a misfit of 55."""

MEMORY = 9  # length of the running mean of misfits, frames

_CHAINS = ("elbow", "wrist"), ("knee", "ankle", "foot")
_LIMBS = tuple(np.concatenate(limbs(chain)) for chain in _CHAINS)
# joints that detectors may or may not exchange with the limb
_BASES = ("collar", "shoulder"), ("hip",)
_CORNERS = [*HIPS, *SHOULDERS]


def _orders() -> NDArray[np.intp]:
    """(3, 3, 22) labellings: orders of a body's joints in which arms and legs are as given, exchanged, or exchanged
    with their bases."""
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
_POSSIBLE = np.where(np.arange(9) % 3 == 1, CROSSED, POSSIBLE)  # (9,) of each order


class ExchangedLimbs:
    """Swaps exchanged limbs of ``slots`` bodies back. A labelling that persists for longer than ``patience_s`` is
    accepted, unless it makes the posture less likely."""

    def __init__(self, patience_s: float, slots: int) -> None:
        self._patience = patience_s * FPS
        self._posture = LivePosture.load("default")
        self._tests = np.full(slots, FIRST)
        self._since = np.zeros((slots, len(_LIMBS)))  # number of frames swapped back less number of others
        self._misfit = np.zeros((slots, len(_ORDERS)))
        self._frames = np.zeros(slots)

    def forget(self, slot: Bools) -> None:
        """Forget the bodies in these slots (S,)."""
        self._tests[slot] = FIRST
        for values in (self._since, self._misfit, self._frames):
            values[slot] = 0

    def begin(self, positions: Floats) -> Bools:
        """Swap limbs back, in place, in the first frames of bodies (S, 22, 3) metres, NaN where unobserved, for which
        another labelling is far likelier. Return which joints (S, 22) were swapped."""
        back = np.zeros(positions.shape[:2], dtype=bool)
        for slot in np.flatnonzero((self._tests > 0) & np.isfinite(positions[:, _CORNERS, 0]).all(axis=1)):
            self._tests[slot] -= 1
            misfit = self._posture.misfit(positions[slot, _ORDERS], SIGMA)
            best = int(np.where(misfit < _POSSIBLE, misfit, np.inf).argmin())
            if misfit[0] > RATIO * misfit[best] + MARGIN:
                positions[slot] = positions[slot, _ORDERS[best]]
                back[slot] = _ORDERS[best] != np.arange(22)
                self._since[slot], self._misfit[slot], self._frames[slot] = (
                    (CONFIRMED + 1) * _EXCHANGED[:, best],
                    misfit,
                    1,
                )
            if back[slot].any() or misfit[1:].min() > RATIO * misfit[0] + MARGIN:
                self._tests[slot] = 0
        return back

    def update(self, positions: Floats, expected: Floats, distance: Floats) -> tuple[int, Bools]:
        """Swap exchanged limbs of bodies (S, 22, 3) metres back, in place, given the joints' predictions (S, 22, 3),
        NaN where unknown, and their distances (S, 22) from these.

        Returns how many pairs of limbs were swapped, and for which joints (S, 22) swapping ends in this frame, because
        the new labelling is accepted.
        """
        given_up = np.zeros(distance.shape, dtype=bool)
        if not (self._since.any() or (distance > APART).any()):
            return 0, given_up
        keep, swap = np.stack([_kept_and_exchanged(positions, expected, pair) for pair in _LIMBS], axis=-1)
        hidden = np.isfinite(expected[..., 0]) & np.isnan(distance)
        whole = np.stack([~hidden[:, pair].any(axis=1) for pair in _LIMBS], axis=-1)
        far = whole & (keep > APART) & (swap < BETTER * keep)
        # during a confirmed exchange, or if other limbs are exchanged, also limbs that are near each other
        jumped = far | (swap < keep) & ((self._since >= CONFIRMED) | far.any(axis=1, keepdims=True))
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
        """Update the misfits of bodies (S, 22, 3), as observed, of which limbs are being swapped."""
        active = self._since.any(axis=1)
        self._frames[~active], self._misfit[~active] = 0, 0.0
        for slot in np.flatnonzero(active & np.isfinite(positions[:, _CORNERS, 0]).all(axis=1)):
            self._frames[slot] = min(self._frames[slot] + 1, MEMORY)
            misfit = self._posture.misfit(positions[slot, _ORDERS], SIGMA)
            self._misfit[slot] += (misfit - self._misfit[slot]) / self._frames[slot]


def _kept_and_exchanged(positions: Floats, expected: Floats, pair: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """(S,) metres, mean distance from their predictions of those joints of ``pair`` that are observed on both sides: as
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
