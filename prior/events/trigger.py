"""Conditions that begin and end, and the detection of waves.

A condition has two thresholds (hysteresis), a time that it must hold, and takes account of its value's uncertainty. A
raised hand waves if its forearm swings to one side and back.
"""

from __future__ import annotations

import math
from collections import deque
from statistics import NormalDist
from typing import NamedTuple

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
        """Process the next value and its standard deviation; returns whether the condition has begun or ended. A NaN
        changes nothing. If its other requirements are not met (not ``possible``), a condition ends."""
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
"""Number of swings of a wave: out and back. If they are not about upright, one more is needed, because an arm that is
raised to the side and lowered also starts like this."""
OUT = 0.45
"""Least size of a wave's first swing, as a fraction of the others': it begins in the middle, and smoothing reduces it
most."""
CENTRED = 0.45  # largest mean angle from upright of two swings about upright, radians
SPEED, SPEED_NS = 1.0, 140_000_000
"""Least speed of the forearm when a swing counts, radians per second, and the time over which it is measured,
nanoseconds. A raised hand that drifts is slower, as is a joint that jumped while it was hidden and came to rest."""
LEVEL = 0.08
"""Largest change of the hand's height in a swing about upright, metres: that of an arm raised aside or lowered is
larger."""


class _Moment(NamedTuple):
    angle: float
    height: float
    stamp_ns: int


class Wave:
    """Detects waves from the swings of a forearm between its turns.

    Args:
        swing: angle from the last turn at which a swing counts, radians.
        within_s: longest duration of a swing, and longest time between two that count, seconds.
    """

    def __init__(self, swing: float, within_s: float) -> None:
        self._swing, self._within_ns = swing, round(within_s * 1e9)
        self._reset()

    def _reset(self) -> None:
        self._recent: deque[_Moment] = deque()
        self._turns: list[_Moment] = []
        self._side = self._swings = self._swung_ns = 0
        self._counted = self._waves = False

    def update(self, stamp_ns: int, angle: float, height: float, upright: bool, up: bool) -> bool:
        """Process the forearm's next angle to one side of upright, radians; returns whether it waves.

        A wave begins while the forearm is ``upright``, and continues while the hand is ``up``, because in a wave with
        the whole arm, the forearm is almost horizontal at each end. An angle of NaN (an unobserved arm) is no swing.
        ``height`` is that of the hand, metres.
        """
        if not (up if self._swings else upright):
            self._reset()
            return False
        if stamp_ns - self._swung_ns > self._within_ns:
            self._swings, self._waves = 0, False
        if not math.isnan(angle):
            self._follow(angle, height, stamp_ns)
        return self._waves

    def _follow(self, angle: float, height: float, stamp_ns: int) -> None:
        """Find the forearm's turns, and count its swings."""
        if self._recent:  # an angle that passes half a turn continues there
            angle = self._recent[-1].angle + math.remainder(angle - self._recent[-1].angle, math.tau)
        now = _Moment(angle, height, stamp_ns)
        if not self._recent:
            self._low = self._high = now
        self._recent.append(now)
        while stamp_ns - self._recent[0].stamp_ns > SPEED_NS:
            self._recent.popleft()
        self._low = now if angle <= self._low.angle else self._low
        self._high = now if angle >= self._high.angle else self._high
        if self._side <= 0 and angle - self._low.angle > OUT * self._swing:
            self._side, self._counted, self._turns, self._high = 1, False, [*self._turns[-1:], self._low], now
        elif self._side >= 0 and self._high.angle - angle > OUT * self._swing:
            self._side, self._counted, self._turns, self._low = -1, False, [*self._turns[-1:], self._high], now
        if self._turns and not self._counted and abs(angle - self._turns[-1].angle) > self._swing:
            self._counted = True
            self._count(now)

    def _count(self, now: _Moment) -> None:
        """Count the swing from the last turn, and the first one before it, which may be smaller."""
        before, turn, then = self._turns[0], self._turns[-1], self._recent[0]
        slow = abs(now.angle - then.angle) <= SPEED * (now.stamp_ns - then.stamp_ns) * 1e-9
        if now.stamp_ns - turn.stamp_ns > self._within_ns or (slow and not self._waves):
            self._swings = 0
            return
        if not self._swings and 0 < turn.stamp_ns - before.stamp_ns < self._within_ns:
            self._swings = 1
        self._swings += 1
        self._swung_ns = now.stamp_ns
        centred = abs(turn.angle + 0.5 * (before.angle + now.angle)) < 2.0 * CENTRED
        about_upright = centred and abs(now.height - turn.height) < LEVEL
        self._waves |= self._swings > SWINGS or (self._swings == SWINGS and about_upright)


class RandomWalk:
    """A random-walk Kalman filter of a quantity whose observations have more noise than people's motion causes change:
    ``change`` (RMS) in one second. All coordinates are filtered alike."""

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
