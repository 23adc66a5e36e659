from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.nodes.conftest import walk

import steadypose
from steadypose import EventKind, Phase
from steadypose.nodes.timeline import TimedEvent

FRAMES = 60
START_NS = 10**18
NEAR = {"events": {"near": 10.0}}
JOINTS = np.array([[body.positions for body in frame.bodies] for frame in walk(FRAMES, bodies=2)])


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
    pose = cleaner(JOINTS[0, 0], 0.0)
    assert cleaner.events == ()
    assert pose is not None
    for alone in (pose, pose.bodies[0]):
        with pytest.raises(AttributeError, match=r"steadypose\.Filter\(\.\.\., events=True\)"):
            alone.events  # noqa: B018
