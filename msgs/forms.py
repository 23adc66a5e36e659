"""The forms of messages' fields: what a constructor makes of a value, or says against it."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np

Form = Callable[[Any], Any]
"""takes a field's value, and returns it as it is kept; raises `UnfitError` if it cannot be"""


class UnfitError(ValueError):
    """What a field was expected to hold, and what it was given."""

    def __init__(self, expected: str, got: object) -> None:
        super().__init__(f"expected {expected}, got {got}")


class Array(NamedTuple):
    """An array; a length J is that of the message's skeleton."""

    dtype: type[np.generic]
    shape: tuple[int | Literal["J"], ...]

    def __call__(self, value: Any) -> Any:
        try:
            array = np.asarray(value, self.dtype)
        except (TypeError, ValueError, OverflowError) as error:
            raise UnfitError(f"{self.dtype.__name__} numbers of shape {self}", repr(value)[:80]) from error
        if array.shape != self.shape and not self._fits(array.shape):
            raise UnfitError(f"shape {self}", f"shape {array.shape}")
        return array

    def _fits(self, shape: tuple[int, ...]) -> bool:
        own = self.shape
        return len(own) == len(shape) and all(a in ("J", b) for a, b in zip(own, shape, strict=True))

    def __str__(self) -> str:
        return str(self.shape).replace("'", "")


class States(NamedTuple):
    """An array of the values of an enumeration."""

    array: Array
    last: int

    def __call__(self, value: Any) -> Any:
        states = np.asarray(value)
        if states.size and not (states.min() >= 0 and states.max() <= self.last):
            raise UnfitError(f"JointState values, 0 to {self.last:d}", states.tolist())
        return self.array(value)


class ListOf(NamedTuple):
    """A list of messages of one kind."""

    kind: type

    def __call__(self, value: Any) -> list[Any]:
        if not isinstance(value, list) or not all(isinstance(item, self.kind) for item in value):
            raise UnfitError(f"a list of {self.kind.__name__}", repr(value)[:80])
        return value


class Integer(NamedTuple):
    """An integer of ``low`` or more and under ``end``, or the member of an enumeration that it stands for."""

    low: int
    end: int
    kind: type[int] = int

    def __call__(self, value: Any) -> int:
        try:
            number = operator.index(value)
        except TypeError as error:
            raise UnfitError("an integer", repr(value)[:80]) from error
        if not self.low <= number < self.end:
            raise UnfitError(f"an integer of {self.low} or more and under {self.end}", number)
        return self.kind(number)


def number(value: Any) -> float:
    """A number, as a float."""
    try:
        return float(value)
    except (TypeError, ValueError) as error:
        raise UnfitError("a number", repr(value)[:80]) from error


def text(value: Any) -> str:
    """A string."""
    if not isinstance(value, str):
        raise UnfitError("a string", repr(value)[:80])
    return value


def texts(value: Any) -> dict[str, str]:
    """Strings by strings."""
    if not all(isinstance(text, str) for pair in value.items() for text in pair):
        raise UnfitError("strings for keys and values", repr(value)[:80])
    return value
