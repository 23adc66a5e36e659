"""One picture of an OAK with its depth, lens and level: what `steadypose calibrate` wants of a camera."""

# without `from __future__ import annotations`: depthai reads those of `process` to know what an input takes
import queue
import time
from dataclasses import dataclass
from typing import Any

import depthai as dai
import numpy as np
from numpy.typing import NDArray

from steadypose.nodes.sources.camera import CameraError
from steadypose.nodes.sources.camera_settings import OakSettings
from steadypose.nodes.sources.oak_device import (
    DEPTH_FPS,
    SYNC_THRESHOLD,
    ImuReader,
    accelerometer,
    aligned_depth,
    open_device,
)
from steadypose.prior.camera.gravity import GravityEstimator

SETTLE_PAIRS = 30
"""pairs skipped while exposure and the direction of gravity settle"""
PAIR_TIMEOUT_S = 20.0
"""for each pair"""
READING_TIMEOUT_S = 1.0
"""for the accelerometer, which may speak after the picture"""


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
    """Start a pipeline that has these outputs, and capture the picture that comes after ``settle`` others.

    Raises:
        CameraError: none comes.
    """
    sync = pipeline.create(dai.node.Sync)
    sync.setRunOnHost(True)
    sync.setSyncThreshold(SYNC_THRESHOLD)
    colour.link(sync.inputs["colour"])
    depth.link(sync.inputs["depth"])
    pairs = pipeline.create(Pairs).build(sync.out)
    level = GravityEstimator()
    if readings:
        pipeline.create(ImuReader).build(readings[0], level, readings[1])
    pipeline.start()
    try:
        for _ in range(settle):
            pairs.pairs.get(timeout=PAIR_TIMEOUT_S)
        picture, distances = pairs.pairs.get(timeout=PAIR_TIMEOUT_S)
    except queue.Empty:
        raise CameraError(f"the camera gave no picture with depth within {PAIR_TIMEOUT_S:g} s") from None
    late = time.monotonic() + READING_TIMEOUT_S
    while readings and not level.measured and time.monotonic() < late:
        time.sleep(0.01)
    intrinsics = np.array(distances.getTransformation().getIntrinsicMatrix())
    return Still(picture.getCvFrame(), distances.getFrame().copy(), intrinsics, level.up if level.measured else None)


def capture_with_camera(settings: OakSettings) -> Still:
    """A picture of the camera that the settings name.

    Raises:
        RuntimeError: the camera cannot be opened, or gives none.
    """
    device = open_device(settings)
    with device, dai.Pipeline(device) as pipeline:
        sensor = pipeline.create(dai.node.Camera).build(dai.CameraBoardSocket.CAM_A, sensorFps=DEPTH_FPS)
        colour, depth = aligned_depth(pipeline, sensor, device.getPlatformAsString())
        return capture(pipeline, colour, depth, accelerometer(pipeline, device))
