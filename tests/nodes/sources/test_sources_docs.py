import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
from tests.helpers.fake_oak import CAMERA, moment

from steadypose.msgs.topics import POSE_RAW
from steadypose.msgs.transport import Subscriber
from steadypose.msgs.types import PoseRaw
from steadypose.nodes.commands.output import clean_recording
from steadypose.nodes.sources.recording import CsvSource

DOCS = Path(__file__).parents[3] / "docs"
BLOCKS = dict(
    re.findall(
        r"^<!-- file: (\S+) -->\n```\w+\n(.*?)^```$", (DOCS / "sources.md").read_text(), re.MULTILINE | re.DOTALL
    )
)
SOON_S = 30.0

# the reader's own detector and depth camera
DETECTOR = """
import time
import numpy as np

scene = np.load("scene.npz")

def detect():
    time.sleep(0.01)
    points = np.column_stack([scene["pixels"], np.full(17, 0.9)])
    return [{"keypoints": points.ravel().tolist()}], scene["depth"], scene["intrinsics"], time.time()
"""


def test_the_publisher_publishes(tmp_path: Path) -> None:
    scene = moment(3)
    pixels = CAMERA.project(scene.joints[0])
    np.savez(tmp_path / "scene.npz", pixels=pixels, depth=scene.depth, intrinsics=CAMERA.intrinsics)
    (tmp_path / "detector.py").write_text(DETECTOR)
    (tmp_path / "publisher.py").write_text(BLOCKS["publisher.py"])
    address = f"ipc://{tmp_path}/steadypose/pose_input"
    root = str(DOCS.parent / "src")
    with (
        Subscriber(address, POSE_RAW) as subscriber,
        subprocess.Popen(
            [sys.executable, "publisher.py"],
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": root, "XDG_RUNTIME_DIR": str(tmp_path)},
        ) as process,
    ):
        received = subscriber.receive(SOON_S)
        process.kill()
    assert received
    frame = received[1]
    assert isinstance(frame, PoseRaw)
    assert frame.source == "my camera"
    error = np.linalg.norm(frame.bodies[0].positions - scene.joints[0], axis=-1)[5:]
    assert np.nanmedian(error) < 0.04
    assert len([line for line in BLOCKS["publisher.py"].splitlines() if line.strip()]) <= 12


def test_the_csv_is_read(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text(BLOCKS["reach.csv"])
    source = CsvSource(tmp_path / "x.csv")
    frames = [message for _, message in source if isinstance(message, PoseRaw)]
    assert not source.refused
    assert [frame.stamp_ns for frame in frames] == [0, 33_000_000, 67_000_000, 100_000_000]
    assert frames[0].skeleton == "coco17"
    np.testing.assert_allclose(frames[0].bodies[0].positions[9], [-0.41, 0.12, 2.80], atol=1e-6)
    assert np.isnan(frames[2].bodies[0].positions[9]).all()
    clean_recording(tmp_path / "x.csv", tmp_path / "x.npz", {"prior": {}, "trajectory": {}})
    with np.load(tmp_path / "x.npz") as cleaned:
        assert np.isfinite(cleaned["positions"]).all(), "a body in every row"
