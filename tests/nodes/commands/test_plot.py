import dataclasses
import errno
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import record
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation
from tests.helpers.rendered_board import write_video
from tests.helpers.synthetic_poses import START_NS, messages, messages_on

from steadypose.msgs.topics import DIAGNOSTICS, POSE_CLEAN, POSE_RAW, POSE_TRUTH, POSE_WORLD
from steadypose.msgs.types import Diagnostics, JointState, Level, Message, Pose, PoseClean, PoseRaw, PoseWorld
from steadypose.nodes.commands.small import plot
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sinks.drawing import bones
from steadypose.nodes.sinks.plot import video as video_of
from steadypose.nodes.sinks.plot.figure import draw
from steadypose.nodes.sinks.plot.history import PlotError, errors_of, history_of_path
from steadypose.nodes.sinks.plot.panels import busiest_joints, draw_contacts
from steadypose.nodes.sources.source import WebcamSettings
from steadypose.prior.body.layouts import COCO17
from steadypose.prior.body.skeleton import J

GONE = object()
"""Returned for a message that is to go."""
EVERY = {POSE_RAW, POSE_CLEAN, POSE_WORLD, POSE_TRUTH}
PARTS = [(30, {POSE_RAW}), (30, {POSE_CLEAN}), (30, {POSE_WORLD, POSE_TRUTH}), (1, {POSE_RAW}), (5, EVERY), (6, EVERY)]
"""Frames and topics of recordings, also of a frame or two."""


def recorded(
    directory: Path, seconds: float, topics: Collection[str] = EVERY,
    change: Callable[[str, Message], object] = lambda *_: None, **options,
) -> Path:  # fmt: skip
    """What is made up, each message changed."""
    stream = (it for it in messages(seconds, **options) if it[0] in topics and change(*it) is not GONE)
    return record(directory, stream)


def drawn(recording: Path) -> bool:
    image = recording.with_suffix(".png")
    plot(recording, image)
    return image.read_bytes().startswith(b"\x89PNG")


def test_the_arms_of_a_layout_without_collars_hang_at_the_neck() -> None:
    coco = {tuple(pair) for pair in bones(COCO17.observable).tolist()}
    assert {(J["neck"], J["left_shoulder"]), (J["neck"], J["right_shoulder"]), (J["pelvis"], J["neck"])} < coco


def hide(_: str, message: Message) -> None:
    if isinstance(message, PoseRaw):
        message.bodies[0].positions[:] = np.nan
    if isinstance(message, PoseClean):
        message.bodies[0].raw_positions[:] = np.nan
        message.bodies[0].anomaly = np.nan
    if isinstance(message, PoseWorld):
        message.bodies[0].contacts[:] = np.nan


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("frames", "topics"), [(30, EVERY), *(pytest.param(*it, marks=pytest.mark.slow) for it in PARTS)]
)
def test_draws_what_there_is(tmp_path: Path, frames: int, topics: set[str]) -> None:
    assert drawn(recorded(tmp_path / "bag", frames / 30, topics))
    assert drawn(recorded(tmp_path / "nothing seen", frames / 30, topics, hide))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("hidden", [True, False])
def test_contacts_that_are_unknown_are_drawn_as_such(tmp_path: Path, hidden: bool) -> None:
    """And not those between two parts of a stream."""

    def change(_: str, message: Message) -> object:
        if isinstance(message, PoseWorld) and hidden:
            message.bodies[0].contacts[2:6] = np.nan
        return GONE if 2 * 10**9 < message.stamp_ns < 3 * 10**9 else None

    world: Any = history_of_path(recorded(tmp_path / "bag", 3.0, change=change)).track(POSE_WORLD, 0)
    ax = Figure().subplots()
    draw_contacts(ax, world)
    legend = ax.get_legend()
    assert [text.get_text() for text in (legend.get_texts() if legend else ())] == ["unknown"] * hidden


def test_reads_bodies_errors_and_troubles(tmp_path: Path) -> None:
    values = {"dropped.late": "3", "queue": "1", "refused.undecodable": "2"}
    news = (DIAGNOSTICS, Diagnostics(3 * 10**9, "prior", Level.WARN, "", values))
    history = history_of_path(record(tmp_path / "bag", [*messages(2.0, bodies=2), news]))
    assert history.dropped_or_refused == {"prior dropped.late": 3, "prior refused.undecodable": 2}
    assert set(history.tracks[POSE_CLEAN]) == {0, 1}
    for body in (0, 1):
        errors = errors_of(history, body)
        assert errors[POSE_RAW].mean.mean() == pytest.approx(0.032, abs=0.004), "2 cm of noise along each axis"
        assert errors[POSE_CLEAN].mean.mean() == pytest.approx(0.0048, abs=0.0006)
        assert errors[POSE_WORLD].mean.mean() == pytest.approx(0.0048, abs=0.0006)
        assert np.isnan(errors[POSE_RAW].by_joint[J["spine1"]]), "a joint that the sensor lacks has no error"
    assert draw(history, 1).get_suptitle().endswith("body 1, one of 2"), "an id is told from a count"


