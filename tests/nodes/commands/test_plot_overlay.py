"""Skeletons over the video that they were found in. The tests' camera has the field of view that `clean` assumes."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import record
from tests.helpers.synthetic_poses import START_NS, messages

from steadypose.msgs.topics import POSE_CLEAN
from steadypose.msgs.types import JointState, PoseClean
from steadypose.nodes.commands.small import plot
from steadypose.nodes.sinks.plot.history import PlotError
from steadypose.nodes.sources.source import WebcamSettings
from steadypose.prior.body.skeleton import J

SIZE = (640, 480)
FRAMES = 20
SHOWN = 480 / 640
"""Scale at which the images are written."""


@pytest.fixture
def cleaned() -> list[PoseClean]:
    """Each frame of the video, of one person; what went in is a hand's width to the left of what came out."""
    found = [message for topic, message in messages(FRAMES / 30 + 0.5) if isinstance(message, PoseClean)]
    for message in found:
        message.bodies[0].raw_positions[:] = message.bodies[0].positions - [0.4, 0.0, 0.0]
    return [dataclasses.replace(message, stamp_ns=message.stamp_ns - START_NS) for message in found]


@pytest.fixture
def video(tmp_path: Path) -> Path:
    path = tmp_path / "video.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30, SIZE)
    for _ in range(FRAMES):
        writer.write(np.full((SIZE[1], SIZE[0], 3), 90, np.uint8))
    writer.release()
    return path


def images(path: Path) -> list[np.ndarray]:
    capture, found = cv2.VideoCapture(str(path)), []
    while (read := capture.read())[0]:
        found.append(read[1].astype(int))
    return found


def pixels(joints: np.ndarray) -> np.ndarray:
    """(J, 2) where a pinhole camera that looks along z sees joints (J, 3), in an image as it is written."""
    focal = SIZE[0] / 2 / np.tan(WebcamSettings.field_of_view / 2)
    return SHOWN * (np.array(SIZE) / 2 + focal * joints[:, :2] / joints[:, 2:])


def drawn(image: np.ndarray, at: np.ndarray) -> bool:
    """Whether there is a colour, and not the grey of the video, within two pixels."""
    x, y = np.round(at).astype(int)
    return bool(np.abs(image[y - 2 : y + 3, x - 2 : x + 3] - 90).max() > 60)


def test_raw_and_clean_stand_side_by_side_where_the_camera_saw_them(
    tmp_path: Path, cleaned: list[PoseClean], video: Path
) -> None:
    plot(record(tmp_path / "bag", cleaned, POSE_CLEAN), video=tmp_path / "out.mp4", over=video)
    written = images(tmp_path / "out.mp4")
    assert len(written) == FRAMES / 2, "15 a second"
    last = written[-1]
    assert last.shape == (360, 960, 3)
    raw, clean = last[:, :480], last[:, 480:]
    assert abs(raw[300:, 400:] - 90).max() < 30, "the video's own images"
    by_stamp = {message.stamp_ns: message.bodies[0] for message in cleaned}
    shown = by_stamp[min(by_stamp, key=lambda stamp: abs(stamp - round((FRAMES - 2) / 30 * 1e9)))]
    for joint in ("neck", "left_knee", "right_ankle"):
        assert drawn(clean, pixels(shown.positions)[J[joint]])
        assert drawn(raw, pixels(shown.raw_positions)[J[joint]])
    head = J["head"]
    assert not drawn(raw, pixels(shown.positions)[head])
    assert not drawn(clean, pixels(shown.raw_positions)[head])


def test_what_was_not_observed_is_faint(tmp_path: Path, cleaned: list[PoseClean], video: Path) -> None:
    hidden = [J["left_knee"], J["left_ankle"], J["left_foot"]]
    solid = tmp_path / "solid"
    plot(record(solid, cleaned, POSE_CLEAN), video=tmp_path / "solid.mp4", over=video)
    for message in cleaned:
        message.bodies[0].state[hidden] = JointState.IMPUTED
    plot(record(tmp_path / "bag", cleaned, POSE_CLEAN), video=tmp_path / "faint.mp4", over=video)
    here = cleaned[0].bodies[0]
    x, y = np.round(pixels(here.positions)[hidden[:2]].mean(axis=0)).astype(int)
    strength = [np.abs(images(tmp_path / f"{name}.mp4")[0][y, 480 + x] - 90).max() for name in ("solid", "faint")]
    assert strength[1] < 0.6 * strength[0]


def test_arrays_have_clean_alone(tmp_path: Path, cleaned: list[PoseClean], video: Path) -> None:
    bodies = [message.bodies[0] for message in cleaned]
    positions, state = (np.array([getattr(body, name) for body in bodies]) for name in ("positions", "state"))
    stamps = np.array([message.stamp_ns for message in cleaned])
    np.savez(tmp_path / "clean.npz", stamp_ns=stamps, world_positions=positions, positions=positions, state=state)
    plot(tmp_path / "clean.npz", video=tmp_path / "out.gif", over=video)
    assert (tmp_path / "out.gif").read_bytes().startswith(b"GIF8")
    plot(tmp_path / "clean.npz", video=tmp_path / "out.mp4", over=video)
    (first, *_) = images(tmp_path / "out.mp4")
    assert first.shape == (360, 480, 3)
    assert drawn(first, pixels(bodies[0].positions)[J["neck"]])


def test_another_video_is_refused(tmp_path: Path, cleaned: list[PoseClean], video: Path) -> None:
    later = [dataclasses.replace(message, stamp_ns=message.stamp_ns + 10**10) for message in cleaned]
    with pytest.raises(PlotError, match=r"clean .*video\.avi OUT' makes: .* ends after 0\.7 s, these begin at 10\.0 s"):
        plot(record(tmp_path / "bag", later, POSE_CLEAN), video=tmp_path / "out.mp4", over=video)
    for message in cleaned:
        message.bodies[0].positions[:] = message.bodies[0].positions[:, [2, 0, 1]] * [1.0, 1.0, -1.0]
    with pytest.raises(PlotError, match="none of these lies within its images"):
        plot(record(tmp_path / "world", cleaned, POSE_CLEAN), video=tmp_path / "out.mp4", over=video)
    assert not (tmp_path / "out.mp4").exists()
    with pytest.raises(PlotError, match="over: expected a video that OpenCV can read"):
        plot(tmp_path / "bag", video=tmp_path / "out.mp4", over=tmp_path / "nowhere.mp4")
    with pytest.raises(PlotError, match="expected --video"):
        plot(tmp_path / "bag", over=video)
