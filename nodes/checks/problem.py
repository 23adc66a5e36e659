"""A problem with a stream, as reported in `diagnostics`, on the console and by `steadypose doctor --live`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from steadypose.msgs.types import Level

PREFIX = "problem."
"""of the keys in `diagnostics` whose values are problems"""


@dataclass(frozen=True)
class Problem:
    """A problem.

    Attributes:
        level: ERROR if no useful output is possible, WARN if the output is worse than it could be.
        cause: in a word; docs/troubleshooting.md has one entry for each.
        text: what was received, what was expected, and what to do.
    """

    level: Level
    cause: str
    text: str


def error(cause: str, text: str) -> Problem:
    return Problem(Level.ERROR, cause, text)


def warning(cause: str, text: str) -> Problem:
    return Problem(Level.WARN, cause, text)


def as_values(problems: Iterable[Problem]) -> dict[str, str]:
    """As `diagnostics` carry them."""
    return {f"{PREFIX}{problem.cause}": problem.text for problem in problems}


def from_values(values: Mapping[str, str]) -> dict[str, str]:
    """The problems in `diagnostics`: texts by cause."""
    return {key.removeprefix(PREFIX): text for key, text in values.items() if key.startswith(PREFIX)}
