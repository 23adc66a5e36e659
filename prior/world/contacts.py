"""Contacts of all bodies, by a recurrent network: what bears load, what rests, and which feet may hold a root."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import CONTACT_JOINTS
from steadypose.prior.models.contacts import Contacts, LiveContacts, contact_features
from steadypose.prior.models.root_velocity import FRAME_S
from steadypose.prior.world.floor import Floor
from steadypose.prior.world.observe import FEET, BodyObservation

MOVED_SIGMAS = 3.0
"""Distance between a standing foot and where it is observed from which on it has evidently moved, standard
deviations: it stands anew."""

_FOOT_CONTACTS = [CONTACT_JOINTS.index(joint) for joint in FEET]


class Stance(NamedTuple):
    """Feet that may hold the root.

    Attributes:
        load: (4,) probabilities that `FEET` bear load; 0 of those that may not hold it.
        rest: (4,) that they stand still, likewise.
    """

    load: Floats
    rest: Floats


def stance(contacts: Contacts, observed: BodyObservation, feet_off: Floats) -> Stance:
    """Which feet may hold a root.

    Not those of a body without a root; nor those that nobody observed, if nobody observed the root; nor those that
    were last ``feet_off`` (4,) standard deviations off, if that is too far.
    """
    holds = (observed.feet_observed | observed.root_observed) & (feet_off < MOVED_SIGMAS) & observed.root_known
    return Stance(*(holds * p[_FOOT_CONTACTS].astype(np.float64) for p in (contacts.load, contacts.rest)))


class ContactMemory:
    """What is kept of a body from frame to frame: its last observation, and the network's state (hidden,)."""

    def __init__(self, hidden: int) -> None:
        self.observed: BodyObservation | None = None
        self.state = np.zeros(hidden, dtype=np.float32)


class ContactNetwork:
    """Predicts the contacts of all bodies of a message at once.

    Args:
        weights: the weight set, or a path to a ``.safetensors`` file.
    """

    def __init__(self, weights: str) -> None:
        self._net = LiveContacts.load(weights)

    def memory(self) -> ContactMemory:
        """That of a new body."""
        return ContactMemory(self._net.hidden)

    def update(
        self, memories: Sequence[ContactMemory], observed: Sequence[BodyObservation], floor: Floor
    ) -> list[Contacts]:
        """Of each body: load (8,), rest (8,) and the state (hidden,) that its memory then keeps."""
        if not observed:
            return []
        before, states, dt = [], [], []
        for memory, now in zip(memories, observed, strict=True):
            anew = memory.observed is None or now.after_gap
            before.append(now if anew else memory.observed)
            states.append(np.zeros_like(memory.state) if anew else memory.state)
            dt.append(FRAME_S if anew else now.dt)
        roots = [now.root_observed and last.root_observed for now, last in zip(observed, before, strict=True)]
        features = contact_features(
            np.array([now.positions for now in observed]), np.array([last.positions for last in before]),
            np.array(dt), np.array([now.yaw for now in observed]), np.array([now.sigma for now in observed]),
            root_seen=np.array(roots, dtype=float),
            ground=np.array([_under(now, floor, known) for now, known in zip(observed, roots, strict=True)]),
        )  # fmt: skip
        contacts = [Contacts(*rows) for rows in zip(*self._net(features, np.array(states)), strict=True)]
        for memory, now, after in zip(memories, observed, contacts, strict=True):
            memory.observed, memory.state = now, after.state
        return contacts


def _under(observed: BodyObservation, floor: Floor, known: bool) -> Floats:
    """(8,) metres, the height of what is under each contact joint: under a foot, or else under the lowest; NaN where
    not ``known``."""
    under = np.full(len(CONTACT_JOINTS), np.nan)
    if known:
        soles = observed.soles
        under[:] = floor.under(soles[np.argmin(np.nan_to_num(soles[:, 2], nan=np.inf))])
        under[_FOOT_CONTACTS] = np.fmax([floor.under(sole) for sole in soles], under[_FOOT_CONTACTS])
    return under
