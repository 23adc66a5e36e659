"""Live inference of a gated recurrent unit (Cho et al. 2014) and a linear layer, frame by frame, without torch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.arrays import Floats32
from steadypose.prior.models.layers import dense
from steadypose.prior.models.weights import Arrays


class LiveRecurrent:
    """A trained network of torch's ``GRU`` and ``Linear``.

    Args:
        weights: its state dict, with the linear layer as ``head``.
        unit: name of the GRU in the state dict.

    Attributes:
        hidden: size of a body's hidden state, which is zero before the first frame.
    """

    def __init__(self, weights: Arrays, unit: str) -> None:
        self._input = weights[f"{unit}.weight_ih_l0"], weights[f"{unit}.bias_ih_l0"]
        self._kept = weights[f"{unit}.weight_hh_l0"], weights[f"{unit}.bias_hh_l0"]
        self._head = weights["head.weight"], weights["head.bias"]
        self.hidden = weights["head.weight"].shape[1]

    def __call__(self, features: NDArray[np.float32], state: NDArray[np.float32]) -> tuple[Floats32, Floats32]:
        """Return the head's outputs (B, O) for one frame's features (B, F), and the next hidden state (B, `hidden`)."""
        reset_in, update_in, new_in = np.split(dense(features, *self._input), 3, axis=-1)
        reset_kept, update_kept, new_kept = np.split(dense(state, *self._kept), 3, axis=-1)
        new = np.tanh(new_in + sigmoid(reset_in + reset_kept) * new_kept)
        state = new + sigmoid(update_in + update_kept) * (state - new)
        return dense(state, *self._head), state


def sigmoid(x: Floats32) -> Floats32:
    """The logistic function."""
    return (1.0 / (1.0 + np.exp(-x))).astype(np.float32)
