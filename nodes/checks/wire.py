"""Checks of what comes in from publishers before its content is looked at."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from steadypose.msgs.subscriber import SECOND
from steadypose.nodes.checks.problem import Problem, error


def check_wire(refused: Counter[str]) -> Iterator[Problem]:
    """Problems with the frames that a subscriber has just refused: their numbers by cause."""
    if second := refused[SECOND]:
        yield error(
            "second_publisher",
            f"{second} messages came from a second publisher with the same source name, and were refused: "
            "expected one publisher per source; give each sensor its own name (`source` of its messages), or stop "
            "one of the two",
        )
    if invalid := {cause: count for cause, count in refused.items() if cause != SECOND}:
        yield error(
            "not_a_message",
            f"{sum(invalid.values())} frames were not valid messages ({', '.join(sorted(invalid))}): expected the "
            "topic, a zero byte, a header of 17 bytes, and CDR (docs/other_languages.md)",
        )
