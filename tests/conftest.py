"""What all tests share."""

import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from steadypose.prior.body import layouts

NEEDS_TORCH = re.compile(r"^\s*(?:from|import) (?:torch|steadypose\.(?:training|benchmarks|prior\.fit))\b", re.M)
SLOW = (
    "test_batch.py", "test_docs.py", "test_packaging.py", "test_processes.py", "test_run.py", "test_starts.py",
    "test_tf2.py", "test_warm_up.py",
)  # fmt: skip
"""of the whole suite alone: they start many processes, or take seconds each"""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--fast", action="store_true", help="leave out what needs torch, and what takes long")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    if not config.getoption("--fast") or collection_path.suffix != ".py" or collection_path.name == "conftest.py":
        return None
    return collection_path.name in SLOW or bool(NEEDS_TORCH.search(collection_path.read_text())) or None


# a busy machine is no failure
settings.register_profile("steadypose", deadline=None)
settings.load_profile("steadypose")


# what a shell starts in the background ignores Ctrl-C, and with nohup the terminal's end; so would all processes that
# the tests start and interrupt
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.fixture
def own_layouts() -> Iterator[None]:
    """Layouts that the test adds are gone after it."""
    before = dict(layouts._SKELETONS)
    yield
    layouts._SKELETONS.clear()
    layouts._SKELETONS.update(before)
