import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from steadypose.prior.timing.ring import Ring


@given(st.integers(1, 9), st.lists(st.floats(-9, 9), max_size=40))
def test_a_ring_is_the_tail_of_what_was_pushed(frames: int, values: list[float]) -> None:
    ring = Ring(frames, (2,))
    for value in values:
        ring.push(np.array([value, -value]))
    tail = ([np.nan] * frames + values)[-frames:]
    assert np.array_equal(ring.all[:, 0], tail, equal_nan=True)
    assert np.array_equal(ring.newest, ring.all[-1], equal_nan=True)


def test_a_ring_never_allocates() -> None:
    ring = Ring(4, (3,))
    where = ring._data.ctypes.data
    for k in range(20):
        ring.push(np.full(3, k))
        assert np.shares_memory(ring.all, ring._data)
    assert ring._data.ctypes.data == where


def test_a_frame_amended_stays_so_as_the_ring_turns() -> None:
    ring = Ring(3, (2, 1))
    for k in range(5):
        ring.push(np.full((2, 1), float(k)))
    ring.amend(1, 0, np.array([9.0]))
    assert ring.all[:, :, 0].tolist() == [[2.0, 2.0], [9.0, 3.0], [4.0, 4.0]]
    ring.push(np.full((2, 1), 5.0))
    assert ring.all[:, :, 0].tolist() == [[9.0, 3.0], [4.0, 4.0], [5.0, 5.0]]
