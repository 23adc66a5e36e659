import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.helpers.values import gated

from steadypose.prior.clean.history import BRIDGED, History, Ring


def positions(frames: int, slots: int = 1) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(frames, slots, 22, 3))


def filled(frames: np.ndarray, length: int = 12) -> History:
    history = History(length, frames.shape[1])
    for frame in frames:
        history.append(gated(frame))
    return history


@given(st.integers(1, 6))
def test_frames_lost_whole_are_a_straight_line_if_they_are_few(lost: int) -> None:
    seen = positions(lost + 2)
    seen[1:-1] = np.nan
    history = filled(seen)
    got = history.positions[-lost - 2 :]
    line = np.linspace(seen[0], seen[-1], lost + 2)
    if lost > BRIDGED:
        assert np.isnan(got[1:-1]).all()
    else:
        np.testing.assert_allclose(got, line, atol=1e-12)
    assert np.isnan(history.observed[-lost - 1 : -1]).all()
    assert history.unobserved_s[-2].min() == pytest.approx(lost / 30)
    assert (history.unobserved_s[-1] == 0).all()


def test_a_body_of_which_a_joint_is_left_is_not_filled_in() -> None:
    seen = positions(3)
    seen[1, :, 1:] = np.nan
    np.testing.assert_array_equal(filled(seen).positions[-3:], seen)


def test_forgetting_a_slot_leaves_the_others() -> None:
    seen = positions(4, slots=3)
    history = filled(seen)
    history.forget(np.array([False, True, False]))
    np.testing.assert_array_equal(history.positions[-4:, [0, 2]], seen[:, [0, 2]])
    assert np.isnan(history.positions[:, 1]).all()
    assert np.isinf(history.unobserved_s[:, 1]).all()
    assert (history.confidence[:, 1] == 0).all()
    history.append(gated(seen[0]))  # who comes next was not lost a moment ago
    assert np.isnan(history.positions[-2, 1]).all()


def test_a_joint_never_seen_is_unseen_for_ever() -> None:
    seen = positions(3)
    seen[:, 0, 5] = np.nan
    assert np.isinf(filled(seen).unobserved_s[-1, 0, 5])


@given(st.integers(1, 9), st.lists(st.floats(-9, 9), max_size=40))
def test_a_ring_is_the_tail_of_what_was_pushed(frames: int, values: list[float]) -> None:
    ring = Ring(frames, (2,))
    for value in values:
        ring.push(np.array([value, -value]))
    tail = ([np.nan] * frames + values)[-frames:]
    assert np.array_equal(ring.all[:, 0], tail, equal_nan=True)
    assert np.array_equal(ring.newest, ring.all[-1], equal_nan=True)


def test_a_frame_amended_stays_so_as_the_ring_turns() -> None:
    ring = Ring(3, (2, 1))
    for k in range(5):
        ring.push(np.full((2, 1), float(k)))
    ring.amend(1, 0, np.array([9.0]))
    assert ring.all[:, :, 0].tolist() == [[2.0, 2.0], [9.0, 3.0], [4.0, 4.0]]
    ring.push(np.full((2, 1), 5.0))
    assert ring.all[:, :, 0].tolist() == [[9.0, 3.0], [4.0, 4.0], [5.0, 5.0]]
