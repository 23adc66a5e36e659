"""A file as `steadypose prepare` writes it, of motion made by a test."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from steadypose.prior.body.inverse_kinematics import solve_rotations
from steadypose.prior.body.kinematics import quaternions
from steadypose.prior.body.skeleton import REST_OFFSETS


def write_motion(path: Path, clips: Sequence[np.ndarray], split: Sequence[str], flat: Sequence[bool] = ()) -> Path:
    """Clips (T, 22, 3) metres, z up, of the rest skeleton; returns ``path``."""
    positions = np.concatenate(clips).astype(np.float32)
    same = {"set": "default", "subject": "somebody", "source": "synthetic"}
    np.savez(
        path,
        positions=positions,
        rotations=quaternions(solve_rotations(positions, REST_OFFSETS)).astype(np.float32),
        offsets=np.repeat(REST_OFFSETS[None], len(clips), axis=0).astype(np.float32),
        contacts=np.zeros((len(positions), 8), dtype=bool),
        clip_start=np.cumsum([0, *map(len, clips)]),
        split=np.array(split),
        flat=np.array(flat or [True] * len(clips)),
        **{name: np.array([value] * len(clips)) for name, value in same.items()},  # type: ignore[arg-type]
    )
    return path
