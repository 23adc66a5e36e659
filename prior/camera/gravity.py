"""Estimates the orientation of a camera's frame from its accelerometer.

Gravity gives two of the three angles. The third, the heading, is not observable: a levelled camera looks along the
world's +y, as in `msgs.types.Pose.from_up`.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from steadypose.msgs.types import Pose
from steadypose.prior.arrays import Floats

GRAVITY = 9.81  # acceleration of gravity, m/s²
MAX_DEVIATION = 0.7
"""Largest difference of a reading from gravity, m/s²; beyond it, the camera is being moved."""
MEMORY_S = 1.0  # time constant of the exponential average of readings, seconds
UPDATE_ANGLE = np.radians(1.0)
"""Least change of direction that updates the pose, radians, so that the world does not shake with the noise."""


def level_pose(up: Floats) -> Pose:
    """Return the pose, at the origin, of an optical frame in which ``up`` (3,) points up; its z axis is along +y.

    Raises:
        ValueError: ``up`` is no direction.
    """
    up = np.asarray(up, np.float64)
    length = np.linalg.norm(up)
    if up.shape != (3,) or not np.isfinite(length) or length == 0:
        raise ValueError(f"up: expected a direction of shape (3,), got {up!r}")
    up = up / length
    # for a camera that looks straight up or down, the top or bottom of its image points ahead
    forward = np.array([0.0, 0.0, 1.0]) if abs(up[2]) < 0.999 else np.array([0.0, 1.0, 0.0])
    forward = forward - (forward @ up) * up
    forward /= np.linalg.norm(forward)
    return Pose(np.zeros(3), Rotation.from_matrix(np.stack([np.cross(forward, up), forward, up])).as_quat())


class GravityEstimator:
    """Estimates the direction of gravity from an accelerometer; assumes a level camera before the first reading.

    Attributes:
        pose: pose of the camera's frame in the world.
        up: (3,) up direction in the camera's frame.
        measured: whether both are based on readings.
    """

    def __init__(self) -> None:
        self.pose = Pose.from_up("-y")
        self.measured = False
        self._average = self.up = np.array([0.0, -1.0, 0.0])
        self._last_ns = 0

    def update(self, acceleration: Floats, stamp_ns: int) -> None:
        """Process a reading: acceleration (3,) m/s² in the camera's frame, including gravity (9.81 up at rest)."""
        strength = np.linalg.norm(acceleration)
        if not abs(strength - GRAVITY) < MAX_DEVIATION:
            return
        up = acceleration / strength
        elapsed_s, self._last_ns = (stamp_ns - self._last_ns) / 1e9, stamp_ns
        share = 1 - np.exp(-np.clip(elapsed_s, 0.0, MEMORY_S) / MEMORY_S) if self.measured else 1.0
        self._average = self._average + share * (up - self._average)
        average = self._average / np.linalg.norm(self._average)
        if not self.measured or average @ self.up < np.cos(UPDATE_ANGLE):
            self.pose, self.up, self.measured = level_pose(average), average, True
