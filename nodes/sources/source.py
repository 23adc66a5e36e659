"""Interfaces of sources of skeletons: recorded and live."""

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
    """Skeletons in order, each with its topic: ``pose/raw``, and ``pose/truth`` if the recording has it."""

    refused: Counter[str]
    """messages that could not be read, by cause"""

    def __len__(self) -> int:
        """The number of frames, those that cannot be read among them."""
        ...

    def __iter__(self) -> Iterator[tuple[str, Message]]: ...


class LiveSource(ABC):
    """Skeletons in real time, stamped with the wall time of their capture."""

    def __init__(self) -> None:
        self.refused: Counter[str] = Counter()
        """frames dropped or refused, by cause"""

    @abstractmethod
    def frames(self) -> Generator[PoseRaw | None, None, None]:
        """Skeletons, endlessly; None after a short time without one, so that the caller can check whether to stop."""

    @abstractmethod
    def status(self) -> dict[str, str]:
        """Values for `diagnostics`."""

    def problems(self) -> list[Problem]:
        """Present problems with the source."""
        return []


@dataclass(frozen=True)
class SourceContext:
    """What a source is given in addition to its own settings."""

    clock: Clock
    """of the input node"""
    calibration: CalibrationSettings
    """of the camera"""
    keys: Keys | None = None
    """for publishers on other machines"""
    clear_text: bool = False
    """whether to listen to other machines without keys"""
