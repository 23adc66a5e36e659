"""Webcams and videos by OpenCV: undistorts the images, and detects skeletons in them by MediaPipe."""

import os
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, nullcontext
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.topics import POSE_RAW
from steadypose.msgs.types import Message, PoseRaw
from steadypose.nodes.graph.clock import Clock
from steadypose.nodes.settings import LaunchError, as_text
from steadypose.nodes.sources.adapters import from_mediapipe, pinhole
from steadypose.nodes.sources.image import ImageWriter
from steadypose.nodes.sources.source import MODEL, CalibrationSettings, CameraError, WebcamSettings, count_failure

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # AV_LOG_QUIET: what cannot be read is reported here

Landmarker = Callable[[NDArray[Any], int], Any]
"""Function from an RGB image (H, W, 3) and its time in increasing milliseconds to a ``PoseLandmarkerResult``."""


class Lens:
    """Undistorts a webcam's images of ``size`` (width and height, pixels).

    The intrinsics are calibrated ones, scaled to images of that size, or guessed from the horizontal field of view
    (radians). Raises LaunchError if the calibration is for another aspect ratio.
    """

    def __init__(self, size: tuple[int, int], field_of_view: float, calibration: CalibrationSettings) -> None:
        self.size = size
        self.intrinsics = pinhole(size, field_of_view)
        self._maps = None
        if calibration.size:
            scale = np.array(size) / calibration.size
            if abs(scale[0] / scale[1] - 1.0) > 0.01:  # cropped to an unknown part of the lens's view
                expected, got = ("{} x {}".format(*size) for size in (calibration.size, size))
                remedy = "calibrate it with images of that size"
                raise LaunchError(f"[input.calibration] size: expected images of {expected}, got {got}; {remedy}")
            self.intrinsics[[0, 1], [0, 1]] = calibration.focal * scale
            self.intrinsics[:2, 2] = (np.array(calibration.centre) + 0.5) * scale - 0.5
            distortion = np.array(calibration.distortion)
            if distortion.any():
                lens = self.intrinsics
                self._maps = cv2.initUndistortRectifyMap(lens, distortion, np.eye(3), lens, size, cv2.CV_16SC2)

    def undistort(self, image: NDArray[Any]) -> NDArray[Any]:
        """Undistort an image (H, W, 3)."""
        return cv2.remap(image, *self._maps, cv2.INTER_LINEAR) if self._maps else image


