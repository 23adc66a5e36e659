"""What a node publishes that was killed in a lossless replay, and began anew with the context that it is given: poses a
little off those of one that was not killed, and no worse."""

import numpy as np
import pytest
from conftest import walk
from numpy.typing import NDArray
from tests.helpers.synthetic_poses import walker

from steadypose.msgs.types import PoseClean, PoseRaw, PoseWorld
from steadypose.nodes.graph.relay import CONTEXT
from steadypose.prior.clean.pipeline import PriorPipeline
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.world.pipeline import TrajectoryPipeline
from steadypose.prior.world.settings import TrajectorySettings

KILLED, FRAMES = CONTEXT + 50, CONTEXT + 100


def positions(messages: list[PoseClean] | list[PoseWorld]) -> NDArray[np.float32]:
    """(FRAMES - KILLED - 10, 22, 3) metres, from the kill on."""
    end = messages[-1].stamp_ns - round(10 / 30 * 1e9)
    begin = end - round((FRAMES - KILLED - 10) / 30 * 1e9)
    return np.array([m.bodies[0].positions for m in messages if begin < m.stamp_ns + 1000 <= end + 2000])


@pytest.mark.slow
def test_who_begins_anew_is_a_little_off_and_no_worse() -> None:
    frames = walk(FRAMES)

    def cleaned(given: list[PoseRaw]) -> list[PoseClean]:
        pipeline = PriorPipeline(PriorSettings())
        return [clean for raw in given for clean in pipeline.process(raw)]

    def placed(given: list[PoseClean]) -> list[PoseWorld]:
        pipeline = TrajectoryPipeline(TrajectorySettings())
        return [world for clean in given for world in pipeline.process(clean)]

    clean = cleaned(frames)
    going_on, anew = positions(clean), positions(cleaned(frames[KILLED - CONTEXT :]))
    assert going_on.shape == anew.shape
    off = np.linalg.norm(anew - going_on, axis=2)
    first = round((clean[0].stamp_ns - frames[0].stamp_ns) * 30 / 1e9) + len(clean) - 10 - len(anew)
    true = np.array([walker((first + k) / 30)[0] for k in range(len(anew))])
    errors = [np.linalg.norm(found - true, axis=2).mean() for found in (going_on, anew)]
    assert np.median(off) < 1e-3
    assert off.max() < 1e-2
    assert errors[1] < 1.05 * errors[0]
    world = placed(clean)
    off = np.linalg.norm(positions(placed(clean[KILLED - CONTEXT :])) - positions(world), axis=2)
    assert off.max() < 1e-3
