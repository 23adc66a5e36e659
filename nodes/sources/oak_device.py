"""An OAK camera that is open (depthai 3): people are detected on the camera, and lifted to 3D on this machine.

On the camera run colour, a pose network, stereo depth aligned to colour, and the IMU. What it sends is one object for
the rest of the program (`Host`), made of nodes that run on this machine; tests feed the same nodes from a pipeline that
has no camera. `steadypose calibrate` wants one image with its depth, lens and level (`Still`).
"""

# without `from __future__ import annotations`: depthai reads those of `process` to know what an input takes

import queue
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

import depthai as dai
import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.types import PoseRaw, RawBody
from steadypose.nodes.graph.clock import POLL_S, Clock
from steadypose.nodes.sources.source import CameraError, OakSettings, count_failure
from steadypose.prior.arrays import Floats
from steadypose.prior.body.layouts import COCO17
from steadypose.prior.camera.depth_lifting import lift
from steadypose.prior.camera.gravity import GravityEstimator

FRAME_ID = "oak_rgb_camera_optical_frame"
MODELS = {
    "RVC2": ("luxonis/yolov8-nano-pose-estimation:coco-512x288", 12.0),
    "RVC4": ("luxonis/yolov8-large-pose-estimation:coco-640x352", 30.0),
}
"""by platform: the pose network of Luxonis' model zoo that it runs, and the frames a second it does"""
DEPTH_SIZE = (640, 400)
DEPTH_FPS = 30.0
SYNC_THRESHOLD = timedelta(seconds=0.5 / DEPTH_FPS)
"""maximum difference of the stamps of paired colour and depth images: their sensors are not synchronised"""
IMU_HZ = 100
MAX_BODIES = 8
QUEUE = 4
"""frames kept when the node is late; then the oldest is dropped"""
TIMEOUT_S = 5.0
"""time without a frame after which the camera is closed and opened again"""
STARTUP_TIMEOUT_S = 30.0
"""the same before its first frame"""


def _nanoseconds(time: timedelta) -> int:
    return time // timedelta(microseconds=1) * 1000


class Skeletons(dai.node.HostNode):
    """Detections with key points and the depth image of the same moment, in pairs, to skeletons.

    Attributes:
        found: skeletons not yet taken.
        counts: frames that were dropped or refused, by cause.
    """

    def __init__(self) -> None:
        super().__init__()
        self.found: queue.Queue[PoseRaw] = queue.Queue()
        self.counts: Counter[str] = Counter()
        self._level = GravityEstimator()
        self._source = ""
        self._epoch_ns = 0

    def build(self, pairs: dai.Node.Output, level: GravityEstimator, source: str, epoch_ns: int) -> "Skeletons":
        """Link the node.

        Args:
            pairs: of ``detections`` (``ImgDetections`` with key points) and ``depth`` (``ImgFrame``, millimetres,
                aligned to the image of the detections).
            level: the camera's, which says its pose.
            source: the camera's name, for the messages.
            epoch_ns: wall time, nanoseconds since 1970, of zero on depthai's clock.
        """
        self.link_args(pairs)
        self._level, self._source, self._epoch_ns = level, source, epoch_ns
        return self

    def process(self, pair: dai.MessageGroup) -> None:
        """Work on what was captured at one moment; what it cannot use it counts."""
        try:
            detections, depth = pair["detections"], pair["depth"]
            assert isinstance(detections, dai.ImgDetections)
            assert isinstance(depth, dai.ImgFrame)
            frame = self._lifted(detections, depth)
        except Exception as error:  # whatever the camera sends, the next frame may be good
            count_failure(self.counts, self._source, error)
            return
        while self.found.qsize() >= QUEUE:
            self.found.get_nowait()
            self.counts["late"] += 1
        self.found.put(frame)

    def _lifted(self, detections: dai.ImgDetections, depth: dai.ImgFrame) -> PoseRaw:
        view = depth.getTransformation()
        image = depth.getFrame()
        height, width = image.shape
        found = detections.transformTo(view).detections if detections.getTransformation() else detections.detections
        found = sorted(found, key=lambda detection: -detection.confidence)
        people = [p for p in (detection.getKeypoints() for detection in found) if len(p) == len(COCO17.joints)]
        if strangers := len(found) - len(people):  # another network than one of poses, or of other poses
            self.counts["person without the 17 key points of COCO"] += strangers
        people = people[:MAX_BODIES]
        points = np.array([[(k.imageCoordinates.x, k.imageCoordinates.y, k.confidence) for k in p] for p in people])
        points = points.reshape(len(people), len(COCO17.joints), 3)
        positions, confidence = lift(
            points[..., :2] * (width, height), points[..., 2], image, np.array(view.getIntrinsicMatrix())
        )
        return PoseRaw(
            stamp_ns=self._epoch_ns + _nanoseconds(detections.getTimestamp()),
            frame_id=FRAME_ID,
            source=self._source,
            skeleton=COCO17.name,
            sensor_pose=self._level.pose,
            calibrated=False,
            bodies=[RawBody(id, *body) for id, body in enumerate(zip(positions, confidence, strict=True))],
        )


