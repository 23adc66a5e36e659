"""The comparison of importers: it finds nothing where nothing is, and a mirror where one is."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation
from tests.prior.motion.test_motion_prepare import standing

from steadypose.benchmarks.systems.importers import MIRROR, compare
from steadypose.prior.motion.prepare import FPS


def moving() -> np.ndarray:
    """A body whose left arm and left leg alone move."""
    body = standing(90)
    time = np.arange(90) / FPS
    for joint, size in ((20, 0.15), (18, 0.1), (7, 0.2)):
        body[:, joint, 0] += size * np.sin(2 * np.pi * time)
        body[:, joint, 2] += size / 2
    return body


def test_one_motion_in_two_places_at_two_times_is_one_motion() -> None:
    a = moving()
    turned = Rotation.from_euler("z", 70, degrees=True).apply(a.reshape(-1, 3)).reshape(a.shape) + [1, 2, 0]
    difference = compare(a, turned[2:])  # two frames late
    assert difference.position.max() < 0.01
    assert difference.same_bones.max() < 0.01
    assert difference.bend.max() < 0.05
    assert difference.mirrored.max() > 5


def test_a_mirrored_motion_is_nearer_to_the_control() -> None:
    a = moving()
    difference = compare(a, a[:, MIRROR] * [1.0, -1.0, 1.0])
    assert difference.mirrored.max() < 0.01
    assert difference.same_bones.max() > 5
