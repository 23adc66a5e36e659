"""An open OAK camera (depthai 3). The camera detects people; this machine lifts their key points to 3D.

The camera runs its colour sensor, a pose network, stereo depth aligned to colour, and the IMU. `Host` combines depthai
nodes that run on this machine and receive the camera's data; tests feed the same nodes from a pipeline without a
camera. `steadypose calibrate` uses one image with its depth, lens and level (`Still`).
"""

# without `from __future__ import annotations`: depthai reads the annotations of `process` as the types of its inputs

import queue
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

import depthai as dai
import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.types import PoseRaw, RawBody
from steadypose.nodes.graph.clock import POLL_S, Clock
from steadypose.nodes.sources.image import ImageWriter
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
"""Pose network of Luxonis' model zoo, and its frame rate in Hz, by platform."""
DEPTH_SIZE = (640, 400)
DEPTH_FPS = 30.0
SYNC_THRESHOLD = timedelta(seconds=0.5 / DEPTH_FPS)
"""Largest difference between the stamps of paired colour and depth images. Their sensors are not synchronised."""
IMU_HZ = 100
MAX_BODIES = 8
QUEUE = 4  # largest number of frames queued when the node is late; beyond it the oldest is dropped
TIMEOUT_S = 5.0  # time without a frame after which the camera is closed and reopened, seconds
STARTUP_TIMEOUT_S = 30.0  # time without a first frame after which the camera is closed and reopened, seconds


def _nanoseconds(time: timedelta) -> int:
    return time // timedelta(microseconds=1) * 1000


class Skeletons(dai.node.HostNode):
    """Converts pairs of detections (with key points) and depth images of the same time to skeletons.

    ``found`` is a queue of skeletons; ``counts`` counts frames dropped or refused, by cause.
    """

    def __init__(self) -> None:
        super().__init__()
        self.found: queue.Queue[PoseRaw] = queue.Queue()
        self.counts: Counter[str] = Counter()
        self._level = GravityEstimator()
        self._source = ""
        self._epoch_ns = 0

    def build(self, pairs: dai.Node.Output, level: GravityEstimator, source: str, epoch_ns: int) -> "Skeletons":
        """Link the node to pairs of ``detections`` (``ImgDetections`` with key points) and ``depth`` (``ImgFrame``,
        millimetres, aligned to the image of the detections).

        ``source`` is the camera's name, ``epoch_ns`` the wall time of zero on depthai's clock, ns since 1970.
        """
        self.link_args(pairs)
        self._level, self._source, self._epoch_ns = level, source, epoch_ns
        return self

    def process(self, pair: dai.MessageGroup) -> None:
        """Process one pair. Unusable pairs are counted."""
        try:
            detections, depth = pair["detections"], pair["depth"]
            assert isinstance(detections, dai.ImgDetections)
            assert isinstance(depth, dai.ImgFrame)
            frame = self._lifted(detections, depth)
        except Exception as error:  # a bad frame must not stop the node
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
        if strangers := len(found) - len(people):  # the network detects no poses, or has other key points
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
    """Passes the IMU's readings, rotated to the camera's frame, to the gravity estimator."""

    def build(self, readings: dai.Node.Output, level: GravityEstimator, imu_to_camera: Floats) -> "ImuReader":
        """Link the node; ``imu_to_camera`` (3, 3) rotates from the IMU's frame to the camera's optical frame."""
        self.link_args(readings)
        self._level, self._turn = level, imu_to_camera
        return self

    def process(self, readings: dai.IMUData) -> None:
        for packet in readings.packets:
            acceleration = packet.acceleroMeter
            stamp_ns = _nanoseconds(acceleration.getTimestamp())
            self._level.update(self._turn @ np.array([acceleration.x, acceleration.y, acceleration.z]), stamp_ns)


