"""What all tests share."""

import signal
from collections.abc import Iterator

import pytest
from hypothesis import settings

from steadypose.prior.body import layouts

# a busy machine is no failure
settings.register_profile("steadypose", deadline=None)
settings.load_profile("steadypose")


# what a shell starts in the background ignores Ctrl-C, and so would all processes that the tests start and interrupt
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def own_layouts() -> Iterator[None]:
    """Layouts that the test adds are gone after it."""
    before = dict(layouts._SKELETONS)
    yield
    layouts._SKELETONS.clear()
    layouts._SKELETONS.update(before)
