"""Recorded skeletons: a rosbag2 directory, an ``.mcap``, an ``.npz``, a ``.csv``, a file of motion, or a video."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from steadypose.msgs.recording import RecordingError, RecordingReader
from steadypose.msgs.topics import POSE_RAW, POSE_TRUTH
from steadypose.msgs.types import Diagnostics, Message, PoseRaw
from steadypose.nodes.graph.extras import require_extra
from steadypose.nodes.graph.settings import LaunchError
from steadypose.nodes.sources.csv import CsvSource
from steadypose.nodes.sources.npz import MotionSource, NpzSource, holds_motion
from steadypose.nodes.sources.source import CalibrationSettings, RecordedSource, WebcamSettings

NO_RIG: Mapping[str, Any] = MappingProxyType({})
_FILES = ".csv, .npz, .bvh, .trc, .c3d or .npy"
VIDEOS = (".avi", ".m4v", ".mkv", ".mov", ".mp4", ".webm")
"""videos, in which MediaPipe finds the skeletons"""

LOST, BROKEN, UNDECODABLE = "bytes of a damaged recording", "damaged recording", "undecodable"
DAMAGE = (LOST, BROKEN, UNDECODABLE)
"""how the causes begin that count what a recording holds and nobody can read"""


class RecordingSource:
    """The skeletons of a recording, without the mark of its end.

    Raises:
        RecordingError: there is no recording, or no ``pose/raw`` in it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with RecordingReader(path) as recording:
            if not recording.count(POSE_RAW):
                raise RecordingError(
                    f"{path}: expected messages on {POSE_RAW}, got {', '.join(recording.topics)}; record that topic too"
                )
            self.refused: Counter[str] = Counter({LOST: recording.lost_bytes})
            self._frames = recording.count(POSE_RAW)

    def __len__(self) -> int:
        return self._frames

    def __iter__(self) -> Iterator[tuple[str, Message]]:
        with RecordingReader(self.path) as recording:
            try:
                for topic, _, message in recording.messages([POSE_RAW, POSE_TRUTH]):
                    if not isinstance(message, Diagnostics) and not message.end_of_stream:
                        yield topic, message
            except RecordingError:
                self.refused[BROKEN] += 1
            self.refused[LOST] = recording.lost_bytes
            self.refused.update({f"{UNDECODABLE} {topic}": n for topic, n in recording.refused.items()})


def open_recording(path: str | Path, rig: Mapping[str, Any] = NO_RIG) -> RecordedSource:
    """The recording at ``path``: a rosbag2 directory, ``.mcap``, ``.npz`` or ``.csv``, a file of motion, or a video.

    Args:
        path: of the recording.
        rig: what a file of motion does not say (`prior.mocap.files.Description`).

    Raises:
        LaunchError: there is nothing at the path, or it is a video and MediaPipe is not installed.
        RecordingError, NpzError, CsvError, MotionError: the file holds no skeletons. All are ValueErrors that say what
            to do.
    """
    if not str(path):
        raise LaunchError(f"[input] recording: expected a recording or {_FILES} to play, got none; give --input")
    path = Path(path)
    if not path.exists():
        raise LaunchError(f"{path} does not exist: expected a rosbag2 directory, an .mcap, or {_FILES}")
    if path.suffix.lower() in VIDEOS:
        return _open_film(path)
    if holds_motion(path):
        return MotionSource(path, rig)
    formats: Mapping[str, Callable[[Path], RecordedSource]] = {".npz": NpzSource, ".csv": CsvSource}
    return formats.get(path.suffix, RecordingSource)(path)


def _open_film(path: Path) -> RecordedSource:
    require_extra("webcam")
    from steadypose.nodes.sources.webcam_device import VideoSource  # OpenCV

    return VideoSource(WebcamSettings(video=str(path)), CalibrationSettings())


def with_end(messages: Iterable[tuple[str, Message]]) -> Iterator[tuple[str, Message]]:
    """The messages, followed by the end-of-stream mark."""
    last: PoseRaw | None = None
    for topic, message in messages:
        yield topic, message
        if isinstance(message, PoseRaw):
            last = message
    if last:
        yield POSE_RAW, end_of(last)


def end_of(last: PoseRaw) -> PoseRaw:
    """The mark of the end of a stream, after its last message."""
    return dataclasses.replace(last, bodies=[], end_of_stream=True)
