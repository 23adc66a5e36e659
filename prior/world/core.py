"""The stages of `pose/world` in order, for all bodies of one message."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from steadypose.prior.models.contacts import Contacts
from steadypose.prior.world.feet import Feet, FeetState
from steadypose.prior.world.filter import RootFilter, RootState
from steadypose.prior.world.floor import Floor
from steadypose.prior.world.kalman import BodyNoise
from steadypose.prior.world.networks import (
    ContactMemory,
    ContactNetwork,
    MotionMemory,
    RootVelocity,
    Stance,
    VelocityNetwork,
    stance,
)
from steadypose.prior.world.observe import BodyObservation
from steadypose.prior.world.settings import TrajectorySettings

_NO_STANCE = Stance(np.zeros(4), np.zeros(4))


@dataclass(frozen=True)
class BodyEstimate:
    """What the stages estimate of one body of a message.

    Attributes:
        observed: the input.
        velocity: of the root, as predicted; None if that is switched off.
        contacts: as predicted.
        stance: feet that may hold the root.
        root: root and feet, by the filter.
        feet: as they are to be published.
    """

    observed: BodyObservation
    velocity: RootVelocity | None
    contacts: Contacts
    stance: Stance
    root: RootState
    feet: FeetState


@dataclass
class BodyStages:
    """The stages' state of one body, made afresh for each: nothing of another can be left in it."""

    observed: BodyObservation
    motion: MotionMemory
    contacts: ContactMemory
    filter: RootFilter
    feet: Feet = field(default_factory=Feet)


class Scene:
    """What is known of one source: its floor and its bodies, which share it.

    Args:
        calibrated: whether the floor is known to be at z = 0.

    Attributes:
        stamp_ns: of its newest message; negative before the first.
        floor: that all its bodies stand on.
        bodies: by id.
    """

    def __init__(self, calibrated: bool) -> None:
        self.calibrated, self.stamp_ns = calibrated, -1
        self.floor = Floor(calibrated)
        self.bodies: dict[int, BodyStages] = {}

    def advance(self, stamp_ns: int, timeout_ns: int) -> None:
        """Advance to a message; bodies that none of the last ``timeout_ns`` mentioned are dropped."""
        self.stamp_ns = stamp_ns
        self.bodies = {i: b for i, b in self.bodies.items() if stamp_ns - b.observed.stamp_ns <= timeout_ns}

    @property
    def last(self) -> dict[int, BodyObservation]:
        """The newest observation of each body, by id."""
        return {i: body.observed for i, body in self.bodies.items()}


class WorldCore:
    """From observations to estimates; keeps no state but the networks.

    A message's observation of a body goes through the stages in the order of `step`; each stage's state is in the
    body's `BodyStages`, so that to forget a body is to drop that one object.

    Raises:
        FileNotFoundError: a weight set that does not exist; says which do.
    """

    def __init__(self, settings: TrajectorySettings) -> None:
        self._predicts, self._anchors = settings.network, settings.contacts
        self._velocity = VelocityNetwork(settings.weights)
        self._contacts = ContactNetwork(settings.contact_weights)
        self._noise = BodyNoise(settings.acceleration, network_memory_s=self._velocity.memory_s)

    def step(self, scene: Scene, observations: Sequence[BodyObservation]) -> list[BodyEstimate]:
        """Estimates of a message's bodies, in its order; without those that had no root so far."""
        observed = [o for o in observations if o.root_known or o.body.id in scene.bodies]
        bodies = [self._stages(scene, o) for o in observed]
        velocities: Sequence[RootVelocity | None] = [None] * len(bodies)
        if self._predicts:
            velocities = self._velocity.update([body.motion for body in bodies], observed)
        all_contacts = self._contacts.update([body.contacts for body in bodies], observed, scene.floor)
        estimates = []
        for body, now, velocity, contacts in zip(bodies, observed, velocities, all_contacts, strict=True):
            holding = stance(contacts, now, body.filter.feet_off) if self._anchors else _NO_STANCE
            scene.floor.update(now, holding.rest)
            root = body.filter.update(now, velocity, holding, scene.floor)
            feet = body.feet.update(now, root, holding.rest, scene.floor)
            estimates.append(BodyEstimate(now, velocity, contacts, holding, root, feet))
        return estimates

    def _stages(self, scene: Scene, observed: BodyObservation) -> BodyStages:
        """Those of a body, new ones for one that is new."""
        body = scene.bodies.get(observed.body.id)
        if body is None:
            motion, contacts = self._velocity.memory(), self._contacts.memory()
            body = BodyStages(observed, motion, contacts, RootFilter(observed, self._noise))
            scene.bodies[observed.body.id] = body
        body.observed = observed
        return body
