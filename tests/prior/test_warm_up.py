"""After the warm-up, no frame waits for a loop: not the first with two people, nor with somebody half hidden.

And the number of loops that the progress of compiling counts to is theirs.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from steadypose.prior.loop_cache import LOOPS

pytestmark = pytest.mark.slow

SCRIPT = """
import sys
sys.path[:0] = sys.argv[1:]
import numpy as np
from numba.core import event
from conftest import walk
from steadypose.nodes.graph.loops import compile_from_the_end
from steadypose.prior.clean.pipeline import PriorPipeline, load_loops
from steadypose.prior.clean.settings import PriorSettings

load_loops(PriorSettings())
pipeline = PriorPipeline(PriorSettings())
with event.install_recorder("numba:compile") as compiled:
    for index, frame in enumerate(walk(50, bodies=3)):
        if 20 <= index < 35:
            for body in frame.bodies:
                body.positions[[7, 8, 10, 11, 20, 21]] = np.nan
        frame.bodies = frame.bodies[: 1 if index >= 45 else 3]
        pipeline.process(frame)
print(sorted({str(made.data["dispatcher"]) for _, made in compiled.buffer}))
compile_from_the_end()
"""


@pytest.mark.timeout(900)  # compiles all loops
def test_no_loop_is_left_for_a_frame_to_wait_for(tmp_path: Path) -> None:
    cold = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}  # what an earlier run compiled would hide what is missing
    root = Path(__file__).parents[2]
    paths = [str(root), str(root / "src"), str(root / "tests" / "nodes")]
    ran = subprocess.run([sys.executable, "-c", SCRIPT, *paths], env=cold, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.strip() == "[]"
    (folder,) = (tmp_path / "steadypose").iterdir()
    assert len(list(folder.iterdir())) == LOOPS
