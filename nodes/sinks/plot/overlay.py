"""``steadypose plot --video --over``: the skeletons of a video, raw beside clean, drawn over its images."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from steadypose.msgs.recording import RecordingReader
from steadypose.msgs.topics import POSE_CLEAN
from steadypose.msgs.types import OBSERVED, PoseClean
from steadypose.nodes.sinks.drawing import ALL_BONES, FAINT, ON_DARK, SIDES, bones
from steadypose.nodes.sinks.plot.history import PlotError
from steadypose.nodes.sources.adapters import pinhole
from steadypose.nodes.sources.npz import is_output, read_arrays
from steadypose.nodes.sources.source import WebcamSettings
from steadypose.nodes.sources.webcam_device import stamped_images
from steadypose.prior.arrays import Floats

FPS = 15  # largest frame rate of the written video, Hz
WIDTH = 480  # largest width of one of its panels, pixels
APART_NS = 34_000_000
"""Largest time between an image and the pose drawn over it, nanoseconds; one frame of the prior's grid."""
NEAREST = 0.1  # smallest depth at which a joint is drawn, metres. A nearer joint projects far outside the image.


class Body(NamedTuple):
    """One body at one time, in the camera's optical frame."""

    raw: Floats | None  # (22, 3) metres, the input joints; None if they were not stored
    clean: Floats  # (22, 3) metres
    observed: NDArray[np.bool_]  # (22,)


def overlaid(recording: Path, video: Path, body: int | None) -> tuple[Iterator[NDArray[np.uint8]], float]:
    """RGB images (H, W, 3) of a cleaned video with its skeletons, and their frame rate in Hz.

    The camera's field of view is guessed, as by `steadypose clean VIDEO`. Raises PlotError if the video cannot be read,
    or is not the recording's.
    """
    expected = f"{recording}: expected what 'steadypose clean {video} OUT' makes"
    moments = _of_npz(recording, body) if recording.suffix == ".npz" else _of_recording(recording, body)
    capture = cv2.VideoCapture(str(video))
    size = (int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)))
    rate = capture.get(cv2.CAP_PROP_FPS) or 30.0
    if not capture.isOpened():
        raise PlotError(f"over: expected a video that OpenCV can read, got {video}")
    lens = pinhole(size, WebcamSettings().field_of_view)
    pixels = [_pixels(body.clean, lens) for bodies in moments.values() for body in bodies]
    if not any(((at > 0.0) & (at < size)).all(axis=-1).any() for at in pixels):
        raise PlotError(f"{expected}, got poses of which none lies within its images")
    length_ns = capture.get(cv2.CAP_PROP_FRAME_COUNT) / rate * 1e9
    if 0 < length_ns < min(moments) - APART_NS:
        ends = f"the video ends after {length_ns / 1e9:.1f} s"
        raise PlotError(f"{expected}, but {ends}, and these stamps begin at {min(moments) / 1e9:.1f} s")
    step = max(round(rate / FPS), 1)
    return _frames(capture, moments, lens, step), rate / step


def _of_recording(path: Path, body: int | None) -> dict[int, list[Body]]:
    moments = {}
    with RecordingReader(path) as reader:
        for _, stamp_ns, message in reader.messages([POSE_CLEAN]):
            if isinstance(message, PoseClean):
                moments[stamp_ns] = [
                    Body(found.raw_positions, found.positions, np.isin(found.state, OBSERVED))
                    for found in message.bodies
                    if body in (None, found.id)
                ]
    return moments


def _of_npz(path: Path, body: int | None) -> dict[int, list[Body]]:
    arrays = read_arrays(path)
    if not is_output(arrays):
        raise PlotError(f"{path}: expected what 'steadypose clean' made of the video, got an input")
    frames, several = len(arrays["stamp_ns"]), "body_id" in arrays
    clean, state = (
        arrays[name].reshape(frames, -1, *arrays[name].shape[1 + several :]) for name in ("positions", "state")
    )
    chosen = [n for n, id in enumerate(arrays["body_id"] if several else [0]) if body in (None, id)]
    return {
        int(stamp_ns): [Body(None, clean[row, n], np.isin(state[row, n], OBSERVED)) for n in chosen]
        for row, stamp_ns in enumerate(arrays["stamp_ns"])
    }


def _frames(
    capture: cv2.VideoCapture, moments: dict[int, list[Body]], intrinsics: Floats, step: int
) -> Iterator[NDArray[np.uint8]]:
    stamps = np.array(sorted(moments), dtype=np.int64)
    raws = [body.raw for found in moments.values() for body in found if body.raw is not None]
    ever = np.any([np.isfinite(raw).all(axis=1) for raw in raws], axis=0) if raws else np.zeros(22, bool)
    for number, (stamp_ns, image) in enumerate(stamped_images(capture)):
        if number % step or image is None:
            continue
        near = int(stamps[np.abs(stamps - stamp_ns).argmin()])
        bodies = moments[near] if abs(near - stamp_ns) < APART_NS else []
        scale = min(1.0, WIDTH / image.shape[1])
        small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        lens = intrinsics * [[scale], [scale], [1.0]]
        panels = [_with_bones(small, [(body.clean, body.observed) for body in bodies], ALL_BONES, lens, "clean")]
        if ever.any():
            given = [(body.raw, np.ones(22, bool)) for body in bodies if body.raw is not None]
            panels.insert(0, _with_bones(small, given, bones(ever), lens, "raw"))
        yield np.ascontiguousarray(np.hstack(panels)[..., ::-1])


def _pixels(joints: Floats, lens: Floats) -> Floats:
    """(J, 2) projection of joints (J, 3) into the image, pixels; NaN for joints that are not in front of the camera."""
    depth = joints[:, 2:]
    return (joints @ lens.T)[:, :2] / np.where(depth > NEAREST, depth, np.nan)


def _with_bones(
    image: NDArray[Any],
    bodies: list[tuple[Floats, NDArray[np.bool_]]],
    shown: NDArray[np.intp],
    lens: Floats,
    title: str,
) -> NDArray[Any]:
    """An image with a title, and with the bones of bodies, each given as joints and a mask of observed joints."""
    image = image.copy()
    for joints, observed in bodies:
        pixels = _pixels(joints, lens)
        seen = [bone for bone in shown if np.isfinite(pixels[bone]).all()]
        guessed = image.copy()
        _draw(guessed, pixels, [bone for bone in seen if not observed[bone].all()])
        image = cv2.addWeighted(guessed, FAINT, image, 1.0 - FAINT, 0.0)
        _draw(image, pixels, [bone for bone in seen if observed[bone].all()])
    cv2.putText(image, title, (8, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (255, 255, 255), 2, cv2.LINE_AA)
    return image


def _draw(image: NDArray[Any], pixels: Floats, drawn: list[NDArray[np.intp]]) -> None:
    for parent, child in drawn:
        (x, y), (to_x, to_y) = np.round(pixels[[parent, child]]).astype(int).tolist()
        red, green, blue = bytes.fromhex(ON_DARK[SIDES[child]][1:])
        cv2.line(image, (x, y), (to_x, to_y), (blue, green, red), 3, cv2.LINE_AA)
