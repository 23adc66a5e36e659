"""One table over the studies that compare methods: how often, and where, steadypose is worse than the best baseline."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from statistics import median
from typing import Any

ERRORS = {
    "fidelity": "position_mm",
    "noisy_joints": "position_mm",
    "kinect_vicon": "position_mm",
    "mediapipe": "position_mm",
    "hidden_joints": "hidden_mm",
    "world": "position_mm",
}
"""The studies, and which error of a record counts."""

PRODUCT = ("steadypose", "steadypose: pose/world")
NO_BASELINE = ("truth", "HM-VAE", "steadypose", "ridge regression", "temporal convolution")
"""How names begin that are no baselines: the truth, our own variants, and what was trained on the very sensor."""

LEAST_MM = 0.05
"""Errors below it count as it, because a ratio of two of them says nothing, millimetres."""

HOW = """
## Overview

**Cells in which steadypose is worse than the best baseline**

A cell is a condition and a delay of one study. The best baseline is the one of the least position error in that very
cell, of all that wait as long or less; filters are tuned for the cell. The ratio is steadypose's error by this
baseline's: below 1, steadypose is better. Acceleration: the ratio to the same baseline, which may be smoother. Left
out are methods trained on the very sensor (the Kinect's table has them, beside steadypose with the sensor known) and
our own HM-VAE alone. Errors below 0.05 mm count as that much.

| study | cells | position worse in | median | worst | acceleration worse in | median | worst |
| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |
"""


def overview(results: Mapping[str, Mapping[str, Any]], titles: Mapping[str, str]) -> str:
    """Return the section, with a row for each study that there is."""
    rows = []
    for study, error in ERRORS.items():
        if study in results:
            cells = list(ratios(results[study]["records"], error))
            figures = [_summary({cell: pair[k] for cell, *pair in cells}) for k in (0, 1)]
            rows.append(f"| {titles.get(study, study)} | {len(cells)} | {figures[0]} | {figures[1]} |\n")
    return HOW + "".join(rows) if rows else ""


def ratios(records: Sequence[Mapping[str, Any]], error: str) -> Iterator[tuple[str, float, float]]:
    """Yield each cell's name and steadypose's ``error`` and acceleration error by those of the best baseline."""
    for own in records:
        if own["method"] not in PRODUCT:
            continue
        condition = own.get("condition", own.get("camera"))
        others = [
            record
            for record in records
            if record.get("condition", record.get("camera")) == condition
            and 0 <= record["delay"] <= own["delay"]
            and not record["method"].startswith(NO_BASELINE)
            and record.get(error) is not None
        ]
        best = min(others, key=lambda record: record[error])
        name = f"delay {own['delay']}" if condition is None else f"{condition}, delay {own['delay']}"
        yield name, *(max(own[key], LEAST_MM) / max(best[key], LEAST_MM) for key in (error, "acceleration_mm"))


def _summary(found: Mapping[str, float]) -> str:
    """Return three cells: how many ratios are above 1 as printed, their median, and the worst with its name."""
    worst = max(found, key=found.__getitem__)
    worse = sum(ratio >= 1.005 for ratio in found.values())
    return f"{worse} | {median(found.values()):.2f} | {found[worst]:.2f} ({worst})"
