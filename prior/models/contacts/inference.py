"""`ContactNet` as the live node asks it, frame by frame, without torch."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.body.kinematics import CONTACT_JOINTS
from steadypose.prior.models.layers.dense import Floats, dense
from steadypose.prior.models.weights_io import Arrays, load_weights


class Contacts(NamedTuple):
    """Of B bodies and `CONTACT_JOINTS`.

    Attributes:
        load: (B, 8) probabilities that they bear load.
        rest: (B, 8) that they stand still on what bears them.
        state: (B, hidden) what to remember for the next frame.
    """

    load: Floats
    rest: Floats
    state: Floats


class LiveContacts:
    """A trained `ContactNet`.

    Attributes:
        hidden: numbers that it remembers of a body; zeros before the first frame.
    """

    def __init__(self, weights: Arrays) -> None:
        self._input = weights["unit.weight_ih_l0"], weights["unit.bias_ih_l0"]
        self._kept = weights["unit.weight_hh_l0"], weights["unit.bias_hh_l0"]
        self._head = weights["head.weight"], weights["head.bias"]
        self.hidden = weights["head.weight"].shape[1]

    @classmethod
    def load(cls, weights: str) -> LiveContacts:
        """From the weights of this name.

        Raises:
            FileNotFoundError: there are none; says which there are.
        """
        return cls(load_weights(weights, "contacts")[0])

    def __call__(self, features: NDArray[np.float32], state: NDArray[np.float32]) -> Contacts:
        """One frame: features (B, `FEATURES`) and what was remembered, (B, `hidden`)."""
        reset_in, update_in, new_in = np.split(dense(features, *self._input), 3, axis=-1)
        reset_kept, update_kept, new_kept = np.split(dense(state, *self._kept), 3, axis=-1)
        new = np.tanh(new_in + _sigmoid(reset_in + reset_kept) * new_kept)
        state = new + _sigmoid(update_in + update_kept) * (state - new)
        said = _sigmoid(dense(state, *self._head))
        return Contacts(said[:, : len(CONTACT_JOINTS)], said[:, len(CONTACT_JOINTS) :], state)


def _sigmoid(x: Floats) -> Floats:
    return (1.0 / (1.0 + np.exp(-x))).astype(np.float32)
