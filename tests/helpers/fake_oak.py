"""A camera that is none: a depthai pipeline on this machine alone, which gives what an OAK's own nodes would give."""

import datetime
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from tests.helpers.synthetic_poses import sensor_joints, walker

os.environ.setdefault("DEPTHAI_LEVEL", "error")

import depthai as dai

from steadypose.benchmarks.depth_camera import Stereo, render, room
from steadypose.nodes.graph.clock import Clock
from steadypose.nodes.sources.image import ImageWriter
from steadypose.nodes.sources.oak_device import Host
from steadypose.nodes.sources.source import OakSettings
from steadypose.prior.body.layouts import COCO17
from steadypose.prior.body.skeleton import REST_OFFSETS

CAMERA = Stereo()
NETWORK_SIZE = (512, 288)
"""of the image that the network sees: another size and shape than the depth image's, as on the camera"""
TO_OPTICAL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
EYE = np.array([-3.0, 0.0, 1.1])
PERIOD = datetime.timedelta(seconds=1 / 30)


@dataclass(frozen=True)
class Moment:
    """What the camera gives of one moment.

    Attributes:
        joints: of each person (17, 3) metres, optical frame.
        depth: (H, W) millimetres.
    """

    joints: list[NDArray[np.float64]]
    depth: NDArray[np.uint16]


def moment(frame: int, people: int = 1) -> Moment:
    """People who walk, 3 m in front of the camera, side by side."""
    joints, flesh = [], []
    for person in range(people):
        body, _, _ = walker(frame / 30, phase=person)
        body = body - [*body[0, :2], 0.0] + [0.0, 1.0 * person - 0.5 * (people - 1), 0.0]
        optical = (body - EYE) @ TO_OPTICAL.T
        joints.append(sensor_joints(COCO17, optical))
        flesh.append((optical, REST_OFFSETS))
    depth = render(flesh, CAMERA, room(CAMERA, EYE[2], 6.0))
    return Moment(joints, (1000 * depth).astype(np.uint16))


def detections(moment: Moment) -> dai.ImgDetections:
    """As the network gives them: key points from 0 to 1 in its own image, a crop of the colour camera's."""
    message = dai.ImgDetections()
    found = []
    for joints in moment.joints:
        pixels = CAMERA.project(joints)
        points = []
        for x, y in _to_network(pixels):
            point = dai.Keypoint()
            point.imageCoordinates = dai.Point3f(float(x), float(y), 0.0)
            point.confidence = 0.9
            points.append(point)
        detection = dai.ImgDetection()
        detection.confidence = 0.8
        low, high = _to_network(pixels).min(axis=0), _to_network(pixels).max(axis=0)
        centre, size = (low + high) / 2, high - low
        detection.setBoundingBox(
            dai.RotatedRect(
                dai.Point2f(float(centre[0]), float(centre[1]), True),
                dai.Size2f(float(size[0]), float(size[1]), True),
                0.0,
            )
        )
        detection.setKeypoints(dai.KeypointsList(points))
        found.append(detection)
    message.detections = found
    message.setTransformation(_network_view())
    return message


def depth_frame(moment: Moment) -> dai.ImgFrame:
    frame = dai.ImgFrame()
    frame.setType(dai.ImgFrame.Type.RAW16)
    frame.setFrame(moment.depth)
    frame.setWidth(CAMERA.width)
    frame.setHeight(CAMERA.height)
    frame.setTransformation(dai.ImgTransformation(CAMERA.width, CAMERA.height, CAMERA.intrinsics.tolist()))
    return frame


def colour_frame(brightness: int) -> dai.ImgFrame:
    frame = dai.ImgFrame()
    size = (CAMERA.height, CAMERA.width, 3)
    frame.setCvFrame(np.full(size, (brightness, 0, 10), np.uint8), dai.ImgFrame.Type.BGR888i)
    frame.setTransformation(dai.ImgTransformation(CAMERA.width, CAMERA.height, CAMERA.intrinsics.tolist()))
    return frame


def readings(up: Sequence[float]) -> dai.IMUData:
    """Of an accelerometer at rest in which ``up`` points up."""
    report = dai.IMUReportAccelerometer()
    report.x, report.y, report.z = (9.81 * float(value) for value in up)
    packet = dai.IMUPacket()
    packet.acceleroMeter = report
    message = dai.IMUData()
    message.packets = [packet]
    return message


