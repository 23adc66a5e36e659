"""What the weights that ship are worth on the bench's quick form, of simulated people: a tenth worse is a regression.

The figures were written down as they came (position error of all joints, of hidden ones, in mm, and acceleration error
in mm/frame², after four frames). Whoever makes them better writes down the better ones.
"""

from pathlib import Path

import numpy as np
import pytest
from rich.progress import Progress

from steadypose.benchmarks import ours
from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.motion import MotionClips
from steadypose.benchmarks.peers.filters import missing
from steadypose.benchmarks.protocols import hidden_joints, noisy_joints
from steadypose.benchmarks.scores import figures, score

CONDITIONS = {"perfect": lambda truth, rng: truth} | hidden_joints.CONDITIONS | noisy_joints.CONDITIONS
GOLDEN = {
    "perfect": (0.12, None, 0.172),
    "1 cm": (6.2, None, 1.63),
    "arm behind": (8.6, 57.3, 2.28),
    "0.5 s": (7.1, 52.6, 2.04),
    "4 cm": (19.0, None, 3.97),
    "lasting 2 cm, spikes, swaps": (27.6, None, 2.66),
}
WORSE = 1.1


@pytest.fixture(scope="module")
def clips() -> MotionClips:
    return Bench(quick=True, mocap=None, data=Path("nowhere.npz"), progress=Progress(disable=True)).clips()


@pytest.mark.parametrize("condition", GOLDEN)
def test_the_pipeline_is_as_good_as_it_was(clips: MotionClips, condition: str) -> None:
    seen = CONDITIONS[condition](clips.positions, np.random.default_rng(0))
    cleaned = ours.run(ours.OURS["steadypose"], seen, clips.stamps_s, delay=4)
    found = figures(score(cleaned.positions, clips.positions, missing(seen)))
    for name, golden in zip(("position_mm", "hidden_mm", "acceleration_mm"), GOLDEN[condition], strict=True):
        if golden is not None:
            assert found[name] < WORSE * golden, f"{name}: {found[name]}, was {golden}"
