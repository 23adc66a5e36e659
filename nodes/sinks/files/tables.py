"""Positions as text: CSV, as `nodes.sources.csv` reads it, and TRC, as OpenSim does."""

from __future__ import annotations

import numpy as np

from steadypose.nodes.sinks.files.motion import Y_UP, BodyMotion
from steadypose.prior.body.skeleton import JOINTS

MILLIMETRES = 1000.0


def to_csv(motion: BodyMotion) -> bytes:
    """``stamp`` in seconds; of each joint ``_x _y _z`` in metres, world, z up, and ``_qx _qy _qz _qw``, local."""
    parts = ("x", "y", "z", "qx", "qy", "qz", "qw")
    rows = np.concatenate([motion.positions, motion.rotations], axis=-1).reshape(len(motion.root), -1)
    stamps = motion.start_s + np.arange(len(rows)) / motion.fps
    lines = [
        "# skeleton: smpl22",
        "# up: z",
        ",".join(["stamp", *(f"{joint}_{part}" for joint in JOINTS for part in parts)]),
        *(f"{stamp:.9f}," + ",".join(f"{value:.6f}" for value in row) for stamp, row in zip(stamps, rows, strict=True)),
    ]
    return ("\n".join(lines) + "\n").encode()


def to_trc(motion: BodyMotion) -> bytes:
    """Markers at the joints: millimetres, y up."""
    rows = (MILLIMETRES * motion.positions @ Y_UP.T).reshape(len(motion.root), -1)
    frames, rate = len(rows), f"{motion.fps:g}"
    header = ("DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units", "OrigDataRate", "OrigDataStartFrame",
              "OrigNumFrames")  # fmt: skip
    lines = [
        "PathFileType\t4\t(X/Y/Z)\tsteadypose.trc",
        "\t".join(header),
        "\t".join([rate, rate, str(frames), str(len(JOINTS)), "mm", rate, "1", str(frames)]),
        "Frame#\tTime\t" + "\t\t\t".join(JOINTS) + "\t\t",
        "\t\t" + "\t".join(f"{axis}{k + 1}" for k in range(len(JOINTS)) for axis in "XYZ"),
        "",
        *(
            "\t".join([str(k + 1), f"{k / motion.fps:.6f}", *(f"{value:.4f}" for value in row)])
            for k, row in enumerate(rows)
        ),
    ]
    return ("\n".join(lines) + "\n").encode()
