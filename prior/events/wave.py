"""Whether a raised hand waves: its forearm swings to one side and back, and again."""

from __future__ import annotations

import math

SWINGS = 2
"""out and back"""


class Wave:
    """The turning points of a forearm's swing; one counts once the forearm has come back from it by a swing.

    Args:
        swing: radians that it comes back.
        within_s: seconds in which the next turning point comes.
    """

    def __init__(self, swing: float, within_s: float) -> None:
        self._swing, self._within_ns = swing, round(within_s * 1e9)
        self._reset()

    def _reset(self) -> None:
        self._low, self._high = math.inf, -math.inf
        self._side = self._turns = self._turned_ns = 0

    def update(self, stamp_ns: int, angle: float, upright: bool, up: bool) -> bool:
        """Whether it waves, with the forearm's next angle in radians to one side of upright.

        It begins while the forearm is ``upright``, and goes on while the hand is ``up``: who waves with the whole arm
        comes near level at each end.
        """
        if not (up if self._turns else upright) or math.isnan(angle):
            self._reset()
            return False
        if self._turns and stamp_ns - self._turned_ns > self._within_ns:
            self._reset()
        self._low, self._high = min(self._low, angle), max(self._high, angle)
        if self._side <= 0 and angle - self._low > self._swing:
            self._turn(1, stamp_ns, angle)
        elif self._side >= 0 and self._high - angle > self._swing:
            self._turn(-1, stamp_ns, angle)
        return self._turns >= SWINGS

    def _turn(self, side: int, stamp_ns: int, angle: float) -> None:
        self._side = side
        self._low = self._high = angle
        self._turns += 1
        self._turned_ns = stamp_ns
