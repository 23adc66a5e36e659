"""Recurrent networks' predictions for bodies in the world: root velocity and contacts.

Root velocity is predicted from the body's own motion (the task of HM-VAE, section 3.3). Contacts are predicted as load
and rest, which determine the feet that may anchor the root.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from steadypose.prior.arrays import Floats, Floats32
from steadypose.prior.body.kinematics import CONTACT_JOINTS, yaw_matrix
from steadypose.prior.body.skeleton import REST_POSITIONS
from steadypose.prior.models.contacts import Contacts, LiveContacts, contact_features
from steadypose.prior.models.root_velocity import FRAME_S, LiveRootVelocity, velocity_features
from steadypose.prior.world.floor import Floor
from steadypose.prior.world.observe import FEET, BodyObservation

CAMERA_ERROR, CAMERA_MEMORY_S = 2.0, 0.3
"""Ratio of the velocity's error on a camera's poses to its error on motion capture (validation), and the error's least
time constant, seconds. On simulated streams, half of an error remained after 0.5 s."""

SCALE_FACTOR_ERROR = 0.35
"""Standard deviation of the predicted speed's scale factor, which the network's own standard deviation omits."""

MOVED_SIGMAS = 3.0
"""Distance between a standing foot and its observation above which the foot has moved, standard deviations."""

_FOOT_CONTACTS = [CONTACT_JOINTS.index(joint) for joint in FEET]


class RootVelocity(NamedTuple):
    """The predicted root velocity of a body, in the world."""

    velocity: Floats  # (3,) m/s
    sigma: Floats  # (3,) m/s, standard deviation, calibrated on validation


@dataclass
class MotionMemory:
    """State of the velocity network for one body: its hidden state (hidden,), and its last joints."""

    state: Floats32
    local: Floats | None = None

    def update(self, observed: BodyObservation) -> tuple[Floats, Floats, float]:
        """Return this frame's and the last frame's joints (22, 3), metres from the root, world axes, and the seconds
        between.

        After a gap, motion starts anew. A joint without a position keeps its last position relative to the root.
        """
        before = self.local
        last = REST_POSITIONS @ yaw_matrix(observed.yaw).T if before is None else before
        local = observed.positions - observed.positions[0]
        self.local = local = np.where(np.isfinite(local), local, last)
        if before is None or observed.after_gap:
            self.state = np.zeros_like(self.state)
            return local, local, FRAME_S
        return local, last, max(observed.dt, FRAME_S)


class VelocityNetwork:
    """Predicts the root velocity of all bodies of a message at once. ``memory_s`` (3,) are time constants of its
    errors."""

    def __init__(self, weights: str) -> None:
        self._net = LiveRootVelocity.load(weights)
        config, horizontal_first = self._net.config, [0, 0, 1]
        self._scale = CAMERA_ERROR * np.array(config.sigma_scale)[horizontal_first]
        self.memory_s = np.maximum(np.array(config.correlation_s)[horizontal_first] / 2.0, CAMERA_MEMORY_S)

    def memory(self) -> MotionMemory:
        """Return the state of a new body."""
        return MotionMemory(np.zeros(self._net.config.hidden, dtype=np.float32))

    def update(self, memories: Sequence[MotionMemory], observed: Sequence[BodyObservation]) -> list[RootVelocity]:
        """Predict the velocity of each body, and update the bodies' ``memories``."""
        if not observed:
            return []
        parts = zip(*(memory.update(each) for memory, each in zip(memories, observed, strict=True)), strict=True)
        local, before, dt = (np.array(part) for part in parts)
        yaw = np.array([each.yaw for each in observed])
        state = np.array([memory.state for memory in memories])
        velocity, log_sigma, states = self._net(velocity_features(local, before, dt, yaw), state)
        for memory, after in zip(memories, states, strict=True):
            memory.state = after
        variance = np.exp(2.0 * log_sigma)
        variance[:, :2] = variance[:, :2].mean(axis=1, keepdims=True)  # the filter assumes isotropic horizontal noise
        speed = np.linalg.norm(velocity[:, :2], axis=1, keepdims=True)
        sigma = np.hypot(np.sqrt(variance) * self._scale, SCALE_FACTOR_ERROR * speed)
        return [RootVelocity(yaw_matrix(o.yaw) @ v, s) for o, v, s in zip(observed, velocity, sigma, strict=True)]


class Stance(NamedTuple):
    """Feet that may anchor the root."""

    load: Floats  # (4,) probabilities that `FEET` bear load; 0 for feet that may not anchor the root
    rest: Floats  # (4,) probabilities that they rest; 0 likewise


def stance(contacts: Contacts, observed: BodyObservation, feet_off: Floats) -> Stance:
    """Select the feet that may anchor the root.

    A foot may not if the body has no root, if neither the foot nor the root was observed, or if its last observation
    was too far from its estimate: ``feet_off`` (4,), in standard deviations.
    """
    holds = (observed.feet_observed | observed.root_observed) & (feet_off < MOVED_SIGMAS) & observed.root_known
    return Stance(*(holds * p[_FOOT_CONTACTS].astype(np.float64) for p in (contacts.load, contacts.rest)))


class ContactNetwork:
    """Predicts the contacts of all bodies of a message at once."""

    def __init__(self, weights: str) -> None:
        self._net = LiveContacts.load(weights)

    def memory(self) -> Floats32:
        """Return the hidden state (hidden,) of a new body."""
        return np.zeros(self._net.hidden, dtype=np.float32)

    def update(
        self,
        states: Sequence[Floats32],
        before: Sequence[BodyObservation],
        observed: Sequence[BodyObservation],
        floor: Floor,
    ) -> list[Contacts]:
        """Predict each body's load (8,), rest (8,) and new hidden state (hidden,), from its hidden state and its
        observation of ``before``. After a gap, motion starts anew."""
        if not observed:
            return []
        states = [np.zeros_like(s) if now.after_gap else s for s, now in zip(states, observed, strict=True)]
        before = [now if now.after_gap else last for last, now in zip(before, observed, strict=True)]
        dt = [FRAME_S if now.after_gap else now.dt for now in observed]
        roots = [now.root_observed and last.root_observed for now, last in zip(observed, before, strict=True)]
        features = contact_features(
            np.array([now.positions for now in observed]), np.array([last.positions for last in before]),
            np.array(dt), np.array([now.yaw for now in observed]), np.array([now.sigma for now in observed]),
            root_observed=np.array(roots, dtype=float),
            ground=np.array([_under(now, floor, known) for now, known in zip(observed, roots, strict=True)]),
        )  # fmt: skip
        return [Contacts(*rows) for rows in zip(*self._net(features, np.array(states)), strict=True)]


def _under(observed: BodyObservation, floor: Floor, known: bool) -> Floats:
    """(8,) metres, height of the ground under each contact joint; NaN if not ``known``.

    For joints other than the feet, and for feet over unknown ground, it is the ground under the lowest foot.
    """
    under = np.full(len(CONTACT_JOINTS), np.nan)
    if known:
        soles = observed.soles
        under[:] = floor.under(soles[np.argmin(np.nan_to_num(soles[:, 2], nan=np.inf))])
        under[_FOOT_CONTACTS] = np.fmax([floor.under(sole) for sole in soles], under[_FOOT_CONTACTS])
    return under
