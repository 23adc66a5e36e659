"""Answers as CSV, for a spreadsheet or a program that reads no ``.npz``: in the world, and as `sources.csv` reads it.

A row for each frame and body: ``stamp`` in seconds, ``body`` where there are several, and of each joint ``JOINT_x``,
``JOINT_y`` and ``JOINT_z`` in metres (world, z up), ``JOINT_confidence`` (0 where the joint was not observed, but
imputed, or is unknown), ``JOINT_state`` (`msgs.types.JointState`) and ``JOINT_sigma`` in metres; then ``anomaly`` and
``anomaly_flag``. What is not known is empty.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.types import JOINTS, JointState

OBSERVED = (JointState.SEEN, JointState.REFINED)
_PARTS = ("x", "y", "z", "confidence", "state", "sigma")


def write_csv(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays of `NpzCollector`, of one body or of several."""
    several = "body_id" in arrays
    columns = ["stamp", *(["body"] if several else [])]
    columns += [f"{joint}_{part}" for joint in JOINTS for part in _PARTS] + ["anomaly", "anomaly_flag"]
    with path.open("w", newline="", encoding="utf-8") as file:
        file.write("# skeleton: smpl22\n# up: z\n")
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(_rows(arrays, several))


def _rows(arrays: Mapping[str, NDArray[Any]], several: bool) -> Iterator[list[str]]:
    ids = arrays["body_id"].tolist() if several else [0]

    def of_bodies(name: str) -> NDArray[Any]:
        return arrays[name] if several else arrays[name][:, None]

    joints, state, sigma = of_bodies("world_positions"), of_bodies("state"), of_bodies("sigma")
    anomaly, flag = of_bodies("anomaly"), of_bodies("anomaly_flag")
    observed = np.isin(state, OBSERVED).astype(int)
    for row, stamp_ns in enumerate(arrays["stamp_ns"].tolist()):
        for body, number in enumerate(ids):
            if several and np.isnan(joints[row, body]).all():
                continue  # who is not there has no row
            cells = [f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}", *([str(number)] if several else [])]
            for joint in range(len(JOINTS)):
                at = row, body, joint
                cells += [_cell(value, 5) for value in joints[at].tolist()]
                cells += [str(observed[at]), str(state[at]), _cell(float(sigma[at]), 5)]
            yield [*cells, _cell(float(anomaly[row, body]), 3), str(int(flag[row, body]))]


def _cell(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else ""
