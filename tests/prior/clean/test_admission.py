import dataclasses
from collections import Counter
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.helpers.bodies import raw, stream, waving
from tests.helpers.values import clean

from steadypose.msgs.types import PoseClean, PoseRaw
from steadypose.prior.clean.admission import ACCEPT_AFTER, StampGate
from steadypose.prior.clean.batch import StreamBatch
from steadypose.prior.clean.settings import PriorSettings
from steadypose.prior.timing.resample import PERIOD_NS

SECOND_NS = 10**9
START_NS = 1_700_000_000 * SECOND_NS
YEAR_2037_NS = 2_114_380_800 * SECOND_NS
SIMPLE: dict[str, Any] = {stage: {"enabled": False} for stage in ("score", "impute")} | {"max_bodies": 2}


@pytest.fixture(scope="module")
def frames() -> list[PoseRaw]:
    return stream(waving(26), START_NS)


@pytest.fixture(scope="module")
def answers(frames: list[PoseRaw]) -> list[PoseClean]:
    return clean(frames, **SIMPLE)[0]


@pytest.mark.parametrize("wrong_ns", [0, 10, START_NS + 5 * SECOND_NS, START_NS - 5 * SECOND_NS, YEAR_2037_NS])
def test_one_wrong_stamp_changes_nothing_but_a_count(
    frames: list[PoseRaw], answers: list[PoseClean], wrong_ns: int
) -> None:
    wrong = dataclasses.replace(frames[12], stamp_ns=wrong_ns)
    found, prior = clean([*frames[:12], wrong, *frames[12:]], **SIMPLE)
    assert found == answers
    assert prior.counters == {"stamp_outlier": 1}


@pytest.mark.parametrize("shift_ns", [3 * SECOND_NS, -3 * SECOND_NS, YEAR_2037_NS - START_NS])
def test_a_clock_that_was_set_loses_no_frame(frames: list[PoseRaw], shift_ns: int) -> None:
    later = [dataclasses.replace(frame, stamp_ns=frame.stamp_ns + shift_ns) for frame in frames[12:]]
    found, prior = clean([*frames[:12], *later], **SIMPLE)
    assert [answer.stamp_ns for answer in found] == [frame.stamp_ns for frame in [*frames[:12], *later]]
    assert all(answer.bodies for answer in found)
    assert not prior.counters["stamp_outlier"]


def test_a_stream_that_ends_within_the_jump_is_answered(frames: list[PoseRaw]) -> None:
    late = [
        dataclasses.replace(frame, stamp_ns=frame.stamp_ns + 3 * SECOND_NS)
        for frame in frames[12 : 12 + ACCEPT_AFTER - 1]
    ]
    assert len(clean([*frames[:12], *late], **SIMPLE)[0]) == 12 + ACCEPT_AFTER - 1
    end = dataclasses.replace(late[-1], bodies=[], end_of_stream=True)
    found, _ = clean([*frames[:12], *late, end], **SIMPLE)
    assert len(found) == 12 + ACCEPT_AFTER
    assert found[-1].end_of_stream


def test_a_server_drops_a_wrong_stamp_of_one_stream_alone(frames: list[PoseRaw]) -> None:
    server = StreamBatch(PriorSettings.from_dict(SIMPLE), 2)
    found = []
    for index, frame in enumerate(frames):
        now_ns = frame.stamp_ns + 1_000_000
        for source in ("door", "desk"):
            message = dataclasses.replace(frame, source=source)
            if (index, source) == (12, "door"):
                found += server.process_at(dataclasses.replace(message, stamp_ns=YEAR_2037_NS), now_ns)
            found += server.process_at(message, now_ns)
    for source in ("door", "desk"):
        stamps = [answer.stamp_ns for answer in found if answer.source == source]
        assert np.diff(stamps) == pytest.approx(PERIOD_NS, abs=2)
    assert +server.counters == {"stamp_outlier": 1}


def gate(counters: Counter[str] | None = None) -> StampGate:
    return StampGate(0.5 * SECOND_NS, Counter() if counters is None else counters)


def test_a_slow_stream_is_a_stream() -> None:
    stamps = [START_NS + k * SECOND_NS for k in range(10)]
    stamp_gate = gate()
    came = [len(stamp_gate.admit(raw(stamp, {}))) for stamp in stamps]
    assert came == [1, 0, 0, 3, 1, 1, 1, 1, 1, 1], "known for slow, it waits no more"


@given(st.lists(st.integers(0, 2**31 * SECOND_NS - 1), max_size=30))
def test_whatever_comes_comes_out_in_order_or_is_counted(stamps: list[int]) -> None:
    counters: Counter[str] = Counter()
    stamp_gate = gate(counters)
    found = [message.stamp_ns for stamp in stamps for message, _ in stamp_gate.admit(raw(stamp, {}))]
    found += [message.stamp_ns for message, _ in stamp_gate.release()]
    remaining = iter(stamps)
    assert all(stamp in remaining for stamp in found), "in the order in which they came, each once"
    assert len(found) + counters["stamp_outlier"] == len(stamps)


@given(st.lists(st.integers(1, SECOND_NS // 2), max_size=30))
def test_a_stream_without_jumps_passes_at_once(steps: list[int]) -> None:
    stamps = [START_NS + sum(steps[:k]) for k in range(len(steps))]
    stamp_gate = gate()
    assert all(len(stamp_gate.admit(raw(stamp, {}))) == 1 for stamp in stamps)
