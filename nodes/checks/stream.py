"""All checks of a stream of ``pose/raw``, and of the prior's output for it."""

import warnings
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from steadypose.msgs.types import Level, PoseClean, PoseRaw
from steadypose.nodes.checks.geometry import check_geometry, check_jumps, check_speed
from steadypose.nodes.checks.layout import check_layout
from steadypose.nodes.checks.problem import Problem, error, some_bodies, warning
from steadypose.nodes.checks.stamps import ENOUGH as ENOUGH_STAMPS
from steadypose.nodes.checks.stamps import check_stamps
from steadypose.prior.clean.settings import PriorSettings

ENOUGH = 20  # smallest number of bodies between two checks to judge by
MAX_SHARE = 0.7  # largest normal share of refused joints, or of flagged poses, ratio
CHECKS = 3
"""Number of successive checks with nearly all poses flagged that make a problem. The flag reports shorter faults."""


class OutputCheck:
    """Counts the pipeline's input and output between two checks, beside the pipeline's own counters."""

    def __init__(self, counters: Counter[str], *, identified: bool) -> None:
        self._counters = counters
        self._if_ids_switch = "" if identified else "if ids switch between people, --set prior.identify.enabled=true; "
        self._refused_before = 0
        self._flagged_checks = 0
        self._forget()

    def add_input(self, raw: PoseRaw) -> None:
        self._joints += sum(int(np.isfinite(body.positions[:, 0]).sum()) for body in raw.bodies)
        self._in += len(raw.bodies)

    def add_output(self, clean: PoseClean) -> None:
        self._out += len(clean.bodies)
        self._flagged += sum(body.anomaly_flag for body in clean.bodies)

    def problems(self) -> list[Problem]:
        """Problems with the output since the last check."""
        refused_ever = self._counters["joints_refused"]
        refused, self._refused_before = refused_ever - self._refused_before, refused_ever
        found = []
        if self._in >= ENOUGH and refused > MAX_SHARE * self._joints:
            share = f"{100 * refused / self._joints:.0f} % of the observed joints were refused as jumps"
            remedy = f"{self._if_ids_switch}if stamps are times of arrival, use times of capture"
            found.append(warning("nearly_all_refused", f"{share}: expected a few; {remedy}"))
        nearly_all = self._out >= ENOUGH and self._flagged > MAX_SHARE * self._out
        self._flagged_checks = self._flagged_checks + 1 if nearly_all else 0
        if self._flagged_checks >= CHECKS:
            share = f"{self._flagged} of the last {self._out} poses were flagged as unlike human motion"
            remedy = "check left and right, axes and joint order in the 3D view (--view)"
            found.append(warning("nearly_all_flagged", f"{share}: expected a few in a thousand; {remedy}"))
        self._forget()
        return found

    def _forget(self) -> None:
        self._in = self._out = self._joints = self._flagged = 0


LENGTHS_NS = (1_500_000_000, 2_500_000_000)
"""Length of the window of messages that are examined, nanoseconds, and of a slow stream's."""
LONGEST = 90  # largest number of messages in the window
SILENT_NS = 2_000_000_000  # time without a message after which a stream counts as stopped, nanoseconds
SET_NS = 10_000_000_000
"""Time between two checks, which a node makes every second, from which the wall clock was set, nanoseconds."""
AT_ONCE = 4  # largest number of streams examined in one call, in turn, because a server's frames wait meanwhile
NOBODY = 60  # number of messages without any body that make a problem


