"""What the weights that ship are worth on the bench's quick form, of simulated people: a tenth worse is a regression.

The figures were written down as they came (position error of all joints, of hidden ones, in mm, and acceleration error
in mm/frame², after four frames). Whoever makes them better writes down the better ones.
"""

from pathlib import Path

import numpy as np
import pytest
from rich.progress import Progress

from steadypose.benchmarks import product
from steadypose.benchmarks.baselines.filters import missing
from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.motion import MotionClips
from steadypose.benchmarks.scores import figures, score
from steadypose.benchmarks.studies import hidden_joints, noisy_joints

CONDITIONS = {"perfect": lambda truth, rng: truth} | hidden_joints.CONDITIONS | noisy_joints.CONDITIONS
GOLDEN = {
    "perfect": (0.06, None, 0.062),
    "1 cm": (5.7, None, 2.47),
    "arm behind": (7.7, 46.4, 2.92),
    "0.5 s": (6.4, 44.5, 2.72),
    "4 cm": (18.5, None, 6.15),
    "correlated 2 cm, spikes, swaps": (26.3, None, 2.23),
}
WORSE = 1.1


@pytest.fixture(scope="module")
def clips() -> MotionClips:
    return Bench(quick=True, mocap=None, data=Path("nowhere.npz"), progress=Progress(disable=True)).clips()


@pytest.mark.parametrize("condition", GOLDEN)
def test_the_pipeline_is_as_good_as_it_was(clips: MotionClips, condition: str) -> None:
    seen = CONDITIONS[condition](clips.positions, np.random.default_rng(0))
    cleaned = product.run(product.PRODUCT["steadypose"], seen, clips.stamps_s, delay=4)
    found = figures(score(cleaned.positions, clips.positions, missing(seen)))
    for name, golden in zip(("position_mm", "hidden_mm", "acceleration_mm"), GOLDEN[condition], strict=True):
        if golden is not None:
            assert found[name] < WORSE * golden, f"{name}: {found[name]}, was {golden}"
