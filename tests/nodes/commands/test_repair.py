from pathlib import Path

import pytest
from conftest import record, walk

from steadypose.msgs.recording import RecordingReader
from steadypose.msgs.topics import POSE_RAW
from steadypose.nodes.commands.clean import clean
from steadypose.nodes.commands.info import info
from steadypose.nodes.commands.small import repair


@pytest.fixture
def damaged(tmp_path: Path) -> Path:
    path = record(tmp_path / "in", walk(60))
    file = next(path.glob("*.mcap"))
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    return path


def test_what_is_left_is_saved_and_what_is_lost_is_said(damaged: Path, tmp_path: Path, capsys) -> None:
    assert repair(damaged, tmp_path / "out") == 1
    assert "bytes in 1 place\n" in capsys.readouterr().out
    with RecordingReader(tmp_path / "out") as recording:
        assert recording.complete
        assert 60 - 16 <= recording.count(POSE_RAW) < 60
    assert repair(tmp_path / "out", tmp_path / "again") == 0
    assert info(str(damaged)) == 0
    assert "steadypose repair" in capsys.readouterr().out


def test_clean_says_so_with_its_exit_status(damaged: Path, tmp_path: Path) -> None:
    assert clean(damaged, tmp_path / "out.npz") == 1
    assert (tmp_path / "out.npz").exists()
