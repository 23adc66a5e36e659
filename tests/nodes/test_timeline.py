import dataclasses

import numpy as np
from tests.prior.events.test_detector import FRAME_NS, START_NS, message, pointing, raised, sitting, standing

from steadypose.msgs.types import EventKind, Hand
from steadypose.nodes.timeline import EventTimeline


def at(index: int) -> int:
    return START_NS + index * FRAME_NS


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


def test_a_stream_that_starts_anew_ends_what_held() -> None:
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
