"""The commands that the README and the pages print run as they are printed, in order, away from the checkout.

Not those that need what a test has not: `<!-- not run: camera -->` before a block says what. The streams are cut to a
second and a half, so that all of it takes little.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from steadypose import PACKAGE
from steadypose.msgs.recording import RecordingReader, RecordingWriter

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(
    r"^(?:<!-- not run: (?P<reason>[\w ,]+) -->\n)?(?P<indent> *)```sh\n(?P<text>.*?)^ *```$", re.M | re.S
)
STREAMS = ("reach", "walk_turn")
SECONDS = 1.5


def blocks(page: Path) -> list[str]:
    """The blocks of a page that are run."""
    return [found["text"] for found in BLOCK.finditer(page.read_text()) if not found["reason"]]


@pytest.fixture
def away(tmp_path: Path) -> Path:
    """A folder with what the commands name: the command itself, launch files, and short streams."""
    command = tmp_path / "steadypose"
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m steadypose.nodes.cli "$@"\n')
    command.chmod(0o755)
    (tmp_path / "launch").symlink_to((PACKAGE / "launch").resolve())
    (tmp_path / "sim_data").mkdir()
    for name in STREAMS:
        with (
            RecordingReader(PACKAGE / "sim_data" / name) as reader,
            RecordingWriter(tmp_path / "sim_data" / name) as writer,
        ):
            end_ns = reader.start_ns + round(SECONDS * 1e9)
            for topic, stamp_ns, message in reader:
                if stamp_ns < end_ns:
                    writer.write(topic, message, stamp_ns)
    return tmp_path


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page)], ids=lambda page: page.stem)
def test_a_pages_commands_run_in_order(page: Path, away: Path) -> None:
    environment = os.environ | {
        "PATH": f"{away}:{os.environ['PATH']}",
        "PYTHONPATH": str(PACKAGE.parent),
        "XDG_RUNTIME_DIR": str(away / "sockets"),
    }
    done = subprocess.run(
        ["sh", "-ex"], input="\n".join(blocks(page)), cwd=away, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_block_is_found() -> None:
    for page in PAGES:
        assert len(re.findall(r"^ *```sh$", page.read_text(), re.M)) == len(list(BLOCK.finditer(page.read_text()))), (
            page
        )
    assert blocks(PAGES[0])
