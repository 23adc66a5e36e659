"""Forms of message fields: each converts and checks the value that a constructor is given."""

import operator
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np

Form = Callable[[Any], Any]
"""Function from a given value to the stored value. It raises `UnfitError` if the value does not fit."""


class UnfitError(ValueError):
    """A value that does not fit a field: what was expected, and what came."""

    def __init__(self, expected: str, got: object) -> None:
        super().__init__(f"expected {expected}, got {got}")


class Array(NamedTuple):
    """An array of a dtype and shape. A length "J" is the number of joints of the message's skeleton."""

    dtype: type[np.generic]
    shape: tuple[int | Literal["J"], ...]

    def __call__(self, value: Any) -> Any:
        try:
            array = np.asarray(value, self.dtype)
        except (TypeError, ValueError, OverflowError) as error:
            raise UnfitError(f"{self.dtype.__name__} numbers of shape {self}", repr(value)[:80]) from error
        fits = array.shape == self.shape or (
            array.ndim == len(self.shape) and all(a in ("J", b) for a, b in zip(self.shape, array.shape, strict=True))
        )
        if not fits:
            raise UnfitError(f"shape {self}", f"shape {array.shape}")
        return array

    def __str__(self) -> str:
        return str(self.shape).replace("'", "")


class States(NamedTuple):
    """An array of enumeration values, 0 to ``last``."""

    array: Array
    last: int

    def __call__(self, value: Any) -> Any:
        states = np.asarray(value)
        if states.size and not (states.min() >= 0 and states.max() <= self.last):
            raise UnfitError(f"JointState values, 0 to {self.last:d}", states.tolist())
        return self.array(value)


class ListOf(NamedTuple):
    """A list of messages of one type."""

    kind: type

    def __call__(self, value: Any) -> list[Any]:
        if not isinstance(value, list) or not all(isinstance(item, self.kind) for item in value):
            raise UnfitError(f"a list of {self.kind.__name__}", repr(value)[:80])
        return value


class Integer(NamedTuple):
    """An integer with ``low`` <= value < ``end``, converted to an enumeration member if ``kind`` is one."""

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
    """A number, converted to float."""
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
    """A dictionary from strings to strings."""
    if not all(isinstance(text, str) for pair in value.items() for text in pair):
        raise UnfitError("strings for keys and values", repr(value)[:80])
    return value
