import errno
from collections.abc import Callable, Collection
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation
from tests.helpers.synthetic_poses import messages

from steadypose.msgs.recording import RecordingWriter
from steadypose.msgs.topics import DIAGNOSTICS, POSE_CLEAN, POSE_RAW, POSE_TRUTH, POSE_WORLD
from steadypose.msgs.types import Diagnostics, Level, Message, Pose, PoseClean, PoseRaw, PoseWorld
from steadypose.nodes.commands.small import plot
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sinks.plot.figure import draw
from steadypose.nodes.sinks.plot.history import PlotError, errors_of, history_of_path
from steadypose.nodes.sinks.plot.panels import busiest_joints, draw_contacts
from steadypose.prior.body.skeleton import J

GONE = object()
"""Returned for a message that is to go."""
EVERY = {POSE_RAW, POSE_CLEAN, POSE_WORLD, POSE_TRUTH}


def record(
    directory: Path,
    seconds: float,
    topics: Collection[str] = EVERY,
    change: Callable[[str, Message], object] = lambda *_: None,
    **options,
) -> Path:
    """What is made up, each message changed."""
    with RecordingWriter(directory) as writer:
        for topic, message in messages(seconds, **options):
            if topic in topics and change(topic, message) is not GONE:
                writer.write(topic, message, message.stamp_ns)
    return directory


def drawn(recording: Path) -> bool:
    picture = recording.with_suffix(".png")
    plot(recording, picture)
    return picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    "topics",
    [
        *(
            pytest.param(topics, marks=pytest.mark.slow)
            for topics in ({POSE_RAW}, {POSE_CLEAN}, {POSE_WORLD, POSE_TRUTH})
        ),
        EVERY,
    ],
    ids=lambda topics: "+".join(sorted(topic.removeprefix("pose/") for topic in topics)),
)
@pytest.mark.filterwarnings("error")
def test_draws_what_there_is(tmp_path: Path, topics: set[str]) -> None:
    assert drawn(record(tmp_path / "bag", 1.0, topics))


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("raw", "topics"), [(1, {POSE_RAW}), (5, EVERY), (6, EVERY)])
def test_draws_a_recording_of_a_frame_or_two(tmp_path: Path, raw: int, topics: set[str]) -> None:
    assert drawn(record(tmp_path / "bag", raw / 30, topics))


@pytest.mark.filterwarnings("error")
def test_draws_frames_in_which_nothing_is_seen(tmp_path: Path) -> None:
    def hide(_: str, message: Message) -> None:
        if isinstance(message, PoseRaw):
            message.bodies[0].positions[:] = np.nan
        if isinstance(message, PoseClean):
            message.bodies[0].raw_positions[:] = np.nan
            message.bodies[0].anomaly = np.nan

    assert drawn(record(tmp_path / "bag", 1.0, change=hide))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("hidden", [True, False])
def test_contacts_that_are_unknown_are_drawn_as_such(tmp_path: Path, hidden: bool) -> None:
    """And not those between two parts of a stream."""

    def hide(_: str, message: Message) -> object:
        if isinstance(message, PoseWorld) and hidden:
            message.bodies[0].contacts[2:6] = np.nan
        return GONE if 2 * 10**9 < message.stamp_ns < 3 * 10**9 else None

    world = history_of_path(record(tmp_path / "bag", 3.0, change=hide)).track(POSE_WORLD, 0)
    assert world is not None
    ax = Figure().subplots()
    draw_contacts(ax, world)
    legend = ax.get_legend()
    assert [text.get_text() for text in (legend.get_texts() if legend else ())] == ["unknown"] * hidden


def test_reads_bodies_errors_and_troubles(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "bag") as writer:
        for topic, message in messages(2.0, bodies=2):
            writer.write(topic, message, message.stamp_ns)
        values = {"dropped.late": "3", "queue": "1", "refused.undecodable": "2"}
        writer.write(DIAGNOSTICS, Diagnostics(3 * 10**9, "prior", Level.WARN, "", values), 3 * 10**9)
    history = history_of_path(tmp_path / "bag")
    assert history.dropped_or_refused == {"prior dropped.late": 3, "prior refused.undecodable": 2}
    assert set(history.tracks[POSE_CLEAN]) == {0, 1}
    for body in (0, 1):
        errors = errors_of(history, body)
        assert errors[POSE_RAW].mean.mean() == pytest.approx(0.032, abs=0.004), "2 cm of noise along each axis"
        assert errors[POSE_CLEAN].mean.mean() == pytest.approx(0.0048, abs=0.0006)
        assert errors[POSE_WORLD].mean.mean() == pytest.approx(0.0048, abs=0.0006)
        assert np.isnan(errors[POSE_RAW].by_joint[J["spine1"]]), "a joint that the sensor lacks has no error"


