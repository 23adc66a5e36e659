"""A video in place of a webcam: the same landmarker and lens, with the stamps of its pictures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import cv2

from steadypose.msgs.topics import POSE_RAW
from steadypose.msgs.types import Message
from steadypose.nodes.graph.settings import LaunchError
from steadypose.nodes.sources.calibration import CalibrationSettings
from steadypose.nodes.sources.camera_settings import WebcamSettings
from steadypose.nodes.sources.webcam_device import Landmarker, PoseFinder, mediapipe_landmarker


class VideoSource:
    """The skeletons that MediaPipe sees in a film, a recorded source: no picture is left out, however long it takes.

    Raises:
        LaunchError: the film cannot be opened.
    """

    def __init__(
        self,
        settings: WebcamSettings,
        calibration: CalibrationSettings,
        make_landmarker: Callable[[WebcamSettings], AbstractContextManager[Landmarker]] = mediapipe_landmarker,
    ) -> None:
        self.refused: Counter[str] = Counter()
        self._settings, self._calibration, self._make_landmarker = settings, calibration, make_landmarker
        film = cv2.VideoCapture(settings.video)
        if not film.isOpened():
            raise LaunchError(f"[input.webcam] video: expected a film that OpenCV can read, got {settings.video!r}")
        self._pictures = max(int(film.get(cv2.CAP_PROP_FRAME_COUNT)), 0)
        self._period_ns = round(1e9 / (film.get(cv2.CAP_PROP_FPS) or 30.0))
        film.release()

    def __len__(self) -> int:
        return self._pictures

    def __iter__(self) -> Iterator[tuple[str, Message]]:
        film = cv2.VideoCapture(self._settings.video)
        name = Path(self._settings.video).stem
        stamp_ns = -1
        try:
            with self._make_landmarker(self._settings) as landmarker:
                finder = PoseFinder(name, landmarker, self._settings, self._calibration)
                while film.grab():
                    reported_ns = round(film.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
                    # some containers state the frame rate alone
                    if reported_ns > stamp_ns:
                        stamp_ns = reported_ns
                    else:
                        stamp_ns += self._period_ns if stamp_ns >= 0 else 1
                    good, image = film.retrieve()
                    if good and (frame := finder.find(image, stamp_ns)) is not None:
                        yield POSE_RAW, frame
                    elif not good:
                        self.refused["picture that cannot be decoded"] += 1
                self.refused.update(finder.counts)
        finally:
            film.release()
