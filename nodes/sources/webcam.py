"""Any camera the system knows, with MediaPipe's pose landmarker: no depth, so distances rest on the body's size.

MediaPipe is an optional extra, and its model a file of its own (docs/sources.md says where from).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.types import PoseRaw
from steadypose.nodes.graph.launch import CalibrationSettings, LaunchError, WebcamSettings
from steadypose.nodes.graph.runtime import Clock
from steadypose.nodes.sources.adapters import from_mediapipe, pinhole
from steadypose.nodes.sources.camera import CameraError, CameraSource, count_failure

MODEL = (
    "https://storage.googleapis.com/mediapipe-models/pose_landmarker/pose_landmarker_full/float16/latest/"
    "pose_landmarker_full.task"
)

Landmarker = Callable[[NDArray[Any], int], Any]
"""an RGB image (H, W, 3) and its milliseconds, which rise, to a ``PoseLandmarkerResult``"""


class Lens:
    """What takes a webcam's distortion out of its pictures, and their intrinsics then: as calibrated, or a guess.

    Args:
        size: width and height of the pictures.
        field_of_view: radians; what is guessed from where nothing is calibrated.
        told: the calibration; for pictures of another size it is scaled.

    Raises:
        LaunchError: it is of pictures of another shape.
    """

    def __init__(self, size: tuple[int, int], field_of_view: float, told: CalibrationSettings) -> None:
        self.size = size
        self.intrinsics = pinhole(size, field_of_view)
        self._maps = None
        if told.size:
            scale = np.array(size) / told.size
            if abs(scale[0] / scale[1] - 1.0) > 0.01:  # another part of the lens's view, and nobody says which
                raise LaunchError(
                    f"[input.calibration] size: the lens was calibrated for pictures of {told.size[0]} x "
                    f"{told.size[1]}, the camera gives {size[0]} x {size[1]}; calibrate it with pictures of that size"
                )
            self.intrinsics[[0, 1], [0, 1]] = told.focal * scale
            self.intrinsics[:2, 2] = (np.array(told.centre) + 0.5) * scale - 0.5
            bent = np.array(told.distortion)
            if bent.any():
                self._maps = cv2.initUndistortRectifyMap(
                    self.intrinsics, bent, np.eye(3), self.intrinsics, size, cv2.CV_16SC2
                )

    def straightened(self, image: NDArray[Any]) -> NDArray[Any]:
        """A picture (H, W, 3) without distortion."""
        return cv2.remap(image, *self._maps, cv2.INTER_LINEAR) if self._maps else image


class Webcam:
    """A webcam that is open, and the landmarker that looks at its pictures."""

    def __init__(
        self,
        capture: cv2.VideoCapture,
        look: Landmarker,
        settings: WebcamSettings,
        calibration: CalibrationSettings,
        clock: Clock,
    ) -> None:
        self.name = f"webcam-{settings.camera}"
        self.counts: Counter[str] = Counter()
        self._capture, self._look, self._clock = capture, look, clock
        self._settings, self._calibration = settings, calibration

    def frames(self) -> Iterator[PoseRaw | None]:
        started_ns = last_ms = lens = None
        while self._capture.grab():
            stamp_ns = self._clock.now_ns()  # the system tells no better: exposure and transfer have passed
            started_ns = stamp_ns if started_ns is None else started_ns
            good, image = self._capture.retrieve()
            if not good:
                self.counts["picture that cannot be decoded"] += 1
                yield None
                continue
            now_ms = (stamp_ns - started_ns) // 1_000_000
            last_ms = now_ms if last_ms is None else max(now_ms, last_ms + 1)  # the landmarker wants them to rise
            size = (image.shape[1], image.shape[0])
            if lens is None or lens.size != size:
                lens = Lens(size, self._settings.field_of_view, self._calibration)
            frame = None
            try:
                result = self._look(cv2.cvtColor(lens.straightened(image), cv2.COLOR_BGR2RGB), last_ms)
                frame = from_mediapipe(result, stamp_ns, size, lens.intrinsics, self.name)
            except (cv2.error, ValueError) as error:  # a picture of another kind, a result that is none
                count_failure(self.counts, self.name, error)
            yield frame

    def status(self) -> dict[str, str]:
        return {}


@contextmanager
def landmarker(settings: WebcamSettings) -> Iterator[Landmarker]:
    """MediaPipe's pose landmarker, for a film.

    Raises:
        LaunchError: the model is none.
    """
    # an extra, of which nobody need have the types
    import mediapipe  # pyright: ignore[reportMissingImports]
    from mediapipe.tasks.python import BaseOptions, vision  # pyright: ignore[reportMissingImports]

    options = vision.PoseLandmarkerOptions(
        base_options=BaseOptions(model_asset_path=settings.model),
        running_mode=vision.RunningMode.VIDEO,
        num_poses=settings.bodies,
    )
    try:
        found = vision.PoseLandmarker.create_from_options(options)
    except (OSError, ValueError, RuntimeError) as error:
        raise LaunchError(
            f"[input.webcam] model: MediaPipe cannot use {settings.model} as a pose landmarker: {error}"
        ) from error
    with found:
        yield lambda image, milliseconds: found.detect_for_video(
            mediapipe.Image(image_format=mediapipe.ImageFormat.SRGB, data=image), milliseconds
        )


class WebcamSource(CameraSource):
    """The skeletons that MediaPipe sees in a webcam's pictures.

    Raises:
        LaunchError: MediaPipe or its model is missing, or a setting cannot be used.
    """

    def __init__(
        self,
        settings: WebcamSettings,
        calibration: CalibrationSettings,
        clock: Clock,
        make_landmarker: Callable[[WebcamSettings], AbstractContextManager[Landmarker]] = landmarker,
    ) -> None:
        super().__init__(clock)
        if settings.bodies < 1 or settings.camera < 0 or not 0 < settings.field_of_view < math.pi:
            raise LaunchError(
                "[input.webcam] expected camera of 0 or more, bodies of 1 or more and field_of_view in radians, "
                f"0 to pi; got {settings.camera}, {settings.bodies} and {settings.field_of_view:g}"
            )
        if not Path(settings.model).is_file():
            raise LaunchError(
                f"[input.webcam] model: expected MediaPipe's pose landmarker, a .task file, got {settings.model!r}; "
                f"download one, such as {MODEL}"
            )
        if make_landmarker is landmarker:
            require_mediapipe()
        self._settings, self._calibration, self._make_landmarker = settings, calibration, make_landmarker

    @contextmanager
    def connect(self) -> Iterator[Webcam]:
        capture = cv2.VideoCapture(self._settings.camera)
        try:
            if not capture.isOpened():
                raise CameraError(f"camera {self._settings.camera} cannot be opened; `ls /dev/video*` lists them")
            capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # the newest picture, not the oldest that waits
            with self._make_landmarker(self._settings) as look:
                yield Webcam(capture, look, self._settings, self._calibration, self._clock)
        finally:
            capture.release()


def require_mediapipe() -> None:
    """Raises:
    LaunchError: MediaPipe is not installed.
    """
    if find_spec("mediapipe") is None:
        raise LaunchError(
            "a webcam needs mediapipe, which is not installed: run `uv sync --inexact --extra webcam` in the checkout, "
            "or `pip install 'steadypose[webcam]'`; every other source works without it"
        )
