from itertools import islice

import numpy as np
import pytest

from steadypose.benchmarks.systems.latency import SPACING, crowd, percentiles
from steadypose.benchmarks.systems.restart import longest_gap
from steadypose.msgs.types import Pose, PoseRaw, RawBody


def frames(*heights: float | None) -> list[PoseRaw]:
    """A body whose joints are all at each of these heights, every 41 ms; nobody for None."""
    bodies = [[] if z is None else [RawBody(5, np.full((22, 3), z), np.ones(22))] for z in heights]
    return [
        PoseRaw(10**9 + i * 41_000_000, "camera", "sim", "smpl22", Pose.from_up("z"), True, seen)
        for i, seen in enumerate(bodies)
    ]


def test_a_crowd_is_at_30_hz_side_by_side_and_never_jumps() -> None:
    stream = list(islice(crowd(frames(None, 0.0, 1.0, 2.0, 3.0, None), 3), 14))
    steps = np.diff([frame.stamp_ns for frame in stream])
    assert set(steps.tolist()) <= {33_333_333, 33_333_334}
    assert [[body.id for body in frame.bodies] for frame in stream] == [[0, 1, 2]] * 14
    first = np.array([frame.bodies[1].positions[0, 2] for frame in stream])
    np.testing.assert_array_equal(first, [0, 1, 2, 3, 2, 1, 0, 1, 2, 3, 2, 1, 0, 1])
    apart = stream[0].bodies[1].positions - stream[0].bodies[0].positions
    np.testing.assert_allclose(apart, np.tile([SPACING, 0.0, 0.0], (22, 1)), atol=1e-6)
    with pytest.raises(ValueError, match="at least 2 frames"):
        next(crowd(frames(*[None] * 5), 1))


def test_percentiles_and_the_longest_gap_from_a_kill_on() -> None:
    assert percentiles(range(101)) == {"p50": 50.0, "p95": 95.0, "p99": 99.0, "max": 100.0}
    assert longest_gap([10.0, 10.033, 11.7, 11.733, 14.0], 0.5) == 1.667