def test_a_body_is_compared_with_the_person_who_stands_there_while_there_is_truth(tmp_path: Path) -> None:
    def renumber(_: str, message: Message) -> None:
        for body in message.bodies if isinstance(message, PoseRaw) else ():
            body.id = 7 - body.id

    history = history_of_path(recorded(tmp_path / "bag", 1.0, change=renumber, bodies=2))
    assert errors_of(history, 7)[POSE_RAW].mean.max() < 0.1

    def silence(topic: str, message: Message) -> object:
        return GONE if topic == POSE_TRUTH and 2e9 < message.stamp_ns < 3e9 else None

    times = errors_of(history_of_path(recorded(tmp_path / "silent", 3.0, change=silence)), 0)[POSE_RAW].time
    assert not ((times > 1.1) & (times < 1.9)).any()


def test_a_camera_whose_place_is_unknown_is_put_where_it_fits(tmp_path: Path) -> None:
    def misplace(_: str, message: Message) -> None:
        if isinstance(message, PoseRaw):
            turned = Rotation.from_euler("z", 50, degrees=True) * Rotation.from_quat(message.sensor_pose.orientation)
            message.calibrated, message.sensor_pose = False, Pose(np.array([5.0, 6.0, 7.0]), turned.as_quat())

    errors = errors_of(history_of_path(recorded(tmp_path / "bag", 3.0, change=misplace)), 0)
    assert errors[POSE_RAW].mean.mean() == pytest.approx(0.032, abs=0.004)


def test_shows_the_joints_that_were_most_often_missing(tmp_path: Path) -> None:
    history = history_of_path(recorded(tmp_path / "bag", 4.0, {POSE_CLEAN}))
    track: Any = history.track(POSE_CLEAN, 0)
    assert busiest_joints(track)[0] == J["left_wrist"]


@pytest.mark.parametrize(("bodies", "output", "options", "expected"), [
    (1, "image.gif", {}, "ending in .png, .svg or .pdf"),
    (1, "nowhere/image.png", {}, "no directory; make it first"),
    (1, "image.png", {"body": 9}, r"expected one of \[0\], got 9"),
    (0, "image.png", {}, "expected at least one body, got none; see `steadypose info`"),
])  # fmt: skip
def test_what_cannot_be_drawn_says_why(tmp_path: Path, bodies: int, output: str, options: dict, expected: str) -> None:
    recording = recorded(tmp_path / "bag", 0.2, {POSE_RAW}, bodies=bodies)
    with pytest.raises(PlotError, match=expected):
        plot(recording, tmp_path / output, **options)


def test_a_full_disk_is_said_and_the_picture_that_was_there_stays(tmp_path: Path, monkeypatch) -> None:
    def save_half(figure: Figure, path: Path, **options: object) -> None:
        path.write_bytes(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    recording, image = recorded(tmp_path / "bag", 0.2, {POSE_RAW}), tmp_path / "image.png"
    image.write_bytes(b"whole")
    monkeypatch.setattr(Figure, "savefig", save_half)
    with pytest.raises(LaunchError, match=r"image.png: No space left on device; make room"):
        plot(recording, image)
    assert image.read_bytes() == b"whole"
    assert {path.name for path in tmp_path.iterdir()} == {"bag", "image.png"}


def labels(figure: Figure, title: str) -> list[str]:
    """The legend of the first panel with this title; the stick figures come first, without one."""
    ax = next(ax for ax in figure.axes if ax.get_title("left") == title)
    legend = ax.get_legend()
    return [text.get_text() for text in legend.get_texts()] if legend else []


def test_every_line_has_a_label_and_no_label_is_without_a_line(tmp_path: Path) -> None:
    whole = draw(history_of_path(recorded(tmp_path / "whole", 1.0)))
    bare = draw(history_of_path(recorded(tmp_path / "bare", 1.0, {POSE_CLEAN, POSE_WORLD}, hide)))
    path, joint = "pelvis from above, world, m", "left_wrist relative to the pelvis, m"
    assert labels(whole, path)[:3] == ["ground truth", "world", "start"]
    assert "raw" in labels(whole, ""), "the stick figures"
    assert labels(whole, joint)[:2] == ["x raw", "x clean"]
    assert labels(bare, path) == ["world", "start"]
    assert "raw" not in labels(bare, "")
    assert labels(bare, joint) == ["x clean", "y clean", "z clean"]


def test_the_legend_of_a_video_without_states_fits_it(tmp_path: Path, monkeypatch) -> None:
    wide: list[bool] = []
    save = video_of._write_gif

    def measure(frames: Iterator[np.ndarray], path: Path, fps: float) -> int:
        images = list(frames)
        wide.extend(bool((image[-24:, [0, -1]] < 250).any()) for image in images)
        return save(iter(images), path, fps)

    monkeypatch.setattr(video_of, "_write_gif", measure)
    plot(recorded(tmp_path / "bag", 0.3, {POSE_RAW}), video=tmp_path / "raw.gif")
    assert wide == [False] * len(wide)
    assert wide


def test_what_is_not_one_recording_says_what_to_draw(tmp_path: Path) -> None:
    with pytest.raises(LaunchError, match=r"x\.npz does not exist: expected"):
        plot(Path("x.npz"), tmp_path / "x.png")
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "x.mcap").touch()
    with pytest.raises(PlotError, match=r"a folder of 2; name one, such as .*a, .*b"):
        plot(tmp_path, tmp_path / "x.png")


