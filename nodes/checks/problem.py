"""Shared by all checks: `Problem`, as reported by `diagnostics`, the console and `steadypose doctor --live`."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.subscriber import HANDSHAKE, SECOND
from steadypose.msgs.types import Level, PoseRaw, RawBody

PREFIX = "problem."  # prefix of the keys in `diagnostics` whose values are problems


@dataclass(frozen=True)
class Problem:
    """A problem with a stream."""

    level: Level  # ERROR if no useful output is possible, WARN if the output is worse than it could be
    cause: str  # one word; docs/troubleshooting.md has an entry for each
    text: str  # what was received, what was expected, and what to do

    def __str__(self) -> str:
        return f"{self.cause}: {self.text}"


def error(cause: str, text: str) -> Problem:
    return Problem(Level.ERROR, cause, text)


def warning(cause: str, text: str) -> Problem:
    return Problem(Level.WARN, cause, text)


def as_values(problems: Iterable[Problem]) -> dict[str, str]:
    """The entries of `diagnostics` for problems."""
    return {f"{PREFIX}{problem.cause}": problem.text for problem in problems}


def from_values(values: Mapping[str, str]) -> dict[str, str]:
    """The problems in `diagnostics`: texts by cause."""
    return {key.removeprefix(PREFIX): text for key, text in values.items() if key.startswith(PREFIX)}


JUDGED = 4  # largest number of bodies per message whose joints are examined


def bodies(messages: Sequence[PoseRaw]) -> Iterator[RawBody]:
    """All bodies of all messages."""
    for raw in messages:
        yield from raw.bodies


def some_bodies(messages: Sequence[PoseRaw]) -> list[PoseRaw]:
    """The messages with at most `JUDGED` bodies each, because examining a whole crowd would delay frames."""
    return [replace(raw, bodies=raw.bodies[:JUDGED]) for raw in messages]


def tracks(messages: Sequence[PoseRaw], joints: int) -> NDArray[np.float64]:
    """(N, J, 3) joints of all bodies that have ``joints`` of them; NaN where unobserved."""
    found = [observed(body) for body in bodies(messages) if len(body.positions) == joints]
    return np.array(found, np.float64).reshape(-1, joints, 3)


def observed(body: RawBody) -> NDArray[np.float64]:
    """(J, 3) joints of a body; NaN where not finite or of confidence 0."""
    positions = body.positions.astype(np.float64)
    missing = np.asarray(~np.isfinite(positions).all(axis=-1))
    if len(body.confidence) == len(positions):
        missing |= body.confidence <= 0.0
    return np.where(missing[:, None], np.nan, positions)


def check_wire(refused: Mapping[str, Counter[str]]) -> Iterator[Problem]:
    """Problems with the frames that subscribers have just refused: their numbers by address, then by cause."""
    if second := [f"{counts[SECOND]} from {at}" for at, counts in refused.items() if counts[SECOND]]:
        refusal = f"messages of a second publisher with the same source name were refused ({', '.join(second)})"
        remedy = "give each sensor its own name (`source` of its messages), or stop one of the two"
        yield error("second_publisher", f"{refusal}: expected one publisher per source; {remedy}")
    if shut_out := [at for at, counts in refused.items() if counts[HANDSHAKE]]:
        expected = "expected CurveZMQ keys that both sides know of each other, or none on either side"
        where = "docs/subscribe.md#from-another-machine"
        yield error("keys", f"no connection to {', '.join(shut_out)}: {expected} ({where})")
    causes = [(cause, n, at) for at, counts in refused.items() for cause, n in sorted(counts.items())]
    if invalid := [f"{cause}: {n} from {at}" for cause, n, at in causes if cause not in (SECOND, HANDSHAKE)]:
        expected = "expected the topic, a zero byte, a header of 17 bytes, and CDR (docs/other_languages.md)"
        yield error("not_a_message", f"frames are no valid messages ({', '.join(invalid)}): {expected}")