def test_a_body_is_compared_with_the_person_who_stands_there(tmp_path: Path) -> None:
    def renumber(_: str, message: Message) -> None:
        for body in message.bodies if isinstance(message, PoseRaw) else ():
            body.id = 7 - body.id

    history = history_of_path(record(tmp_path / "bag", 1.0, change=renumber, bodies=2))
    assert errors_of(history, 7)[POSE_RAW].mean.max() < 0.1


def test_a_camera_whose_place_is_unknown_is_put_where_it_fits(tmp_path: Path) -> None:
    def misplace(_: str, message: Message) -> None:
        if isinstance(message, PoseRaw):
            turned = Rotation.from_euler("z", 50, degrees=True) * Rotation.from_quat(message.sensor_pose.orientation)
            message.calibrated, message.sensor_pose = False, Pose(np.array([5.0, 6.0, 7.0]), turned.as_quat())

    errors = errors_of(history_of_path(record(tmp_path / "bag", 3.0, change=misplace)), 0)
    assert errors[POSE_RAW].mean.mean() == pytest.approx(0.032, abs=0.004)


def test_no_error_where_the_truth_is_silent(tmp_path: Path) -> None:
    def silence(topic: str, message: Message) -> object:
        return GONE if topic == POSE_TRUTH and 2e9 < message.stamp_ns < 3e9 else None

    times = errors_of(history_of_path(record(tmp_path / "bag", 3.0, change=silence)), 0)[POSE_RAW].time
    assert not ((times > 1.1) & (times < 1.9)).any()


def test_shows_the_joints_that_were_most_often_missing(tmp_path: Path) -> None:
    history = history_of_path(record(tmp_path / "bag", 4.0, {POSE_CLEAN}))
    track = history.track(POSE_CLEAN, 0)
    assert track is not None
    assert busiest_joints(track)[0] == J["left_wrist"]


@pytest.mark.parametrize(
    ("bodies", "output", "options", "expected"),
    [
        (1, "picture.gif", {}, "ending in .png, .svg or .pdf"),
        (1, "nowhere/picture.png", {}, "no directory; make it first"),
        (1, "picture.png", {"body": 9}, r"expected one of \[0\], got 9"),
        (0, "picture.png", {}, "found none"),
    ],
)
def test_what_cannot_be_drawn_says_why(tmp_path: Path, bodies: int, output: str, options: dict, expected: str) -> None:
    recording = record(tmp_path / "bag", 0.2, {POSE_RAW}, bodies=bodies)
    with pytest.raises(PlotError, match=expected):
        plot(recording, tmp_path / output, **options)


def test_a_full_disk_is_said_and_the_picture_that_was_there_stays(tmp_path: Path, monkeypatch) -> None:
    def save_half(figure: Figure, path: Path, **options: object) -> None:
        path.write_bytes(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    recording, picture = record(tmp_path / "bag", 0.2, {POSE_RAW}), tmp_path / "picture.png"
    picture.write_bytes(b"whole")
    monkeypatch.setattr(Figure, "savefig", save_half)
    with pytest.raises(LaunchError, match=r"picture.png: No space left on device; make room"):
        plot(recording, picture)
    assert picture.read_bytes() == b"whole"
    assert {path.name for path in tmp_path.iterdir()} == {"bag", "picture.png"}


def test_the_title_tells_an_id_from_a_count(tmp_path: Path) -> None:
    history = history_of_path(record(tmp_path / "bag", 0.5, bodies=2))
    assert draw(history, 1).get_suptitle().endswith("body 1, one of 2")


def test_what_is_not_one_recording_says_what_to_draw(tmp_path: Path) -> None:
    with pytest.raises(LaunchError, match=r"x\.npz does not exist: expected"):
        plot(Path("x.npz"), tmp_path / "x.png")
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "x.mcap").touch()
    with pytest.raises(PlotError, match=r"a folder of 2; name one, such as .*a, .*b"):
        plot(tmp_path, tmp_path / "x.png")
