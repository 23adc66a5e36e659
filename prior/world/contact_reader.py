"""The contact network, asked about the newest frame of every body at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from steadypose.prior.models.contacts.features import contact_features
from steadypose.prior.models.contacts.inference import Contacts, LiveContacts

Floats = NDArray[np.float64]


class Glimpse(NamedTuple):
    """What the network is to read of one body's newest frame; see `contact_features`.

    Attributes:
        positions, before: (22, 3) metres, world, of this message and the last.
        dt: seconds between them.
        yaw: radians.
        sigma: (22,) metres.
        root_seen: whether the root was in both.
        ground: (8,) metres, world.
        state: (hidden,) what the network remembers of the body.
    """

    positions: Floats
    before: Floats
    dt: float
    yaw: float
    sigma: Floats
    root_seen: bool
    ground: Floats
    state: NDArray[np.float32]


class ContactReader:
    """Args: weights: the weight set, or a path to a ``.safetensors`` file."""

    def __init__(self, weights: str) -> None:
        self._net = LiveContacts.load(weights)

    @property
    def nothing(self) -> NDArray[np.float32]:
        """(hidden,) what the network remembers before a body's first frame."""
        return np.zeros(self._net.hidden, dtype=np.float32)

    def read(self, glimpses: Sequence[Glimpse]) -> list[Contacts]:
        """Of each body: load (8,), rest (8,), and what to remember (hidden,)."""
        if not glimpses:
            return []
        columns = [np.array(column) for column in zip(*glimpses, strict=True)]
        features = contact_features(*columns[:5], root_seen=columns[5].astype(float), ground=columns[6])
        return [Contacts(*rows) for rows in zip(*self._net(features, columns[7]), strict=True)]
