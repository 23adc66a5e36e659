"""Which legs are only guesses, because a counter or the edge of the image has hidden them for long."""

from __future__ import annotations

import numpy as np

from steadypose.msgs.types import CONTACTS
from steadypose.prior.arrays import Bools
from steadypose.prior.body.skeleton import J
from steadypose.prior.world.observe import BodyObservation

GUESSED_S = 2.0
"""Time from which an unobserved joint of a leg is only a guess, seconds. On simulated people, the Brier skill score of
predicted contacts of feet against their mean is 0.36 while the feet are observed, 0.28 in the first 2 s after that,
0.02 later, and -0.21 for feet never observed (benchmarks/NOTEBOOK.md)."""

LEG_CONTACTS = slice(0, 6)
"""The joints of legs among `CONTACTS`: knees, ankles and feet, left before right."""

FEET_OF_LEGS = slice(2, 6)
"""`FEET` among them."""

_JOINTS = [J[name] for name in CONTACTS[LEG_CONTACTS]]


class LegMemory:
    """Time for which one body's knees and feet have been unobserved; a new body's were never observed."""

    def __init__(self) -> None:
        self._unseen_s = np.full(len(_JOINTS), np.inf)

    def update(self, observed: BodyObservation) -> Bools:
        """Return which joints of legs (6,), in the order of `LEG_CONTACTS`, are only guesses.

        Ankle and toes are one foot: it is observed if one of the two is, because many sensors have no toes. A foot that
        is observed says where its knee is.
        """
        knees, *feet = observed.observed[_JOINTS].reshape(3, 2)
        foot = np.any(feet, axis=0)
        self._unseen_s = np.where([*(knees | foot), *foot, *foot], 0.0, self._unseen_s + observed.dt)
        return self._unseen_s >= GUESSED_S