class Images(dai.node.HostNode):
    """Stores the newest image for the viewer; ``counts`` counts images that could not be stored, by cause."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter[str] = Counter()

    def build(self, colour: dai.Node.Output, writer: ImageWriter, epoch_ns: int) -> "Images":
        """Link the node; ``colour`` is undistorted, ``epoch_ns`` as in `Skeletons.build`."""
        self.link_args(colour)
        self._writer, self._epoch_ns = writer, epoch_ns
        return self

    def process(self, image: dai.ImgFrame) -> None:
        try:
            intrinsics = np.array(image.getTransformation().getIntrinsicMatrix())
            self._writer.put(image.getCvFrame(), self._epoch_ns + _nanoseconds(image.getTimestamp()), intrinsics)
        except Exception as error:  # an image for the viewer must not stop the node
            count_failure(self.counts, "image", error)


def _pairs(pipeline: dai.Pipeline, **outputs: dai.Node.Output) -> dai.Node.Output:
    """An output of groups of messages captured at the same time, by name."""
    # a host node's own pairing tolerates only 10 ms, and would wait forever
    sync = pipeline.create(dai.node.Sync)
    sync.setRunOnHost(True)
    sync.setSyncThreshold(SYNC_THRESHOLD)
    for name, output in outputs.items():
        output.link(sync.inputs[name])
    return sync.out


class Host:
    """The part of one camera's pipeline, not yet started, that runs on this machine and produces skeletons.

    ``detections`` and ``depth`` are outputs as in `Skeletons.build`; ``readings``, if there is an IMU, its output and
    the rotation (3, 3) from its frame to the camera's; ``images``, if they are stored for the viewer, the output of
    undistorted colour images, and where to.
    """

    def __init__(
        self,
        pipeline: dai.Pipeline,
        detections: dai.Node.Output,
        depth: dai.Node.Output,
        readings: tuple[dai.Node.Output, Floats] | None,
        source: str,
        clock: Clock,
        images: tuple[dai.Node.Output, ImageWriter] | None = None,
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
        self._images = pipeline.create(Images).build(*images, epoch_ns) if images else None

    def status(self) -> dict[str, str]:
        return {"camera.level": "measured" if self.level.measured else "taken for level"}

    @property
    def counts(self) -> Counter[str]:
        """Number of frames dropped or refused, by cause; a copy, because the pipeline's thread goes on counting."""
        return self._skeletons.counts + (self._images.counts if self._images else Counter())

    def frames(self) -> Iterator[PoseRaw | None]:
        """Skeletons as they arrive, or None after a while without one. Ends when the camera disconnects."""
        last_frame_ns, timeout_s = self._clock.monotonic_ns(), STARTUP_TIMEOUT_S
        while self._pipeline.isRunning():
            try:
                yield self._skeletons.found.get(timeout=POLL_S)
                last_frame_ns, timeout_s = self._clock.monotonic_ns(), TIMEOUT_S
            except queue.Empty:
                if self._clock.monotonic_ns() - last_frame_ns > timeout_s * 1e9:
                    return
                yield None


def open_device(settings: OakSettings) -> dai.Device:
    """Open the camera that the settings name. Raises RuntimeError if there is none, or it cannot be opened."""
    if not settings.device and not dai.Device.getAllAvailableDevices():
        raise CameraError("no camera found; `steadypose doctor` says whether one is plugged in")
    return dai.Device(dai.DeviceInfo(settings.device)) if settings.device else dai.Device()


@contextmanager
def connect(settings: OakSettings, clock: Clock, image_file: Path | None = None) -> Iterator[Host]:
    """Open the camera and run the whole pipeline on it. ``image_file`` is for the newest image, for the viewer.

    Raises RuntimeError if there is no such camera, it cannot be opened, or the model cannot be downloaded.
    """
    device = open_device(settings)
    with device, closing(ImageWriter(image_file)) if image_file else nullcontext() as writer:
        device.setMaxReconnectionAttempts(0)  # `CameraSource` reconnects itself, and reports it
        platform = device.getPlatformAsString()
        zoo, usual_fps = MODELS.get(platform, MODELS["RVC2"])
        fps = settings.fps or usual_fps
        with dai.Pipeline(device) as pipeline:
            colour = pipeline.create(dai.node.Camera).build(dai.CameraBoardSocket.CAM_A, sensorFps=fps)
            of_zoo = dai.NNModelDescription(settings.model or zoo)
            model = dai.NNArchive(Path(settings.archive)) if settings.archive else of_zoo
            network = pipeline.create(dai.node.DetectionNetwork).build(colour, model, fps)
            network.setConfidenceThreshold(settings.confidence)
            view, depth = aligned_depth(pipeline, colour, platform)
            imu = accelerometer(pipeline, device)
            images = (view, writer) if writer else None
            host = Host(pipeline, network.out, depth, imu, f"oak-{device.getDeviceId()}", clock, images)
            pipeline.start()
            yield host


