"""Events against labels: each label is met by at most one beginning, each beginning that meets none is false."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from steadypose.benchmarks.systems.event_scenes import SHORTEST_S, Label
from steadypose.msgs.types import EventKind, Hand

MOMENTS = (EventKind.ENTERED, EventKind.LEFT)
"""which last no time"""
EARLY_S, LATE_S = 0.5, 1.0
"""how long before and after its onset a beginning meets a label"""


@dataclass
class Score:
    """Of one kind."""

    met: int = 0
    missed: int = 0
    false: int = 0
    delays_s: list[float] = field(default_factory=list)

    @property
    def precision(self) -> float:
        return self.met / (self.met + self.false) if self.met + self.false else float("nan")

    @property
    def recall(self) -> float:
        return self.met / (self.met + self.missed) if self.met + self.missed else float("nan")

    @property
    def f1(self) -> float:
        whole = 2 * self.met + self.missed + self.false
        return 2 * self.met / whole if whole else float("nan")

    def add(self, other: Score) -> None:
        self.met, self.missed, self.false = self.met + other.met, self.missed + other.missed, self.false + other.false
        self.delays_s += other.delays_s


@dataclass(frozen=True)
class Told:
    """A beginning that was told."""

    person: int
    kind: EventKind
    hand: Hand
    at_s: float


def score(told: Sequence[Told], labels: Sequence[Label], undecided: Iterable[EventKind] = ()) -> dict[EventKind, Score]:
    """Scores by kind; kinds that are ``undecided`` have none."""
    scores: dict[EventKind, Score] = defaultdict(Score)
    left = [t for t in told if t.kind not in undecided]
    for label in sorted(labels, key=lambda label: (not label.required, label.start_s)):
        if label.kind in undecided:
            continue
        last_s = label.start_s + LATE_S if label.required else label.end_s
        first_s = min(label.start_s, label.nearly_s) - EARLY_S
        close = [t for t in left if (t.person, t.kind, t.hand) == label[:3] and first_s <= t.at_s <= last_s]
        if close:
            first = min(close, key=lambda t: t.at_s)
            left.remove(first)
            if label.required:
                scores[label.kind].met += 1
                scores[label.kind].delays_s.append(first.at_s - label.start_s)
        elif label.required and (label.end_s - label.start_s > SHORTEST_S or label.kind in MOMENTS):
            scores[label.kind].missed += 1
    for t in left:
        scores[t.kind].false += 1
    return dict(scores)


def quantile_ms(delays_s: Sequence[float], share: float) -> float:
    return float(np.quantile(delays_s, share)) * 1e3 if delays_s else float("nan")