class ImuReader(dai.node.HostNode):
    """Readings of the IMU, in the camera's frame, to its level."""

    def build(self, readings: dai.Node.Output, level: GravityEstimator, imu_to_camera: Floats) -> "ImuReader":
        """Link the node; ``imu_to_camera`` (3, 3) turns from the IMU's frame to the camera's optical one."""
        self.link_args(readings)
        self._level, self._turn = level, imu_to_camera
        return self

    def process(self, readings: dai.IMUData) -> None:
        for packet in readings.packets:
            acceleration = packet.acceleroMeter
            stamp_ns = _nanoseconds(acceleration.getTimestamp())
            self._level.update(self._turn @ np.array([acceleration.x, acceleration.y, acceleration.z]), stamp_ns)


def _pairs(pipeline: dai.Pipeline, **outputs: dai.Node.Output) -> dai.Node.Output:
    """What was captured at one moment, by name."""
    # a host node's own pairing wants it within 10 ms, and would wait for ever
    sync = pipeline.create(dai.node.Sync)
    sync.setRunOnHost(True)
    sync.setSyncThreshold(SYNC_THRESHOLD)
    for name, output in outputs.items():
        output.link(sync.inputs[name])
    return sync.out


class Host:
    """What runs on this machine for one camera: takes the outputs of its nodes and gives skeletons.

    Args:
        pipeline: that of the outputs, not yet started.
        detections, depth: what `Skeletons.build` takes pairs of.
        readings: of the IMU and the rotation (3, 3) from its frame to the camera's; None without one.
        source: the camera's name.
        clock: of the stamps.
    """

    def __init__(
        self,
        pipeline: dai.Pipeline,
        detections: dai.Node.Output,
        depth: dai.Node.Output,
        readings: tuple[dai.Node.Output, Floats] | None,
        source: str,
        clock: Clock,
    ) -> None:
        self.name = source
        self.level = GravityEstimator()
        self._pipeline = pipeline
        self._clock = clock
        epoch_ns = clock.now_ns() - _nanoseconds(dai.Clock.now())  # pyright: ignore[reportCallIssue] (static)
        pairs = _pairs(pipeline, detections=detections, depth=depth)
        self._skeletons = pipeline.create(Skeletons).build(pairs, self.level, source, epoch_ns)
        if readings:
            pipeline.create(ImuReader).build(readings[0], self.level, readings[1])

    def status(self) -> dict[str, str]:
        return {"camera.level": "measured" if self.level.measured else "taken for level"}

    @property
    def counts(self) -> Counter[str]:
        """Frames dropped or refused, by cause: a copy, because the pipeline's thread goes on counting."""
        return self._skeletons.counts.copy()

    def frames(self) -> Iterator[PoseRaw | None]:
        """Skeletons as they come, None where none came for a while; ends when the camera does."""
        last_frame_ns, timeout_s = self._clock.now_ns(), STARTUP_TIMEOUT_S
        while self._pipeline.isRunning():
            try:
                yield self._skeletons.found.get(timeout=POLL_S)
                last_frame_ns, timeout_s = self._clock.now_ns(), TIMEOUT_S
            except queue.Empty:
                if self._clock.now_ns() - last_frame_ns > timeout_s * 1e9:
                    return
                yield None


def open_device(settings: OakSettings) -> dai.Device:
    """The camera that the settings name.

    Raises:
        RuntimeError: there is no such camera, or it cannot be opened.
    """
    if not settings.device and not dai.Device.getAllAvailableDevices():
        raise CameraError("no camera found; `steadypose doctor` says whether one is plugged in")
    return dai.Device(dai.DeviceInfo(settings.device)) if settings.device else dai.Device()


@contextmanager
def connect(settings: OakSettings, clock: Clock) -> Iterator[Host]:
    """Open the camera and run the whole pipeline on it.

    Raises:
        RuntimeError: there is no such camera, it cannot be opened, or the model cannot be had; depthai says which.
    """
    device = open_device(settings)
    with device:
        device.setMaxReconnectionAttempts(0)  # this program does that, and says so
        platform = device.getPlatformAsString()
        zoo, usual_fps = MODELS.get(platform, MODELS["RVC2"])
        fps = settings.fps or usual_fps
        with dai.Pipeline(device) as pipeline:
            colour = pipeline.create(dai.node.Camera).build(dai.CameraBoardSocket.CAM_A, sensorFps=fps)
            model = (
                dai.NNArchive(Path(settings.archive))
                if settings.archive
                else dai.NNModelDescription(settings.model or zoo)
            )
            network = pipeline.create(dai.node.DetectionNetwork).build(colour, model, fps)
            network.setConfidenceThreshold(settings.confidence)
            _, depth = aligned_depth(pipeline, colour, platform)
            imu = accelerometer(pipeline, device)
            host = Host(pipeline, network.out, depth, imu, f"oak-{device.getDeviceId()}", clock)
            pipeline.start()
            yield host


