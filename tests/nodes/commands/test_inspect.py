import itertools
import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from conftest import record, repeated, walk
from ruamel.yaml import YAML
from tests.helpers.synthetic_poses import messages, messages_on

from steadypose.msgs.topics import DIAGNOSTICS, POSE_CLEAN, POSE_RAW, POSE_WORLD
from steadypose.msgs.transport import Publisher
from steadypose.msgs.types import CleanBody, Diagnostics, Level
from steadypose.nodes.commands import info as info_module
from steadypose.nodes.commands.info import info
from steadypose.nodes.commands.inspect import Rate, echo, hz, measure
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sources.recording import end_of

DEADLINE_S = 20.0


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    report = Diagnostics(2 * 10**9, "prior", Level.WARN, "1 dropped or refused", {"queue": "2"})
    return record(tmp_path / "bag", [*messages(1.0, bodies=2), (DIAGNOSTICS, report)])


def published(endpoint: str, command: Callable[[], object]) -> object:
    stream = itertools.cycle(messages(0.5))
    with (
        Publisher(endpoint) as publisher,
        ThreadPoolExecutor(1) as thread,
        repeated(lambda: publisher.publish(*next(stream)), every_s=0.001),
    ):
        return thread.submit(command).result(DEADLINE_S)


def test_echo_gives_a_line_a_message_and_a_line_a_body(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    echo(str(recording), count=3, topics=(POSE_RAW, POSE_CLEAN))
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "pose/raw    1.000  made-up  azure_kinect32  2 bodies"
    assert lines[1].startswith("  0: 32 of 32 joints")
    assert lines[3].startswith("pose/clean  1.000  made-up  delay 4  2 bodies")
    assert "3 seen, 18 refined, 1 imputed; sigma up to 6.0 cm; anomaly" in lines[4]
    assert len(lines) == 9
    hz(str(recording), topics=(POSE_RAW,))
    assert "average rate: 30.000 Hz  min: 0.0333 s  max: 0.0333 s" in capsys.readouterr().out


def test_echo_tells_of_the_world_of_nodes_and_of_a_body_that_is_not_seen(recording: Path, tmp_path: Path, capsys):
    echo(str(recording), topics=(POSE_WORLD, DIAGNOSTICS))
    out = capsys.readouterr().out
    assert "0.50 m/s, ok" in out
    assert out.splitlines()[-1] == "diagnostics 2.000  prior: WARN 1 dropped or refused"
    message = messages_on(POSE_RAW, 0.1)[0]
    message.bodies[0].positions[:] = np.nan
    echo(str(record(tmp_path / "hidden", [message])))
    assert "0 of 32 joints" in capsys.readouterr().out


def test_echo_in_full_is_yaml_with_every_field(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    echo(str(recording), count=1, full=True, topics=(POSE_CLEAN,))
    echo(str(recording), count=1, full=True, topics=(DIAGNOSTICS,))
    clean, report = YAML(typ="safe").load_all(capsys.readouterr().out)
    expected = messages_on(POSE_CLEAN, 1.0, bodies=2)[0]
    assert clean["stamp_ns"] == expected.stamp_ns
    assert clean["sensor_pose"]["orientation"] == pytest.approx(expected.sensor_pose.orientation, rel=1e-4)
    body = clean["bodies"][1]
    assert set(body) == set(CleanBody.__dataclass_fields__)
    assert body["state"]["spine1"] == "IMPUTED"
    assert body["positions"]["left_wrist"] == pytest.approx(expected.bodies[1].positions[20], rel=1e-3)
    assert np.isnan(body["raw_positions"]["spine1"]).all()
    assert report["values"] == {"queue": "2"}


def test_echo_and_hz_of_a_topic_end_after_their_count(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """And find the topic through a launch file, or at its endpoint."""
    launch, endpoint = tmp_path / "here.toml", f"ipc://{tmp_path}/prior"
    launch.write_text(f'[transport]\ndirectory = "{tmp_path}"\n')
    published(endpoint, lambda: echo(POSE_CLEAN, count=2, launch=str(launch)))
    headings = [line for line in capsys.readouterr().out.splitlines() if not line.startswith(" ")]
    assert [heading[:10] for heading in headings] == ["pose/clean"] * 2
    published(endpoint, lambda: hz(POSE_RAW, count=10, endpoints=(endpoint,)))
    assert "window: 10" in capsys.readouterr().out.splitlines()[-1]


def test_the_end_of_a_stream_is_no_frame_of_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, frames in (("one", walk(1)), ("two", walk(2))):
        record(tmp_path / name, [*frames, end_of(frames[-1])])
        assert info(str(tmp_path / name)) == 0
        hz(str(tmp_path / name))
    printed = capsys.readouterr().out
    assert "2 messages\n" in printed
    assert "pose/raw: no rate, window: 1\n" in printed
    assert "3 messages, 30.00 Hz, longest gap 33 ms\n" in printed
    assert "pose/raw: average rate: 30.000 Hz" in printed


def test_rates_of_uneven_times_are_told_once_a_second_and_look_back_no_further_than_the_window() -> None:
    rate = Rate([0.0, 0.1, 0.2, 0.5])
    found = (rate.mean_hz, rate.shortest_s, rate.longest_s, rate.deviation_s)
    assert found == pytest.approx((6.0, 0.1, 0.3, np.std([0.1, 0.1, 0.3])))
    assert np.isnan(Rate([1.0]).mean_hz)
    assert not Rate([1.0, 1.0]).brief, "a frame and the end of its stream"
    rates = list(measure(iter([*np.arange(0, 10, 0.1), *np.arange(10, 20, 0.05)]), window_s=2.0))
    assert len(rates) == pytest.approx(20, abs=1)
    assert (rates[5].mean_hz, rates[-1].mean_hz) == pytest.approx((10.0, 20.0), rel=0.01)
    assert rates[-1].count == pytest.approx(41, abs=1)


def test_info_of_a_recording_also_of_one_cut_short(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert info(str(recording)) == 0
    out = capsys.readouterr().out
    assert "pose/raw: steadypose_msgs/msg/PoseRaw\n    30 messages, 30.00 Hz, longest gap 33 ms" in out
    assert "source made-up; frame camera; skeleton azure_kinect32; body ids 0, 1" in out
    assert "delay 4 frames" in out
    assert "diagnostics: diagnostic_msgs/msg/DiagnosticArray\n    1 message\n    nodes prior" in out
    (file,) = recording.glob("*.mcap")
    content = file.read_bytes()
    file.write_bytes(content[: len(content) * 2 // 3])
    assert info(str(recording)) == 0
    assert "cut short" in capsys.readouterr().out


def test_info_of_a_topic(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(info_module, "INFO_S", 0.5)
    endpoint, silent = f"ipc://{tmp_path}/input", f"ipc://{tmp_path}/nobody"
    assert published(endpoint, lambda: info(POSE_RAW, endpoints=(endpoint, silent))) == 0
    out = capsys.readouterr().out
    assert re.search(rf"{endpoint}: \d+ messages in 0.5 s, [1-9][\d.]+ Hz, longest gap \d+ ms", out)
    assert "skeleton azure_kinect32" in out
    assert f"{silent}: 0 messages" in out
    assert info(POSE_RAW, endpoints=(silent,)) == 1
    assert "is `steadypose run` running?" in capsys.readouterr().out


@pytest.mark.parametrize(("command", "expected"), [
    (lambda bag: echo("pose/clen"), "did you mean 'pose/clean'"),
    (lambda bag: hz("no/where"), "no topic or recording"),
    (lambda bag: echo(bag, topics=("pose/x",)), "no topic 'pose/x'"),
    (lambda bag: echo(POSE_RAW, topics=(POSE_CLEAN,)), "chooses from a recording"),
])  # fmt: skip
def test_what_is_not_there_is_named(recording: Path, command: Callable[[str], None], expected: str) -> None:
    with pytest.raises(LaunchError, match=expected):
        command(str(recording))
