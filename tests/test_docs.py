"""The README and every page run as they are printed, block after block, away from the checkout.

A comment before a block says what is done with it:

- `<!-- file: NAME -->`: it is written to that file, and a later block runs it;
- `<!-- runs on -->`: it goes on in the background until the next heading, `<!-- runs on: prints -->` once it has said
  something;
- `<!-- not run: camera -->`: it needs what a test has not.

The streams are cut to two seconds, so that all of it takes little.
"""

import os
import re
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from steadypose import PACKAGE
from steadypose.msgs.recording import RecordingReader, RecordingWriter

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
PART = re.compile(
    r"^(?P<heading>#+ [^\n]*)$"
    r"|^(?:<!-- (?P<mark>[^\n]*) -->\n)? *```(?P<language>\w*)\n(?P<text>.*?)^ *```$",
    re.M | re.S,
)
STREAMS = ("reach", "walk_turn")
SECONDS = 2.0
SOON_S = 300.0


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    language: str
    mark: str
    text: str

    @property
    def file(self) -> str | None:
        return self.mark.removeprefix("file: ") if self.mark.startswith("file: ") else None

    @property
    def is_run(self) -> bool:
        return self.language == "sh" and not self.mark.startswith("not run: ")


def parts(page: Path) -> list[Block | str]:
    """The headings and blocks of a page, in order."""
    return [
        found["heading"] or Block(found["language"], found["mark"] or "", found["text"])
        for found in PART.finditer(page.read_text())
    ]


def blocks(page: Path) -> list[Block]:
    return [part for part in parts(page) if isinstance(part, Block)]


@pytest.fixture
def away() -> Iterator[Path]:
    """A folder with what the commands name: the command itself, its Python, launch files, and short streams."""
    folder = Path(tempfile.mkdtemp(prefix="sp"))  # short: an address of a socket has 107 bytes at most
    (folder / ".venv" / "bin").mkdir(parents=True)
    for path, run in (("steadypose", "-m steadypose.nodes.cli"), (".venv/bin/python", "")):
        (folder / path).write_text(f'#!/bin/sh\nexec "{sys.executable}" {run} "$@"\n')
        (folder / path).chmod(0o755)
    (folder / "launch").symlink_to((PACKAGE / "launch").resolve())
    for name in STREAMS:
        (folder / "sim_data").mkdir(exist_ok=True)
        with (
            RecordingReader(PACKAGE / "sim_data" / name) as reader,
            RecordingWriter(folder / "sim_data" / name) as writer,
        ):
            end_ns = reader.start_ns + round(SECONDS * 1e9)
            for topic, stamp_ns, message in reader:
                if stamp_ns < end_ns:
                    writer.write(topic, message, stamp_ns)
    yield folder
    shutil.rmtree(folder)


class Terminal:
    """Runs a page's blocks in a folder, as somebody with two hands would."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        # no XDG_RUNTIME_DIR, as over ssh or in a container: sockets are then in the temporary folder
        self._environment = {key: value for key, value in os.environ.items() if key != "XDG_RUNTIME_DIR"} | {
            "PYTHONPATH": str(PACKAGE.parent),
            "TMPDIR": str(folder),
        }
        self._background: list[subprocess.Popen[str]] = []

    def run(self, block: Block) -> None:
        if block.file:
            (self._folder / block.file).write_text(block.text)
        elif block.is_run and block.mark.startswith("runs on"):
            self._go_on(block)
        elif block.is_run:
            done = subprocess.run(
                ["sh", "-ex"], input=block.text, cwd=self._folder, env=self._environment, capture_output=True,
                text=True, timeout=SOON_S,
            )  # fmt: skip
            assert done.returncode == 0, done.stdout + done.stderr

    def _go_on(self, block: Block) -> None:
        process = subprocess.Popen(
            ["sh", "-ec", f"exec {block.text}"], cwd=self._folder, env=self._environment, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, text=True, start_new_session=True,
        )  # fmt: skip
        self._background.append(process)
        assert process.stdout
        if block.mark.endswith("prints"):
            assert select.select([process.stdout], [], [], SOON_S)[0], f"nothing was printed by {block.text}"
            assert process.stdout.readline().strip(), f"{block.text} ended without a word"

    def interrupt(self) -> None:
        """Ctrl-C for all that goes on, the last first; none may have failed before."""
        while self._background:
            process = self._background.pop()
            assert process.stdout
            ended = process.poll()
            os.killpg(process.pid, signal.SIGINT) if ended is None else None
            deadline = time.monotonic() + SOON_S
            while process.poll() is None and time.monotonic() < deadline:
                select.select([process.stdout], [], [], 0.1)
                process.stdout.readline()
            text = process.communicate(timeout=SOON_S)[0]
            assert not ended, text


@pytest.mark.parametrize("page", [page for page in PAGES if any(b.is_run for b in blocks(page))], ids=lambda p: p.stem)
def test_a_page_runs_as_it_is_printed(page: Path, away: Path) -> None:
    terminal = Terminal(away)
    try:
        for part in parts(page):
            if isinstance(part, Block):
                terminal.run(part)
            else:
                terminal.interrupt()
    finally:
        terminal.interrupt()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_block_is_run_or_says_why_not(page: Path) -> None:
    found = blocks(page)
    assert len(found) == len(re.findall(r"^ *```", page.read_text(), re.M)) / 2, "a fence that is not closed"
    for index, block in enumerate(found):
        if not block.language or block.language == "sh" or block.mark.startswith("not run: "):
            continue
        assert block.file, f"neither written to a file nor marked as not run: {block.text[:200]}"
        used = [later.text for later in found[index:] if later.is_run or later.file]
        assert any(re.search(rf"\b{re.escape(Path(block.file).stem)}\b", text) for text in used[1:]), block.file
