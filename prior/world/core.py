"""Runs the stages of `pose/world` in order, for all bodies of one message."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from steadypose.prior.arrays import Bools, Floats32
from steadypose.prior.models.contacts import Contacts
from steadypose.prior.world.feet import Feet, FeetState
from steadypose.prior.world.filter import RootFilter, RootState
from steadypose.prior.world.floor import Floor
from steadypose.prior.world.kalman import BodyNoise
from steadypose.prior.world.networks import ContactNetwork, MotionMemory, RootVelocity, Stance, VelocityNetwork, stance
from steadypose.prior.world.observe import FEET_OF_LEGS, BodyObservation, LegMemory
from steadypose.prior.world.settings import TrajectorySettings

_NO_STANCE = Stance(np.zeros(4), np.zeros(4))


@dataclass(frozen=True)
class BodyEstimate:
    """The stages' estimates for one body of a message."""

    observed: BodyObservation  # the input
    contacts: Contacts  # predicted contacts
    guessed: Bools  # (6,) which joints of legs (`LEG_CONTACTS`) are only guesses
    stance: Stance  # feet that may anchor the root
    root: RootState  # the filter's estimate of root and feet
    feet: FeetState  # feet for publication


@dataclass
class BodyStages:
    """State of all stages for one body. Each body gets a new one, so that no state of another body can remain."""

    observed: BodyObservation  # the newest
    before: BodyObservation  # the one before it, for a new body the same
    motion: MotionMemory
    contacts: Floats32  # (hidden,) hidden state of the contact network
    filter: RootFilter
    legs: LegMemory = field(default_factory=LegMemory)
    feet: Feet = field(default_factory=Feet)


class Scene:
    """State of one source: the stages' state of each body, by id, and the floor on which all stand.

    If ``calibrated``, the floor is known to be at z = 0. ``stamp_ns`` is of the newest message; negative before the
    first.
    """

    def __init__(self, calibrated: bool) -> None:
        self.calibrated, self.stamp_ns = calibrated, -1
        self.floor = Floor(calibrated)
        self.bodies: dict[int, BodyStages] = {}

    def advance(self, stamp_ns: int, timeout_ns: int) -> None:
        """Advance to a message, and drop bodies that no message has contained for ``timeout_ns``."""
        self.stamp_ns = stamp_ns
        self.bodies = {i: b for i, b in self.bodies.items() if stamp_ns - b.observed.stamp_ns <= timeout_ns}


class WorldCore:
    """Turns observations into estimates. It holds the networks and no other state.

    `step` passes each body's observation through the stages in order. The state of all stages is in the body's
    `BodyStages`, so dropping that object forgets the body.

    Raises:
        FileNotFoundError: a weight set does not exist; the message lists those that do.
    """

    def __init__(self, settings: TrajectorySettings) -> None:
        self._predicts, self._anchors = settings.network, settings.contacts
        self._velocity = VelocityNetwork(settings.weights)
        self._contacts = ContactNetwork(settings.contact_weights)
        self._noise = BodyNoise(settings.acceleration, network_memory_s=self._velocity.memory_s)

    def step(self, scene: Scene, observations: Sequence[BodyObservation]) -> list[BodyEstimate]:
        """Estimate a message's bodies, in its order, without bodies that have had no root so far."""
        observed = [o for o in observations if o.root_known or o.body.id in scene.bodies]
        bodies = [self._stages(scene, o) for o in observed]
        velocities: Sequence[RootVelocity | None] = [None] * len(bodies)
        if self._predicts:
            velocities = self._velocity.update([body.motion for body in bodies], observed)
        states, before = [body.contacts for body in bodies], [body.before for body in bodies]
        all_contacts = self._contacts.update(states, before, observed, scene.floor)
        estimates = []
        for body, now, velocity, contacts in zip(bodies, observed, velocities, all_contacts, strict=True):
            body.contacts = contacts.state
            guessed = body.legs.update(now)
            holding = stance(contacts, now, body.filter.feet_off) if self._anchors else _NO_STANCE
            scene.floor.update(now, holding.rest, guessed[FEET_OF_LEGS])
            root = body.filter.update(now, velocity, holding, scene.floor)
            feet = body.feet.update(now, root, holding.rest, scene.floor)
            estimates.append(BodyEstimate(now, contacts, guessed, holding, root, feet))
        return estimates

    def _stages(self, scene: Scene, observed: BodyObservation) -> BodyStages:
        """Return the stages' state of a body, created if the body is new."""
        body = scene.bodies.get(observed.body.id)
        if body is None:
            motion, contacts = self._velocity.memory(), self._contacts.memory()
            body = BodyStages(observed, observed, motion, contacts, RootFilter(observed, self._noise))
            scene.bodies[observed.body.id] = body
        body.before, body.observed = body.observed, observed
        return body