def aligned_depth(
    pipeline: dai.Pipeline, colour: dai.node.Camera, platform: str
) -> tuple[dai.Node.Output, dai.Node.Output]:
    """Outputs of undistorted colour images, and of stereo depth in the same view."""
    stereo = pipeline.create(dai.node.StereoDepth).build(
        autoCreateCameras=True, presetMode=dai.node.StereoDepth.PresetMode.DEFAULT, size=DEPTH_SIZE, fps=DEPTH_FPS
    )
    stereo.setLeftRightCheck(True)
    stereo.setSubpixel(True)
    view = colour.requestOutput(DEPTH_SIZE, enableUndistortion=True)
    if platform == "RVC4":  # its stereo block cannot align
        align = pipeline.create(dai.node.ImageAlign)
        stereo.depth.link(align.input)
        view.link(align.inputAlignTo)
        return view, align.outputAligned
    view.link(stereo.inputAlignTo)
    return view, stereo.depth


def accelerometer(pipeline: dai.Pipeline, device: dai.Device) -> tuple[dai.Node.Output, Floats] | None:
    """The accelerometer's output, and its rotation (3, 3) to the camera; None if it is missing or not calibrated."""
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


SETTLE_PAIRS = 30  # number of pairs skipped while exposure and the direction of gravity settle
PAIR_TIMEOUT_S = 20.0  # longest time to wait for a pair, seconds
READING_TIMEOUT_S = 1.0  # longest time to wait for the accelerometer after the image, seconds


@dataclass(frozen=True)
class Still:
    """A still image of a camera, with depth."""

    colour: NDArray[np.uint8]  # (H, W, 3) BGR, undistorted
    depth: NDArray[np.uint16]  # (H, W) millimetres, in the view of ``colour``; 0 in holes
    intrinsics: NDArray[np.float64]  # (3, 3) of both
    up: NDArray[np.float64] | None
    """(3,) direction of up measured by the IMU, optical frame; None without a calibrated IMU"""


def capture(
    pipeline: dai.Pipeline,
    colour: dai.Node.Output,
    depth: dai.Node.Output,
    readings: tuple[dai.Node.Output, NDArray[np.float64]] | None,
    settle: int = SETTLE_PAIRS,
) -> Still:
    """Start a pipeline with these outputs, and capture the image that follows ``settle`` others.

    Raises CameraError if no image arrives in time.
    """
    pairs = _pairs(pipeline, colour=colour, depth=depth).createOutputQueue(maxSize=2)
    level = GravityEstimator()
    if readings:
        pipeline.create(ImuReader).build(readings[0], level, readings[1])
    pipeline.start()
    pair: Any = None
    for _ in range(settle + 1):
        if (pair := pairs.get(timedelta(seconds=PAIR_TIMEOUT_S))) is None:
            raise CameraError(f"the camera gave no image with depth within {PAIR_TIMEOUT_S:g} s")
    image, distances = pair["colour"], pair["depth"]
    late = time.monotonic() + READING_TIMEOUT_S
    while readings and not level.measured and time.monotonic() < late:
        time.sleep(0.01)
    intrinsics = np.array(distances.getTransformation().getIntrinsicMatrix())
    return Still(image.getCvFrame(), distances.getFrame().copy(), intrinsics, level.up if level.measured else None)


def capture_with_camera(settings: OakSettings) -> Still:
    """Capture an image of the camera that the settings name. Raises RuntimeError if that fails."""
    device = open_device(settings)
    with device, dai.Pipeline(device) as pipeline:
        sensor = pipeline.create(dai.node.Camera).build(dai.CameraBoardSocket.CAM_A, sensorFps=DEPTH_FPS)
        colour, depth = aligned_depth(pipeline, sensor, device.getPlatformAsString())
        return capture(pipeline, colour, depth, accelerometer(pipeline, device))
