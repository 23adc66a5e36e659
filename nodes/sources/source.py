"""What a source of skeletons is: recorded, or live."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from typing import Protocol

from steadypose.msgs.keys import Keys
from steadypose.msgs.types import Message, PoseRaw
from steadypose.nodes.checks.problem import Problem
from steadypose.nodes.graph.clock import Clock
from steadypose.nodes.sources.calibration import CalibrationSettings


class RecordedSource(Protocol):
    """Skeletons in the order they came, each with its topic: ``pose/raw``, and ``pose/truth`` where it is known."""

    refused: Counter[str]
    """what could not be read, by cause"""

    def __len__(self) -> int:
        """The number of frames, those that cannot be read among them."""
        ...

    def __iter__(self) -> Iterator[tuple[str, Message]]: ...


class LiveSource(ABC):
    """Skeletons that come when they come, stamped with the wall time of their capture."""

    def __init__(self) -> None:
        self.refused: Counter[str] = Counter()
        """what went wrong, by cause"""

    @abstractmethod
    def frames(self) -> Generator[PoseRaw | None, None, None]:
        """Skeletons without end; None where a moment passed without one, so that the caller can look up."""

    @abstractmethod
    def status(self) -> dict[str, str]:
        """What `diagnostics` should say of it."""

    def problems(self) -> list[Problem]:
        """What is wrong with it now."""
        return []


@dataclass(frozen=True)
class SourceContext:
    """What a source gets beside its own settings."""

    clock: Clock
    """of the input node"""
    calibration: CalibrationSettings
    """of the camera"""
    keys: Keys | None = None
    """for publishers on other machines"""
    clear_text: bool = False
    """whether to listen to other machines without keys"""
