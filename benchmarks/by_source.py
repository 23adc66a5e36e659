"""Tables by source of motion, in whose means every person counts once."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from steadypose.benchmarks.intervals import interval, ratio
from steadypose.benchmarks.motion import MotionClips
from steadypose.benchmarks.results import Table

_LEAST = 1e-6
"""metres; a ratio to no error at all is one to this"""


def source_table(
    name: str,
    title: str,
    errors: Mapping[tuple[str, str], NDArray[np.float64]],
    clips: MotionClips,
    baseline: str,
) -> Table:
    """A column a source, the mean over people, and its ratio to a baseline.

    Args:
        name: of the table.
        title: what is measured, in millimetres.
        errors: by condition and method, (C,) metres, NaN of a clip without such an error.
        clips: whose these are.
        baseline: the method of which the last column is the ratio, in the same condition.
    """
    sources = list(dict.fromkeys(clips.data_set.tolist()))
    rows = []
    for (condition, method), found in errors.items():
        by_source = [interval(found[clips.data_set == s], clips.person[clips.data_set == s]).mean for s in sources]
        of_baseline = ratio(np.maximum(found, _LEAST), np.maximum(errors[condition, baseline], _LEAST), clips.person)
        rows.append([
            f"{condition}: {method}", *(f"{1e3 * mean:.1f}" for mean in by_source),
            interval(found, clips.person).text(1, 1e3), of_baseline.text(2),
        ])  # fmt: skip
    note = (
        f"{len(clips.offsets)} clips of {len(set(clips.person.tolist()))} people, each of whom counts once; in "
        "brackets, the 95 % interval over people."
    )
    return Table(name, title, ["", *sources, "mean over people", f"of: {baseline}"], rows, note)
