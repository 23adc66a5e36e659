import dataclasses
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.nodes.conftest import walked
from tests.prior.events.test_detector import FRAME_NS, message, pointing, raised, sitting, standing
from tests.prior.events.test_detector import START_NS as BEGIN_NS

import steadypose
from steadypose import EventKind, Phase
from steadypose.msgs.types import Hand
from steadypose.nodes.timeline import EventTimeline, TimedEvent

FRAMES = 60
START_NS = 10**18
NEAR = {"events": {"near": 10.0}}
JOINTS = walked(FRAMES, bodies=2)


def stamps_of(frames: int, fps: float) -> list[int]:
    return (START_NS + np.round(np.arange(frames) * 1e9 / fps).astype(np.int64)).tolist()


def rows(events: Iterable[TimedEvent]) -> list[tuple[object, ...]]:
    return [(*event._replace(direction=np.zeros(0))[:6], *event.direction.tolist(), event.phase) for event in events]


def newest(events: Iterable[TimedEvent]) -> list[TimedEvent]:
    """Each event once, as it was last seen, by begin."""
    last = {event[:4]: event for event in events}
    return sorted(last.values(), key=lambda event: (event.begin_ns, event.body))


@pytest.mark.filterwarnings("ignore::steadypose.InputWarning")
@settings(max_examples=5, deadline=None)
@given(
    gone=st.tuples(st.integers(0, FRAMES), st.integers(0, FRAMES)),
    both_gone=st.integers(0, FRAMES),
    fps=st.sampled_from([15.0, 30.0, 50.0]),
)
def test_all_calls_together_have_the_events_of_the_recording(gone: tuple[int, int], both_gone: int, fps: float) -> None:
    joints = JOINTS.copy()
    joints[min(gone) : max(gone), 0] = np.nan
    joints[both_gone:] = np.nan
    stamps = stamps_of(FRAMES, fps)
    cleaner = steadypose.Filter(delay=2, settings=NEAR, events=True)
    found: list[TimedEvent] = []
    for frame, stamp_ns in zip(joints, stamps, strict=True):
        poses = cleaner.update(frame, stamp_ns=stamp_ns)
        found += cleaner.events
        of_poses = [event for pose in poses for event in pose.events]
        assert set(rows(of_poses)) <= set(rows(cleaner.events))
    cleaner.flush()
    found += cleaner.events
    if np.isfinite(joints).any():
        recorded = steadypose.clean(joints, stamp_ns=stamps, delay=2, settings=NEAR)
        assert rows(newest(found)) == rows(recorded.events)
    assert len({event[:4] for event in found}) == sum(event.phase == Phase.BEGINS for event in found), "begins once"


def test_a_pose_has_the_events_of_its_frame_and_bodies() -> None:
    cleaner = steadypose.Filter(delay=0, settings=NEAR, events=True)
    phases: dict[int, list[Phase]] = {4: [], 7: []}
    for number, (frame, stamp_ns) in enumerate(zip(JOINTS, stamps_of(FRAMES, 30.0), strict=True)):
        bodies = frame[[number < 30, True]]
        pose = cleaner(bodies, stamp_ns=stamp_ns, ids=[4, 7][-len(bodies) :])
        for body, seen in phases.items():
            if pose is not None and body in pose.bodies:
                near = [event for event in pose.bodies[body].events if event.kind == EventKind.NEAR]
                assert all(event.body == body and event.end_ns == pose.stamp_ns for event in near)
                seen += [event.phase for event in near]
    holds = phases[7][1:]
    assert phases[7][0] == Phase.BEGINS
    assert len(holds) > 50
    assert set(holds) == {Phase.HOLDS}


def test_the_last_person_leaves_after_their_last_pose() -> None:
    cleaner = steadypose.Filter(delay=0, events=True)
    left: list[int] = []
    for number, stamp_ns in enumerate(stamps_of(90, 30.0)):
        pose = cleaner(JOINTS[number, 0] if number < 40 else [], stamp_ns=stamp_ns)
        if any(event.kind == EventKind.LEFT for event in cleaner.events):
            assert pose is None
            left.append(number)
    assert len(left) == 1
    assert 40 < left[0] < 70


def test_nobody_who_did_not_ask_pays_for_events() -> None:
    cleaner = steadypose.Filter(delay=0)
    pose: Any = cleaner(JOINTS[0, 0], 0.0)
    assert cleaner.events == ()
    for alone in (pose, pose.bodies[0]):
        with pytest.raises(AttributeError, match=r"steadypose\.Filter\(\.\.\., events=True\)"):
            alone.events  # noqa: B018


def at(index: int) -> int:
    return BEGIN_NS + index * FRAME_NS


def test_what_has_begun_ends_with_its_condition_or_with_the_stream() -> None:
    timeline = EventTimeline()
    poses = [*[standing()] * 20, *[sitting()] * 20, *[standing()] * 20, *[raised(standing())] * 10]
    for index, pose in enumerate(poses):
        timeline.add(message(index, pose))
    found = {(e.kind, e.hand): e for e in timeline.events()}
    entered, sits = found[EventKind.ENTERED, Hand.NONE], found[EventKind.SITS, Hand.NONE]
    assert entered.begin_ns == entered.end_ns == at(0)
    assert at(20) <= sits.begin_ns <= at(30)
    assert at(40) <= sits.end_ns <= at(45)
    assert found[EventKind.HAND_RAISED, Hand.RIGHT].end_ns == at(69), "it holds to the end"
    assert [e.kind for e in timeline.events()].count(EventKind.STANDS) == 2
    begins = [e.begin_ns for e in timeline.events()]
    assert begins == sorted(begins)
    timeline = EventTimeline()
    for index in range(20):
        timeline.add(message(index, standing(), pointing()))
    timeline.add(dataclasses.replace(message(20), end_of_stream=True))
    for index in range(100, 110):
        timeline.add(message(index, standing()))
    first, second = (e for e in timeline.events() if e.kind == EventKind.STANDS and e.body == 0)
    assert first.end_ns == at(19)
    assert (second.begin_ns, second.end_ns) == (at(100), at(109))
    (points,) = (e for e in timeline.events() if e.kind == EventKind.POINTS)
    assert (points.body, points.hand) == (1, Hand.RIGHT)
    np.testing.assert_allclose(np.linalg.norm(points.direction), 1.0)


def test_the_sensor_is_where_it_is_said_to_be() -> None:
    timeline = EventTimeline()
    for index in range(20):
        timeline.add(message(index, standing(2.5)), np.array([2.0, 0.0, 1.0]))
    assert EventKind.NEAR in {e.kind for e in timeline.events()}