def aligned_depth(
    pipeline: dai.Pipeline, colour: dai.node.Camera, platform: str
) -> tuple[dai.Node.Output, dai.Node.Output]:
    """Images of the colour camera, without distortion, and stereo depth in the same view."""
    stereo = pipeline.create(dai.node.StereoDepth).build(
        autoCreateCameras=True, presetMode=dai.node.StereoDepth.PresetMode.DEFAULT, size=DEPTH_SIZE, fps=DEPTH_FPS
    )
    stereo.setLeftRightCheck(True)
    stereo.setSubpixel(True)
    view = colour.requestOutput(DEPTH_SIZE, enableUndistortion=True)
    if platform == "RVC4":  # has no alignment in its stereo block
        align = pipeline.create(dai.node.ImageAlign)
        stereo.depth.link(align.input)
        view.link(align.inputAlignTo)
        return view, align.outputAligned
    view.link(stereo.inputAlignTo)
    return view, stereo.depth


def accelerometer(pipeline: dai.Pipeline, device: dai.Device) -> tuple[dai.Node.Output, Floats] | None:
    """The accelerometer's readings and how it is mounted; None for a camera that lacks it, or was not calibrated."""
    if device.getConnectedIMU() in ("", "NONE"):
        return None
    try:
        turn = np.array(device.readCalibration().getImuToCameraExtrinsics(dai.CameraBoardSocket.CAM_A))[:3, :3]
    except RuntimeError:
        return None
    imu = pipeline.create(dai.node.IMU)
    imu.enableIMUSensor(dai.IMUSensor.ACCELEROMETER_RAW, IMU_HZ)
    imu.setBatchReportThreshold(1)
    imu.setMaxBatchReports(10)
    return imu.out, turn


SETTLE_PAIRS = 30
"""pairs skipped while exposure and the direction of gravity settle"""
PAIR_TIMEOUT_S = 20.0
"""for each pair"""
READING_TIMEOUT_S = 1.0
"""for the accelerometer, which may speak after the image"""


@dataclass(frozen=True)
class Still:
    """One moment of a camera.

    Attributes:
        colour: (H, W, 3) BGR, without distortion.
        depth: (H, W) millimetres, in the view of ``colour``; 0 in holes.
        intrinsics: (3, 3) of both.
        up: (3,) what the IMU feels as up, optical frame; None without an IMU that is calibrated.
    """

    colour: NDArray[np.uint8]
    depth: NDArray[np.uint16]
    intrinsics: NDArray[np.float64]
    up: NDArray[np.float64] | None


class Pairs(dai.node.HostNode):
    """Hands out pairs of ``colour`` and ``depth``."""

    def __init__(self) -> None:
        super().__init__()
        self.pairs: queue.Queue[tuple[Any, Any]] = queue.Queue(maxsize=2)

    def build(self, pairs: dai.Node.Output) -> "Pairs":
        """Link the node."""
        self.link_args(pairs)
        return self

    def process(self, pair: dai.MessageGroup) -> None:
        if not self.pairs.full():
            self.pairs.put((pair["colour"], pair["depth"]))


def capture(
    pipeline: dai.Pipeline,
    colour: dai.Node.Output,
    depth: dai.Node.Output,
    readings: tuple[dai.Node.Output, NDArray[np.float64]] | None,
    settle: int = SETTLE_PAIRS,
) -> Still:
    """Start a pipeline that has these outputs, and capture the image that comes after ``settle`` others.

    Raises:
        CameraError: none comes.
    """
    pairs = pipeline.create(Pairs).build(_pairs(pipeline, colour=colour, depth=depth))
    level = GravityEstimator()
    if readings:
        pipeline.create(ImuReader).build(readings[0], level, readings[1])
    pipeline.start()
    try:
        for _ in range(settle):
            pairs.pairs.get(timeout=PAIR_TIMEOUT_S)
        image, distances = pairs.pairs.get(timeout=PAIR_TIMEOUT_S)
    except queue.Empty:
        raise CameraError(f"the camera gave no image with depth within {PAIR_TIMEOUT_S:g} s") from None
    late = time.monotonic() + READING_TIMEOUT_S
    while readings and not level.measured and time.monotonic() < late:
        time.sleep(0.01)
    intrinsics = np.array(distances.getTransformation().getIntrinsicMatrix())
    return Still(image.getCvFrame(), distances.getFrame().copy(), intrinsics, level.up if level.measured else None)


def capture_with_camera(settings: OakSettings) -> Still:
    """An image of the camera that the settings name.

    Raises:
        RuntimeError: the camera cannot be opened, or gives none.
    """
    device = open_device(settings)
    with device, dai.Pipeline(device) as pipeline:
        sensor = pipeline.create(dai.node.Camera).build(dai.CameraBoardSocket.CAM_A, sensorFps=DEPTH_FPS)
        colour, depth = aligned_depth(pipeline, sensor, device.getPlatformAsString())
        return capture(pipeline, colour, depth, accelerometer(pipeline, device))
