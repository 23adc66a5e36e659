"""What all tests share."""

from collections.abc import Iterator

import pytest
from hypothesis import settings

from steadypose.prior.body import layouts

# a busy machine is no failure
settings.register_profile("steadypose", deadline=None)
settings.load_profile("steadypose")


@pytest.fixture
def own_layouts() -> Iterator[None]:
    """Layouts that the test adds are gone after it."""
    before = dict(layouts._SKELETONS)
    yield
    layouts._SKELETONS.clear()
    layouts._SKELETONS.update(before)
