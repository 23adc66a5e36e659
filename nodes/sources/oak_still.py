"""One picture of an OAK with its depth, lens and level: what `steadypose calibrate` wants of a camera."""

# without `from __future__ import annotations`: depthai reads those of `process` to know what an input takes
import queue
from dataclasses import dataclass
from typing import Any

import depthai as dai
import numpy as np
from numpy.typing import NDArray

from steadypose.nodes.graph.launch import OakSettings
from steadypose.nodes.sources.camera import CameraError
from steadypose.nodes.sources.oak import APART, DEPTH_FPS, Gravity, accelerometer, aligned_depth, open_device
from steadypose.prior.camera.gravity import Level

SETTLE = 30
"""pairs let pass, while exposure and level settle"""
PATIENCE_S = 20.0
"""for each pair"""


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
        self.taken: queue.Queue[tuple[Any, Any]] = queue.Queue(maxsize=2)

    def build(self, pairs: dai.Node.Output) -> "Pairs":
        """Link the node."""
        self.link_args(pairs)
        return self

    def process(self, pair: dai.MessageGroup) -> None:
        if not self.taken.full():
            self.taken.put((pair["colour"], pair["depth"]))


def take(
    pipeline: dai.Pipeline,
    colour: dai.Node.Output,
    depth: dai.Node.Output,
    readings: tuple[dai.Node.Output, NDArray[np.float64]] | None,
    settle: int = SETTLE,
) -> Still:
    """Start a pipeline that has these outputs, and take the picture that comes after ``settle`` others.

    Raises:
        CameraError: none comes.
    """
    sync = pipeline.create(dai.node.Sync)
    sync.setRunOnHost(True)
    sync.setSyncThreshold(APART)
    colour.link(sync.inputs["colour"])
    depth.link(sync.inputs["depth"])
    pairs = pipeline.create(Pairs).build(sync.out)
    level = Level()
    if readings:
        pipeline.create(Gravity).build(readings[0], level, readings[1])
    pipeline.start()
    try:
        for _ in range(settle):
            pairs.taken.get(timeout=PATIENCE_S)
        picture, distances = pairs.taken.get(timeout=PATIENCE_S)
    except queue.Empty:
        raise CameraError(f"the camera gave no picture with depth within {PATIENCE_S:g} s") from None
    intrinsics = np.array(distances.getTransformation().getIntrinsicMatrix())
    return Still(picture.getCvFrame(), distances.getFrame().copy(), intrinsics, level.up if level.measured else None)


def take_with_camera(settings: OakSettings) -> Still:
    """A picture of the camera that the settings name.

    Raises:
        RuntimeError: the camera cannot be opened, or gives none.
    """
    device = open_device(settings)
    with device, dai.Pipeline(device) as pipeline:
        sensor = pipeline.create(dai.node.Camera).build(dai.CameraBoardSocket.CAM_A, sensorFps=DEPTH_FPS)
        colour, depth = aligned_depth(pipeline, sensor, device.getPlatformAsString())
        return take(pipeline, colour, depth, accelerometer(pipeline, device))
