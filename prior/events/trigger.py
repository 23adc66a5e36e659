"""Conditions that begin and end, and the detection of waves.

A condition has two thresholds (hysteresis), a time that it must hold, and takes account of its value's uncertainty. A
raised hand waves if its forearm swings to one side and back, and again.
"""

from __future__ import annotations

import math
from statistics import NormalDist

NEVER = -1


def probability_above(value: float, sigma: float, threshold: float) -> float:
    """Return the probability that a quantity with this estimate and standard deviation exceeds a threshold."""
    if math.isnan(value):
        return 0.0
    return 0.5 * math.erfc((threshold - value) / (max(sigma, 1e-9) * math.sqrt(2.0)))


class Trigger:
    """Hysteresis of one condition of one body: it begins above `on`, and ends below ``on - margin``.

    Args:
        on: the threshold.
        margin: distance below it at which the condition ends.
        hold_s: seconds for which a crossing must last.
        confidence: least probability that a threshold is crossed.

    Attributes:
        active: whether the condition holds.
        since_ns: capture time at which it began: the first time at which it was observed to hold.
        confidence: probability that the value is above the midpoint of both thresholds.
    """

    def __init__(self, on: float, margin: float, hold_s: float, confidence: float) -> None:
        self._on, self._off, self._hold_ns = on, on - margin, round(hold_s * 1e9)
        self._sigmas = NormalDist().inv_cdf(confidence)
        self._changing_ns = NEVER
        self.active = False
        self.since_ns = 0
        self.confidence = 0.0

    def update(self, stamp_ns: int, value: float, sigma: float, possible: bool = True) -> bool:
        """Process the next value; returns whether the condition has begun or ended.

        Args:
            stamp_ns: stamp of the value.
            value: the value; if it is NaN, nothing begins or ends.
            sigma: its standard deviation.
            possible: whether the condition's other requirements hold.
        """
        self.confidence = probability_above(value, sigma, 0.5 * (self._on + self._off))
        doubt = self._sigmas * sigma
        begins, ends = possible and value - doubt > self._on, not possible or value + doubt < self._off
        if not (ends if self.active else begins):
            self._changing_ns = NEVER
            return False
        if self._changing_ns == NEVER:
            self._changing_ns = stamp_ns
        if stamp_ns - self._changing_ns < self._hold_ns:
            return False
        self.active = not self.active
        if self.active:
            self.since_ns = self._changing_ns
        self._changing_ns = NEVER
        return True


SWINGS = 2
"""Number of swings of a wave: out and back. If the swing is not about upright, one more is needed, because an arm that
is raised to the side and lowered also starts like this."""
CENTRED = 0.4
"""Largest angle from upright of the middle of a swing, or of its last part, for a swing about upright, radians."""


class Wave:
    """Detects waves from the turning points of a forearm. One counts when the forearm has returned from it by a swing.

    Args:
        swing: angle of the return, radians.
        within_s: longest time until the next turning point, seconds.
    """

    def __init__(self, swing: float, within_s: float) -> None:
        self._swing, self._within_ns = swing, round(within_s * 1e9)
        self._reset()

    def _reset(self) -> None:
        self._low, self._high = math.inf, -math.inf
        self._about_upright = False
        self._extreme = math.nan
        self._side = self._turns = self._turned_ns = 0

    def update(self, stamp_ns: int, angle: float, upright: bool, up: bool) -> bool:
        """Process the forearm's next angle to one side of upright, radians; returns whether it waves.

        A wave begins while the forearm is ``upright``, and continues while the hand is ``up``, because in a wave with
        the whole arm, the forearm is almost horizontal at each end. An angle of NaN (an unobserved arm) is no swing.
        """
        if not (up if self._turns else upright):
            self._reset()
            return False
        if self._turns and stamp_ns - self._turned_ns > self._within_ns:
            self._reset()
        if math.isnan(angle):
            return self._waves()
        self._low, self._high = min(self._low, angle), max(self._high, angle)
        if self._side <= 0 and angle - self._low > self._swing:
            self._turn(1, stamp_ns, angle, self._low, self._high)
        elif self._side >= 0 and self._high - angle > self._swing:
            self._turn(-1, stamp_ns, angle, self._high, self._low)
        return self._waves()

    def _waves(self) -> bool:
        return self._turns > SWINGS or (self._turns == SWINGS and self._about_upright)

    def _turn(self, side: int, stamp_ns: int, angle: float, extreme: float, before: float) -> None:
        whole = extreme + (self._extreme if self._turns else before)
        self._about_upright = min(abs(whole), abs(extreme + angle)) < 2.0 * CENTRED
        self._extreme = extreme
        self._side = side
        self._low = self._high = angle
        self._turns += 1
        self._turned_ns = stamp_ns


class RandomWalk:
    """A random-walk Kalman filter of a quantity that a sensor shakes by more than people change it.

    All coordinates are filtered alike. The more accurate the observations, the less it averages.

    Args:
        change: RMS change of a coordinate in one second, in its unit.
    """

    def __init__(self, change: float) -> None:
        self._density = change * change
        self._stamp_ns, self._value, self._variance = NEVER, (math.nan,), math.inf

    def update(self, stamp_ns: int, value: tuple[float, ...], sigma: float) -> tuple[tuple[float, ...], float]:
        """Update with the next observation; returns the coordinates and their standard deviation; NaN if unknown."""
        if any(map(math.isnan, value)):
            self._stamp_ns = NEVER
            return value, math.nan
        if self._stamp_ns == NEVER:
            self._value, self._variance = value, sigma * sigma
        else:
            self._variance += self._density * (stamp_ns - self._stamp_ns) * 1e-9
            gain = self._variance / max(self._variance + sigma * sigma, 1e-12)
            self._value = tuple(old + gain * (new - old) for old, new in zip(self._value, value, strict=True))
            self._variance *= 1.0 - gain
        self._stamp_ns = stamp_ns
        return self._value, math.sqrt(self._variance)