class PoseFinder:
    """Detects bodies in the images of one camera, in the order of time; ``counts`` counts failed images, by cause."""

    def __init__(
        self,
        name: str,
        landmarker: Landmarker,
        settings: WebcamSettings,
        calibration: CalibrationSettings,
        image_file: Path | None = None,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._name, self._landmarker = name, landmarker
        self._settings, self._calibration = settings, calibration
        self._newest = ImageWriter(image_file) if image_file else None
        self._lens: Lens | None = None
        self._started_ns: int | None = None
        self._last_ms = -1

    def find(self, image: NDArray[Any], stamp_ns: int) -> PoseRaw | None:
        """The bodies in a BGR image (H, W, 3) taken at ``stamp_ns``. None if it fails, which is counted."""
        self._started_ns = stamp_ns if self._started_ns is None else self._started_ns
        # the landmarker requires increasing times
        self._last_ms = max((stamp_ns - self._started_ns) // 1_000_000, self._last_ms + 1)
        size = (image.shape[1], image.shape[0])
        if self._lens is None or self._lens.size != size:
            self._lens = Lens(size, self._settings.field_of_view, self._calibration)
        try:
            straight = self._lens.undistort(image)
            if self._newest:
                self._newest.put(straight, stamp_ns, self._lens.intrinsics)
            result = self._landmarker(cv2.cvtColor(straight, cv2.COLOR_BGR2RGB), self._last_ms)
            return from_mediapipe(result, stamp_ns, size, self._lens.intrinsics, self._name)
        except (cv2.error, ValueError) as error:  # an unsupported image, or an invalid result
            count_failure(self.counts, self._name, error)
            return None

    def close(self) -> None:
        if self._newest:
            self._newest.close()


class Webcam:
    """An open webcam, and the landmarker for its images."""

    def __init__(self, capture: cv2.VideoCapture, finder: PoseFinder, name: str, clock: Clock) -> None:
        self.name = name
        self._capture, self._finder, self._clock = capture, finder, clock

    @property
    def counts(self) -> Counter[str]:
        return self._finder.counts

    def frames(self) -> Iterator[PoseRaw | None]:
        while self._capture.grab():
            stamp_ns = self._clock.now_ns()  # time of arrival, because the system gives no capture time
            good, image = self._capture.retrieve()
            if good:
                yield self._finder.find(image, stamp_ns)
            else:
                self.counts["image that cannot be decoded"] += 1
                yield None

    def status(self) -> dict[str, str]:
        return {}


@contextmanager
def mediapipe_landmarker(settings: WebcamSettings) -> Iterator[Landmarker]:
    """MediaPipe's pose landmarker in video mode, with the configured model or the built-in one.

    Raises LaunchError if the model cannot be used, or MediaPipe has no built-in one.
    """
    with ExitStack() as stack:
        with _silent():
            landmarker = stack.enter_context(_landmarker_of(settings) if settings.model else _own_landmarker())
        calls = count()

        def find(image: NDArray[Any], milliseconds: int) -> Any:
            with nullcontext() if next(calls) else _silent():
                return landmarker(image, milliseconds)

        yield find


@contextmanager
def _silent() -> Iterator[None]:
    """Discard what libraries write to standard error: MediaPipe logs at its start and at the first image."""
    kept, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nothing, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nothing)


@contextmanager
def _own_landmarker() -> Iterator[Landmarker]:
    """MediaPipe's built-in landmarker for one body, without its smoothing, which is the prior's task."""
    try:
        from mediapipe.python.solutions.pose import Pose  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError as error:
        if error.name == "mediapipe":
            raise
        without = "this MediaPipe comes without one (0.10 has one, for Python up to 3.12)"
        raise LaunchError(f"[input.webcam] model: {without}; download one, such as {MODEL}") from error

    def alone(landmarks: Any) -> list[Any]:
        return [] if landmarks is None else [landmarks.landmark]

    with Pose(smooth_landmarks=False) as pose:

        def find(image: NDArray[Any], _: int) -> SimpleNamespace:
            found: Any = pose.process(image)
            return SimpleNamespace(
                pose_landmarks=alone(found.pose_landmarks), pose_world_landmarks=alone(found.pose_world_landmarks)
            )

        yield find


@contextmanager
def _landmarker_of(settings: WebcamSettings) -> Iterator[Landmarker]:
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
        raise LaunchError(f"[input.webcam] model: MediaPipe cannot use {settings.model}: {error}") from error
    with found:
        yield lambda image, milliseconds: found.detect_for_video(
            mediapipe.Image(image_format=mediapipe.ImageFormat.SRGB, data=image), milliseconds
        )


@contextmanager
def connect(
    settings: WebcamSettings,
    calibration: CalibrationSettings,
    clock: Clock,
    make_landmarker: Callable[[WebcamSettings], AbstractContextManager[Landmarker]] = mediapipe_landmarker,
    image_file: Path | None = None,
) -> Iterator[Webcam]:
    """Open the camera and the landmarker. Raises CameraError or LaunchError if camera or model cannot be used."""
    capture = cv2.VideoCapture(settings.camera)
    try:
        if not capture.isOpened():
            raise CameraError(f"camera {settings.camera} cannot be opened; `ls /dev/video*` lists them")
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # read the newest image, not the oldest in the buffer
        with make_landmarker(settings) as landmarker:
            name = settings.name or f"webcam-{settings.camera}"
            with closing(PoseFinder(name, landmarker, settings, calibration, image_file)) as finder:
                yield Webcam(capture, finder, name, clock)
    finally:
        capture.release()


def stamped_images(video: cv2.VideoCapture) -> Iterator[tuple[int, NDArray[Any] | None]]:
    """Stamps in nanoseconds and BGR images (H, W, 3) of an open video; None for an image that cannot be decoded."""
    period_ns = round(1e9 / (video.get(cv2.CAP_PROP_FPS) or 30.0))
    stamp_ns = -1
    while video.grab():
        reported_ns = round(video.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
        # some containers have only a frame rate
        if reported_ns > stamp_ns:
            stamp_ns = reported_ns
        else:
            stamp_ns += period_ns if stamp_ns >= 0 else 1
        good, image = video.retrieve()
        yield stamp_ns, image if good else None


class VideoSource:
    """The skeletons that MediaPipe detects in every image of a video. Raises LaunchError if it cannot be opened."""

    def __init__(
        self,
        settings: WebcamSettings,
        calibration: CalibrationSettings,
        make_landmarker: Callable[[WebcamSettings], AbstractContextManager[Landmarker]] = mediapipe_landmarker,
        image_file: Path | None = None,
    ) -> None:
        self.path = Path(settings.video)
        self.refused: Counter[str] = Counter()
        self._settings, self._calibration, self._make_landmarker = settings, calibration, make_landmarker
        self._image_file = image_file
        video = cv2.VideoCapture(settings.video)
        if not video.isOpened():
            raise LaunchError(f"[input.webcam] video: expected a video that OpenCV can read, got {settings.video!r}")
        self._images = max(int(video.get(cv2.CAP_PROP_FRAME_COUNT)), 0)
        video.release()

    def __len__(self) -> int:
        return self._images

    def __iter__(self) -> Iterator[tuple[str, Message]]:
        video = cv2.VideoCapture(self._settings.video)
        name = as_text(self.path.stem)
        try:
            with (
                self._make_landmarker(self._settings) as landmarker,
                closing(PoseFinder(name, landmarker, self._settings, self._calibration, self._image_file)) as finder,
            ):
                for stamp_ns, image in stamped_images(video):
                    if image is None:
                        self.refused["image that cannot be decoded"] += 1
                    elif (frame := finder.find(image, stamp_ns)) is not None:
                        yield POSE_RAW, frame
                self.refused.update(finder.counts)
        finally:
            video.release()
