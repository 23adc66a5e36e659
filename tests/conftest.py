"""What all tests share."""

import gc
import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from steadypose.prior.body import layouts

NEEDS_TORCH = re.compile(r"^\s*(?:from|import) (?:torch|steadypose\.(?:training|benchmarks|prior\.fit))\b", re.M)
ALL_SLOW = re.compile(r"^pytestmark = .*pytest\.mark\.slow\b", re.M)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--fast", action="store_true", help="leave out what needs torch, and what is marked slow")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Files that are left out whole are not even imported."""
    if not config.getoption("--fast") or collection_path.suffix != ".py" or collection_path.name == "conftest.py":
        return None
    source = collection_path.read_text()
    return bool(NEEDS_TORCH.search(source) or ALL_SLOW.search(source)) or None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    slow = [item for item in items if item.get_closest_marker("slow")]
    if config.getoption("--fast"):
        items[:] = [item for item in items if item not in slow]
        config.hook.pytest_deselected(items=slow)
    # files that take long come first: of two processes, the one would wait for the other's last file
    long = {item.path for item in slow}
    items.sort(key=lambda item: item.path not in long)


def pytest_collection_finish() -> None:
    """What is imported stays: looking through it for garbage again and again would take a twentieth of the time."""
    gc.collect()
    gc.freeze()


# a busy machine is no failure
settings.register_profile("steadypose", deadline=None)
settings.load_profile("steadypose")


# what a shell starts in the background ignores Ctrl-C, and with nohup the terminal's end; so would all processes that
# the tests start and interrupt
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.fixture
def own_layouts() -> Iterator[None]:
    before = dict(layouts._SKELETONS)
    yield
    layouts._SKELETONS.clear()
    layouts._SKELETONS.update(before)
