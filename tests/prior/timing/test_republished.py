import numpy as np
import pytest
from tests.helpers.bodies import waving

from steadypose.prior.timing.republished import RUNS, Republished


def dropped(frames: np.ndarray) -> list[bool]:
    republished = Republished()
    return [republished.update(frame[None]) for frame in frames]


@pytest.mark.parametrize("times", [2, 3])
def test_what_a_stream_repeats_regularly_is_dropped(times: int) -> None:
    frames = np.repeat(waving(60), times, axis=0)
    frames[:, 4] = np.nan
    new = np.arange(len(frames)) % times == 0
    found = np.array(dropped(frames))
    assert not found[new].any()
    assert found[~new][RUNS * (times - 1) :].all()


def test_who_stands_still_without_noise_is_no_repetition() -> None:
    moving = waving(60)
    frames = np.concatenate([moving[:20], np.repeat(moving[20:21], 40, axis=0), moving[20:]])
    assert not any(dropped(frames))
    assert not any(dropped(np.repeat(moving[:1], 100, axis=0)))


def test_a_tracker_that_stops_is_given_on_after_its_usual_repetitions() -> None:
    frames = np.concatenate([np.repeat(waving(60), 2, axis=0), np.repeat(waving(1), 30, axis=0)])
    assert sum(dropped(frames)[120:]) == 1
