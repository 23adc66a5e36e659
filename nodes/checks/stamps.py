"""Checks of stamps: nanoseconds, of capture, increasing, and close to the present."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.types import Level
from steadypose.nodes.checks.problem import Problem, error, warning
from steadypose.prior.timing.rate import FPS

SECOND_NS = 1_000_000_000
ENOUGH = 10  # smallest number of messages to judge by
RATES_HZ = (4.0, 300.0)  # range of trackers' frame rates, Hz
SLOW_HZ = 9.0  # frame rate below which half of the motion is lost between two frames, Hz
UNITS = {"seconds": 1e9, "milliseconds": 1e6, "microseconds": 1e3, "ticks of 100 ns": 100.0}
AHEAD_NS = 300_000_000
"""Largest tolerated lead of stamps over this machine's clock, nanoseconds. Two clocks set by hand stay below it."""
UNSORTED = 2 / 3  # share of stamps older than an earlier one from which no useful output is possible, ratio
STEP_NS = 500_000_000
"""Change of the offset between stamps and clock, between two messages, that shows that a clock was set, ns."""
SECONDS_BELOW = 10**11  # upper bound of stamps that may be seconds since 1970, seconds; valid until the year 5138
SETTLED = 8  # smallest number of messages before and after such a step


def check_stamps(stamps: NDArray[np.int64], arrived: NDArray[np.int64] | None) -> Iterator[Problem]:
    """Problems with the stamps (T,) of a window, ns. ``arrived`` (T,) are wall times, of a live stream only."""
    if len(stamps) < ENOUGH:
        return
    if (problem := _unit(stamps)) is not None:
        yield problem
        return
    steps = np.diff(stamps)
    if (steps < 0).sum() > max(1, 0.1 * len(steps)):
        got = f"{(steps < 0).sum()} of the last {len(steps)} stamps are older than the one before"
        remedy = "publish frames in the order of their capture, from one thread; sort a file's rows by stamp"
        problem = warning("stamps_out_of_order", f"{got}: expected increasing stamps; {remedy}")
        # of two threads' frames every other one is late; of an unsorted file's nearly all, and these are not used
        if (stamps < np.maximum.accumulate(stamps)).mean() > UNSORTED:
            yield replace(problem, level=Level.ERROR)
            return
        yield problem
    elif (steps == 0).sum() > 0.3 * len(steps):
        got = f"{(steps == 0).sum()} of the last {len(steps)} stamps repeat the one before"
        expected = "expected one message per frame; put all bodies of a frame into one message"
        yield warning("stamps_repeated", f"{got}: {expected}")
    rate = SECOND_NS / max(float(np.median(steps)), 1.0)
    if (longer := _stretched(rate)) is not None:
        unit, factor = longer
        wrong = f"stamps are {1 / rate:.3g} s apart: they seem to be {unit}, converted as if they were seconds"
        yield error("stamps_unit", f"{wrong}; expected times of capture: divide by {factor:.0f}")
    elif 0 < rate < SLOW_HZ:
        got = f"stamps are {1e3 / rate:.0f} ms apart, {rate:.1f} frames a second"
        remedy = "fast motion is lost: use a smaller network or smaller images"
        yield warning("slow", f"{got}: expected {SLOW_HZ:.0f} or more, ideally 30; {remedy}")
    if arrived is not None:
        yield from _against_clock(arrived - stamps)


def check_back(back_ns: int) -> Iterator[Problem]:
    """The problem with a recording whose stamps go back by ``back_ns`` at most, from one frame to the next."""
    if back_ns > STEP_NS:
        yield warning(
            "stamps_back",
            f"stamps go back by {back_ns / SECOND_NS:.1f} s, so the stream starts anew, and poses of both streams mix "
            "where their times overlap: expected increasing stamps; sort a file's rows by stamp or, if the clock was "
            "set, cut the recording there and clean its parts one by one",
        )


