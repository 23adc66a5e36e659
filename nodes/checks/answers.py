"""Whether what comes out of the prior can be of use: nearly all refused, or nearly all flagged."""

from __future__ import annotations

from collections import Counter

import numpy as np

from steadypose.msgs.types import PoseClean, PoseRaw
from steadypose.nodes.checks.problem import Problem, warning

ENOUGH = 20
"""bodies between two checks, at least, for a judgement"""
MAX_SHARE = 0.7
"""of the joints refused, or of the poses flagged"""
CHECKS = 3
"""checks in a row with nearly all bodies flagged: a shorter fault is what the flag itself reports"""


class Answers:
    """Counts the pipeline's input and output between two checks.

    Args:
        counters: of the pipeline.
    """

    def __init__(self, counters: Counter[str]) -> None:
        self._counters = counters
        self._refused_before = 0
        self._flagged_looks = 0
        self._forget()

    def asked(self, raw: PoseRaw) -> None:
        self._joints += sum(int(np.isfinite(body.positions[:, 0]).sum()) for body in raw.bodies)
        self._in += len(raw.bodies)

    def given(self, clean: PoseClean) -> None:
        self._out += len(clean.bodies)
        self._flagged += sum(body.anomaly_flag for body in clean.bodies)

    def problems(self) -> list[Problem]:
        """Problems with the output since the last check."""
        refused_ever = self._counters["joints_refused"]
        refused, self._refused_before = refused_ever - self._refused_before, refused_ever
        found = []
        if self._in >= ENOUGH and refused > MAX_SHARE * self._joints:
            found.append(
                warning(
                    "nearly_all_refused",
                    f"{100 * refused / self._joints:.0f} % of the joints seen were refused as jumps: expected a few; "
                    "if ids go from one person to another, --set prior.identify.enabled=true; if stamps are those of "
                    "arrival, take those of capture",
                )
            )
        nearly_all = self._out >= ENOUGH and self._flagged > MAX_SHARE * self._out
        self._flagged_looks = self._flagged_looks + 1 if nearly_all else 0
        if self._flagged_looks >= CHECKS:
            found.append(
                warning(
                    "nearly_all_flagged",
                    f"{self._flagged} of the last {self._out} poses were flagged as no human motion: expected a few "
                    "in a thousand; look at the picture (--view) whether left and right, axes and order are the "
                    "sensor's",
                )
            )
        self._forget()
        return found

    def _forget(self) -> None:
        self._in = self._out = self._joints = self._flagged = 0