SOON_S = 30.0
"""Longest wait for a thread of depthai, seconds."""


class Player(dai.node.ThreadedHostNode):
    """In the place of the camera's nodes: sends each message it is given on its output, in order.

    Attributes:
        outputs: ``detections``, ``depth``, ``colour`` and ``imu``.
        levelled: whether the readings of the IMU have been read, for which the messages after them wait.
    """

    def __init__(self) -> None:
        super().__init__()
        self.outputs = {
            name: self.createOutput(possibleDatatypes=[dai.Node.DatatypeHierarchy(kind, False)])
            for name, kind in (
                ("detections", dai.DatatypeEnum.ImgDetections),
                ("depth", dai.DatatypeEnum.ImgFrame),
                ("colour", dai.DatatypeEnum.ImgFrame),
                ("imu", dai.DatatypeEnum.IMUData),
            )
        }
        self.script: list[tuple[str, dai.Buffer]] = []
        self.levelled: Callable[[], bool] = lambda: True
        self.done = threading.Event()

    def run(self) -> None:
        for name, message in self.script:
            self.outputs[name].send(message)
            if name == "imu":  # another thread reads it than reads images
                late = time.monotonic() + SOON_S
                while not self.levelled() and time.monotonic() < late:
                    time.sleep(0.001)
        self.done.set()


def script(
    moments: Sequence[Moment], up: Sequence[float] | None = None, depth_late: datetime.timedelta = datetime.timedelta(0)
) -> list[tuple[str, dai.Buffer]]:
    """The messages of a recording of ``moments``, a thirtieth of a second apart, the first of them now.

    Depth images are captured ``depth_late`` after the images they belong to.
    """
    start = dai.Clock.now()  # pyright: ignore[reportCallIssue] (static)
    messages: list[tuple[str, dai.Buffer]] = [("imu", readings(up))] if up is not None else []
    for index, one in enumerate(moments):
        captured = start + index * PERIOD
        for name, message, at in (
            ("detections", detections(one), captured),
            ("depth", depth_frame(one), captured + depth_late),
        ):
            message.setTimestamp(at)
            message.setSequenceNum(index)
            messages.append((name, message))
    return messages


@contextmanager
def plugged(
    messages: list[tuple[str, dai.Buffer]], clock: Clock, imu_to_camera: NDArray[np.float64] | None = None,
    unplug: Callable[[dai.Pipeline, Player], None] | None = None, writer: ImageWriter | None = None,
) -> Iterator[Host]:  # fmt: skip
    """A connection over which the messages come; ``unplug`` may end it, and ``writer`` stores its images."""
    with dai.Pipeline(createImplicitDevice=False) as pipeline:
        player = pipeline.create(Player)
        player.script = messages
        imu = None if imu_to_camera is None else (player.outputs["imu"], imu_to_camera)
        images = (player.outputs["colour"], writer) if writer else None
        host = Host(pipeline, player.outputs["detections"], player.outputs["depth"], imu, "oak-test", clock, images)
        player.levelled = lambda: imu is None or host.level.measured
        pipeline.start()
        thread = threading.Thread(target=unplug, args=(pipeline, player)) if unplug else None
        if thread:
            thread.start()
        try:
            yield host
        finally:
            if thread:
                thread.join()


def opener(make: Callable[[Clock], list[tuple[str, dai.Buffer]]]):
    @contextmanager
    def connect(settings: OakSettings, clock: Clock) -> Iterator[Host]:
        with plugged(make(clock), clock) as host:
            yield host

    return connect


def _network_view() -> dai.ImgTransformation:
    """The network's image: the camera's, less a strip above and below, scaled."""
    view = dai.ImgTransformation(CAMERA.width, CAMERA.height, CAMERA.intrinsics.tolist())
    view.addCrop(0, _STRIP, CAMERA.width, CAMERA.height - 2 * _STRIP)
    view.addScale(NETWORK_SIZE[0] / CAMERA.width, NETWORK_SIZE[1] / (CAMERA.height - 2 * _STRIP))
    return view


_STRIP = 20


def _to_network(pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 2) from 0 to 1 in the network's image."""
    return (pixels - [0, _STRIP]) / [CAMERA.width, CAMERA.height - 2 * _STRIP]
