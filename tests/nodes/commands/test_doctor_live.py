import dataclasses
from pathlib import Path

import pytest
from conftest import running, walk
from rich.console import Console

from steadypose.msgs.topics import POSE_RAW
from steadypose.msgs.types import PoseRaw
from steadypose.nodes.commands import doctor as live
from steadypose.nodes.graph.clock import SystemClock
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.node import Node


class Tracker(Node):
    """Publishes frames, again and again."""

    name = "pose_input"
    frames: tuple[PoseRaw, ...] = ()

    def handle(self, topic: str, message: object) -> None:
        raise AssertionError

    def work(self) -> None:
        index = 0
        while not self.stopping:
            frame = self.frames[index % len(self.frames)]
            self.publish(POSE_RAW, dataclasses.replace(frame, stamp_ns=self.clock.now_ns()))
            self.clock.sleep(10_000_000)
            index += 1


@pytest.fixture
def file(tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    path = tmp_path / "launch.toml"
    path.write_text(f'[transport]\ndirectory = "{folder}"\nlossless = false\n')
    monkeypatch.setattr(live, "LISTEN_NS", 800_000_000)
    return str(path)


def heard(file: str, frames: list[PoseRaw]) -> tuple[int, str]:
    """Status and text of a doctor who listens to a tracker with these frames; to nobody without."""
    console = Console(record=True, width=200)
    node = Tracker(Launch.read(file), SystemClock())
    node.frames = tuple(frames)
    with running(*[node] if frames else []):
        return live.listen(file, console), console.export_text()


@pytest.mark.parametrize(
    ("frames", "status", "told"),
    [
        ([dataclasses.replace(raw, calibrated=False) for raw in walk(120)], 0, "no problems found"),
        ([dataclasses.replace(raw, skeleton="smpl") for raw in walk(30)], 1, "most like 'smpl22'"),
        ([], 1, "start the tracker"),
    ],
    ids=["good", "bad", "none"],
)
def test_what_is_wrong_with_a_tracker_is_told(file: str, frames: list[PoseRaw], status: int, told: str) -> None:
    found, text = heard(file, frames)
    assert (found, told in text) == (status, True), text