def check_length(span_ns: int, delay_frames: int) -> Iterator[Problem]:
    """The problem with a stream that ends before the delay is filled, given the time that its stamps span."""
    if span_ns < (delay_frames - 0.5) * SECOND_NS / FPS:  # stamps are rounded
        yield warning(
            "short",
            f"the stream lasts {span_ns / SECOND_NS:.2f} s, less than the delay of {delay_frames} frames, so that "
            "standard deviations are too small: expected a longer stream, or a shorter delay",
        )


def _unit(stamps: NDArray[np.int64]) -> Problem | None:
    """The problem with stamps that are not nanoseconds."""
    newest, rising = int(stamps[-1]), np.diff(stamps)
    if not stamps.any():
        remedy = "set stamp_ns to time.time_ns() when the image is taken"
        return error("stamps_zero", f"stamp is 0 in every message: expected nanoseconds of capture; {remedy}")
    step = float(np.median(rising[rising > 0])) if (rising > 0).any() else 0.0
    if not step and (rising < 0).any():
        return None  # they decrease
    if not (stamps % SECOND_NS).any() and (step == 0 or (step >= SECOND_NS and not _stretched(SECOND_NS / step))):
        got = f"stamps are whole seconds, the last {newest // SECOND_NS} s"
        remedy = "in ROS use stamp.sec and stamp.nanosec, in a CSV decimals (0.033), otherwise time.time_ns()"
        return error("stamps_whole_seconds", f"{got}: expected nanoseconds of capture; {remedy}")
    if not step and newest < SECONDS_BELOW:
        return _of_unit("seconds", f"stamp is {newest} in every message", UNITS["seconds"])
    if not step:
        expected = "expected nanoseconds of capture, another for each frame; use time.time_ns()"
        return error("stamps_constant", f"stamp is {newest} in every message: {expected}")
    if SECOND_NS / step > RATES_HZ[1]:
        for unit, factor in UNITS.items():
            # whole seconds increase by one only now and then; finer units increase with every frame
            if RATES_HZ[0] <= SECOND_NS / (step * factor) <= RATES_HZ[1] or (unit == "seconds" and step <= 1):
                return _of_unit(unit, f"stamps are {step:g} ns apart, {SECOND_NS / step:.3g} frames a second", factor)
    return None


def _stretched(rate: float) -> tuple[str, float] | None:
    """The unit that was mistaken for seconds, and the factor between them, from the apparent frame rate in Hz."""
    for unit, factor in (("milliseconds", 1e3), ("microseconds", 1e6)):
        if RATES_HZ[0] <= rate * factor <= RATES_HZ[1]:
            return unit, factor
    return None


def _of_unit(unit: str, got: str, factor: float) -> Problem:
    remedy = f"multiply by {factor:.0f}, or use time.time_ns() when the image is taken"
    return error("stamps_unit", f"{got}: they seem to be {unit}, expected nanoseconds of capture; {remedy}")


def _against_clock(late: NDArray[np.int64]) -> Iterator[Problem]:
    """Problems with the offset between this machine's clock and the stamps, nanoseconds."""
    if -late.max() > AHEAD_NS:
        got = f"stamps are {-late.max() / SECOND_NS:.1f} s ahead of this machine's clock"
        expected = "expected times of capture in the past; synchronise the two clocks (NTP or PTP)"
        yield warning("stamps_ahead", f"{got}: {expected}")
    # delayed messages arrive late and then catch up; after a clock was set, the offset stays
    step = int(np.argmax(np.abs(np.diff(late)))) + 1
    before, after = late[:step], late[step:]
    if min(len(before), len(after)) >= SETTLED and abs(moved := int(after.min() - before.min())) > STEP_NS:
        got = f"the source's clock jumped by {abs(moved) / SECOND_NS:.1f} s relative to this machine's"
        expected = "expected a steady clock; let NTP slew that clock instead of setting it"
        yield warning("clock_jumped", f"{got}, so the stream restarts: {expected}")