class StreamCheck:
    """Checks a stream of ``pose/raw`` for misuse, for a prior of these settings.

    ``received`` and ``inhabited`` are the numbers of messages so far, and of those with a body; ``examined_ns`` is the
    wall time of the last examination, nanoseconds, -1 before the first.
    """

    def __init__(self, settings: PriorSettings) -> None:
        self._settings = settings
        self._arrivals: deque[tuple[int, PoseRaw]] = deque(maxlen=LONGEST)
        self.received = self.inhabited = 0
        self._heard_ns = self._asked_ns = 0
        self._ended = False
        self._found: list[Problem] = []
        self.examined_ns = -1

    def see(self, raw: PoseRaw, at_ns: int) -> None:
        """Record a message that arrived at wall time ``at_ns``."""
        self._ended, self._heard_ns = raw.end_of_stream, at_ns
        if not raw.end_of_stream:
            self.received += 1
            self.inhabited += bool(raw.bodies)
            self._arrivals.append((at_ns, raw))

    def heard(self, at_ns: int) -> None:
        """Record that a message arrived and was dropped unread because the node was late."""
        self._heard_ns = at_ns

    def problems(self, now_ns: int, *, live: bool, anew: bool = True) -> list[Problem]:
        """The stream's current problems at wall time ``now_ns``; if ``live``, it should go on in real time.

        The messages are examined only if ``anew``; otherwise the last result is returned.
        """
        if not self._arrivals or self._ended:
            return []
        if self._asked_ns and not 0 <= now_ns - self._asked_ns < SET_NS:
            self._heard_ns = now_ns  # this machine's clock was set: silence counts from now
        self._asked_ns = now_ns
        if live and (silent_ns := now_ns - self._heard_ns) > SILENT_NS:
            silence = f"no message for {silent_ns / 1e9:.0f} s, after message {self.received}"
            return [error("stopped", f"{silence}: the tracker has stopped, hangs, or lost its connection; restart it")]
        if anew:
            self.examined_ns = now_ns
            with warnings.catch_warnings():  # numpy warns of joints that are always NaN, which the checks expect
                warnings.simplefilter("ignore", RuntimeWarning)
                with np.errstate(all="ignore"):
                    self._found = list(self._problems(now_ns, live))
        return self._found

    def _problems(self, now_ns: int, live: bool) -> Iterator[Problem]:
        arrivals: list[tuple[int, PoseRaw]] = []
        for length_ns in LENGTHS_NS:
            if len(arrivals) < ENOUGH_STAMPS:
                arrivals = [(at_ns, raw) for at_ns, raw in self._arrivals if now_ns - at_ns <= length_ns]
        messages = [raw for _, raw in arrivals]
        if not messages:
            return
        times_ns = np.array([at_ns for at_ns, _ in arrivals]) if live else None
        stamps = list(check_stamps(np.array([raw.stamp_ns for raw in messages]), times_ns))
        names = list(check_layout(messages, self._settings))
        yield from (*stamps, *names)
        if not self.inhabited and self.received >= NOBODY:
            yield warning(
                "nobody",
                f"{self.received} messages, none with a body: expected bodies; does the tracker detect people, and "
                "the publisher fill `bodies`?",
            )
        if not _usable(names):  # with a wrong layout, checks of joints mean nothing
            return
        few = some_bodies(messages)
        shape = list(check_geometry(few))
        yield from shape
        # ids that the prior ignores may change between people
        if _usable(stamps) and not self._settings.identify.enabled:
            jumps = list(check_jumps(few))
            yield from jumps
            if _usable(shape) and not jumps:
                yield from check_speed(few)


def _usable(problems: list[Problem]) -> bool:
    return not any(problem.level == Level.ERROR for problem in problems)


class StreamChecks:
    """The checks of all ``streams`` of a prior: a single one, or one per client, identified by its source."""

    def __init__(self, settings: PriorSettings, streams: int) -> None:
        self._settings, self._streams = settings, streams
        self._checks: dict[str, StreamCheck] = {}

    @property
    def seen(self) -> bool:
        return bool(self._checks)

    def see(self, raw: PoseRaw, at_ns: int) -> None:
        source = raw.source if self._streams > 1 else ""
        check = self._checks.pop(source, None) or StreamCheck(self._settings)
        self._checks[source] = check
        if len(self._checks) > self._streams:
            del self._checks[next(iter(self._checks))]
        check.see(raw, at_ns)

    def heard(self, source: str, at_ns: int) -> None:
        if check := self._checks.get(source if self._streams > 1 else ""):
            check.heard(at_ns)

    def problems(self, now_ns: int, *, live: bool) -> list[Problem]:
        """The problems of all streams, worst first; with several streams each names its source."""
        turn = sorted(self._checks, key=lambda source: self._checks[source].examined_ns)[:AT_ONCE]
        found = [
            replace(problem, cause=f"{source}.{problem.cause}", text=f"{source}: {problem.text}") if source else problem
            for source, check in self._checks.items()
            for problem in check.problems(now_ns, live=live, anew=source in turn)
        ]
        return sorted(found, key=lambda problem: -problem.level)