SIZE = (640, 480)
FRAMES = 20
SHOWN = 480 / 640
"""Scale at which the images are written."""


@pytest.fixture
def cleaned() -> list[PoseClean]:
    """Each frame of the video, of one person; what went in is a hand's width to the left of what came out."""
    found = messages_on(POSE_CLEAN, FRAMES / 30 + 0.5)
    for message in found:
        message.bodies[0].raw_positions[:] = message.bodies[0].positions - [0.4, 0.0, 0.0]
    return [dataclasses.replace(message, stamp_ns=message.stamp_ns - START_NS) for message in found]


@pytest.fixture
def video(tmp_path: Path) -> Path:
    return write_video(tmp_path / "video.avi", SIZE, [90] * FRAMES)


def images(path: Path) -> list[np.ndarray]:
    capture, found = cv2.VideoCapture(str(path)), []
    while (read := capture.read())[0]:
        found.append(read[1].astype(int))
    return found


def pixels(joints: np.ndarray) -> np.ndarray:
    """(J, 2) where a pinhole camera that looks along z sees joints (J, 3), in an image as it is written."""
    focal = SIZE[0] / 2 / np.tan(WebcamSettings.field_of_view / 2)
    return SHOWN * (np.array(SIZE) / 2 + focal * joints[:, :2] / joints[:, 2:])


def pictured(image: np.ndarray, at: np.ndarray) -> bool:
    """Whether there is a colour, and not the grey of the video, within two pixels."""
    x, y = np.round(at).astype(int)
    return bool(np.abs(image[y - 2 : y + 3, x - 2 : x + 3] - 90).max() > 60)


def test_raw_and_clean_stand_where_the_camera_saw_them(tmp_path: Path, cleaned: list[PoseClean], video: Path) -> None:
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
        assert pictured(clean, pixels(shown.positions)[J[joint]])
        assert pictured(raw, pixels(shown.raw_positions)[J[joint]])
    head = J["head"]
    assert not pictured(raw, pixels(shown.positions)[head])
    assert not pictured(clean, pixels(shown.raw_positions)[head])


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
    assert pictured(first, pixels(bodies[0].positions)[J["neck"]])


def test_another_video_is_refused(tmp_path: Path, cleaned: list[PoseClean], video: Path) -> None:
    later = [dataclasses.replace(message, stamp_ns=message.stamp_ns + 10**10) for message in cleaned]
    expected = r"clean .*video\.avi OUT' makes, .* ends after 0\.7 s, and these stamps begin at 10\.0 s"
    with pytest.raises(PlotError, match=expected):
        plot(record(tmp_path / "bag", later, POSE_CLEAN), video=tmp_path / "out.mp4", over=video)
    for message in cleaned:
        message.bodies[0].positions[:] = message.bodies[0].positions[:, [2, 0, 1]] * [1.0, 1.0, -1.0]
    with pytest.raises(PlotError, match="none lies within its images"):
        plot(record(tmp_path / "world", cleaned, POSE_CLEAN), video=tmp_path / "out.mp4", over=video)
    assert not (tmp_path / "out.mp4").exists()
    with pytest.raises(PlotError, match="over: expected a video that OpenCV can read"):
        plot(tmp_path / "bag", video=tmp_path / "out.mp4", over=tmp_path / "nowhere.mp4")
    with pytest.raises(PlotError, match="expected --video"):
        plot(tmp_path / "bag", over=video)
