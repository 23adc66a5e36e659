"""Every stream of sim_data still comes out as it did when golden.npz was written, to a tenth of a millimetre.

Whoever means to change the output writes the file anew, from the repository's root, and says in the commit what it is
worth: ``python -m tests.nodes.commands.test_golden``.
"""

from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from steadypose.msgs.types import PoseClean, PoseRaw, PoseWorld
from steadypose.nodes.driving import stream
from steadypose.nodes.graph.prior_node import make_prior
from steadypose.nodes.graph.trajectory_node import make_trajectory
from steadypose.nodes.sources.recording import open_recording

GOLDEN = Path(__file__).with_name("golden.npz")
STREAMS = Path(__file__).parents[3] / "sim_data"
NAMES = sorted(path.name for path in STREAMS.iterdir() if path.is_dir())
LIKE_ANOTHER = ("idle", "reach", "sit_rise")
"""of one person and without what the others show"""
FRAMES = {"crossing": (60, 180), "leave_reenter": (200, 310)}
"""where people hide each other, or come into sight; of others the first 90"""
EVERY = 10
"""frames of which one is kept"""
TOLERANCE = 1e-4
"""metres: other processors round otherwise, in single precision"""


def outcome(name: str) -> dict[str, NDArray[np.float32]]:
    """Of the bodies in every tenth message of each topic, one after the other: joints (N, 22, 3) and sigma (N, 22)."""
    raw = (item for item in open_recording(STREAMS / name) if isinstance(item[1], PoseRaw))
    seen = islice(raw, *FRAMES.get(name, (90,)))
    answers = [message for _, message in stream(seen, make_prior({}), make_trajectory({}))]
    found = {}
    for topic, kind in (("clean", PoseClean), ("world", PoseWorld)):
        kept = [message for message in answers if isinstance(message, kind)][::EVERY]
        bodies = [body for message in kept for body in message.bodies]
        found[f"{name}/{topic}/positions"] = np.array([body.positions for body in bodies], dtype=np.float32)
        found[f"{name}/{topic}/sigma"] = np.array([body.sigma for body in bodies], dtype=np.float32)
    return found


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in LIKE_ANOTHER else ()) for name in NAMES]
)
def test_a_stream_comes_out_as_it_did(name: str) -> None:
    with np.load(GOLDEN) as golden:
        for part, found in outcome(name).items():
            np.testing.assert_allclose(found, golden[part], rtol=0, atol=TOLERANCE, err_msg=part)
            assert len(found) >= 7


if __name__ == "__main__":
    arrays: dict[str, Any] = {part: array for name in NAMES for part, array in outcome(name).items()}
    np.savez_compressed(GOLDEN, **arrays)
