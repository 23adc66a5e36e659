"""Where a robot's foot should be: where the person's is, or held flat on the floor while that foot stands."""

from typing import NamedTuple

import numpy as np

from steadypose.prior.arrays import Floats
from steadypose.prior.body.kinematics import yaw_matrix
from steadypose.prior.sim.gait import minimum_jerk

STANDS, LIFTS = 0.6, 0.4  # contact probabilities above which a foot stands, and below which it lifts
LAND_S, RELEASE_S = 0.1, 0.15
"""Times in which a landing foot comes down flat, and a lifting foot moves to the person's, seconds."""
LANDED = 0.01
"""Distance from where it is to stand within which a foot has landed and is published as standing, metres. A person's
contact probability rises before the robot's foot, of other proportions, is on the floor."""
TOO_FAR = 0.3  # distance between a standing foot and its target at which it is released anyway, metres
TURNED = 1.0  # angle between a standing foot's heading and the person's at which it is released anyway, radians
FREE, HELD = (5.0, 0.5), (100.0, 10.0)
"""Costs of a metre and of a radian of error, of a free and of a held foot. A free foot whose target is out of reach
must not tear off the other."""


class Target(NamedTuple):
    """Where a foot should be."""

    turn: Floats  # (3, 3) rotation of the link, world
    place: Floats  # (3,) position of the link, world, metres
    costs: tuple[float, float]  # costs of a metre and of a radian of error


class Foot:
    """One foot of a robot.

    ``rest`` is the rotation (3, 3) of the foot's link while the robot stands facing +x, ``sole`` the height of the
    link's origin above the floor then, metres. It ``stands`` while the person's foot does, and the robot's is held or
    on its way down; then it has ``landed``.
    """

    def __init__(self, rest: Floats, sole: float) -> None:
        self._rest, self._sole = rest, sole
        self.lift()

    def lift(self) -> None:
        """Forget where it stands."""
        self.stands = self.landed = False
        self._spot: tuple[Floats, Floats] | None = None
        self._from = (self._rest, np.zeros(3))
        self._stood, self._free = 0.0, 1.0

    def target(self, turn: Floats, place: Floats, touching: float, now: tuple[Floats, Floats], dt: float) -> Target:
        """Where the foot should be, ``dt`` seconds after the last frame.

        ``turn`` (3, 3) and ``place`` (3,) are the link's rotation and position as the person's foot has them,
        ``touching`` is the probability that it stands, and ``now`` are the link's rotation and position.
        """
        heading = _heading(turn @ self._rest.T)
        far = self._spot is not None and self._far(self._spot[1], heading, place)
        stands = not far and touching > (LIFTS if self.stands else STANDS)
        if stands and not self.stands:
            self._spot, self._free = (yaw_matrix(heading) @ self._rest, np.array([*now[1][:2], self._sole])), 1.0
            self._stood = heading
            self._from = now
        self.stands, self.landed = stands, stands and self.landed
        self._free = min(max(self._free + (-dt / LAND_S if stands else dt / RELEASE_S), 0.0), 1.0)
        if not stands and self._free >= 1.0:
            self._spot = None
        if self._spot is None:
            return Target(turn, place, FREE)
        if self._free <= 0.0:
            return Target(*self._spot, HELD)
        share = float(minimum_jerk(self._free))
        costs = HELD[0] + share * (FREE[0] - HELD[0]), HELD[1] + share * (FREE[1] - HELD[1])
        other = self._from if stands else (turn, place)
        at = self._spot[1] + share * (other[1] - self._spot[1])
        return Target(_between(self._spot[0], other[0], share), at, costs)

    def _far(self, spot: Floats, heading: float, place: Floats) -> bool:
        turned = (heading - self._stood + np.pi) % (2 * np.pi) - np.pi
        return bool(np.linalg.norm((spot - place)[:2]) > TOO_FAR or abs(turned) > TURNED)

    def moved(self, place: Floats) -> None:
        """Note the link's position (3,) after a frame: a foot that comes to stand is held where it did."""
        if self.stands and not self.landed and self._spot and np.linalg.norm(place - self._spot[1]) < LANDED:
            self.landed = True
            self._spot[1][:2] = place[:2]


def _heading(turn: Floats) -> float:
    return float(np.arctan2(turn[1, 0], turn[0, 0]))


def _between(a: Floats, b: Floats, share: float) -> Floats:
    """The rotation (3, 3) that is a ``share`` of the way from ``a`` to ``b``."""
    from mink import SO3

    return SO3.from_matrix(a).interpolate(SO3.from_matrix(b), share).as_matrix()
