import time
from pathlib import Path

import pytest
from tests.helpers.msg_strategies import raw

from steadypose.msgs import delivery
from steadypose.msgs.delivery import WINDOW
from steadypose.msgs.publisher import Resume
from steadypose.msgs.topics import POSE_RAW
from steadypose.msgs.transport import Publisher, Subscriber

SOON_S = 20.0
NEVER_S = 0.2


@pytest.fixture
def endpoint(tmp_path: Path) -> str:
    return f"ipc://{tmp_path}/socket"


def reader(endpoint: str, context: int = 0) -> Subscriber:
    return Subscriber(endpoint, POSE_RAW, reliable=True, name="reader", context=context)


def stamps(subscriber: Subscriber, number: int, *, taken: bool = True) -> list[int]:
    got = [subscriber.receive(SOON_S, taken=taken) for _ in range(number)]
    return [received[1].stamp_ns for received in got if received]


@pytest.mark.parametrize("context", [0, 3])
def test_an_heir_is_given_what_was_not_taken_and_what_it_asks_for_before(endpoint: str, context: int) -> None:
    with Publisher(endpoint, reliable={"reader"}) as publisher:
        with reader(endpoint, context) as first:
            assert publisher.wait_for_subscribers(["reader"], timeout_s=SOON_S)
            for stamp in range(20):
                publisher.publish(POSE_RAW, raw(stamp))
            assert stamps(first, 15, taken=False) == list(range(15))
            first.take(10)
            assert publisher.is_taken(POSE_RAW, 9, timeout_s=SOON_S)
            assert not publisher.is_taken(POSE_RAW, 10)
        while publisher.subscribers:
            time.sleep(0)
        with reader(endpoint, context) as heir:
            assert publisher.wait_for_subscribers(["reader"], timeout_s=SOON_S)
            publisher.publish(POSE_RAW, raw(20))
            assert stamps(heir, 11 + context) == list(range(10 - context, 21))
            assert heir.receive(NEVER_S) is None
            assert not heir.dropped
            assert not heir.refused
            assert publisher.is_taken(POSE_RAW, 20, timeout_s=SOON_S)


def test_nobody_else_hears_what_is_sent_again(endpoint: str) -> None:
    with Publisher(endpoint, reliable={"reader"}) as publisher, Subscriber(endpoint, POSE_RAW, name="other") as other:
        assert publisher.wait_for_subscribers(["other"], timeout_s=SOON_S)
        with reader(endpoint):
            assert publisher.wait_for_subscribers(["reader"], timeout_s=SOON_S)
            publisher.publish(POSE_RAW, raw(0))
        while publisher.subscribers != {"other"}:
            time.sleep(0)
        with reader(endpoint) as heir:
            assert publisher.wait_for_subscribers(["reader"], timeout_s=SOON_S)
            assert stamps(heir, 1) == [0]
        publisher.publish(POSE_RAW, raw(1))
        assert stamps(other, 2) == [0, 1]
        assert not other.refused


def test_a_publisher_that_resumes_repeats_to_nobody_and_loses_nothing(endpoint: str) -> None:
    with reader(endpoint) as subscriber:
        with Publisher(endpoint, reliable={"reader"}) as first:
            while not first.subscribers:
                subscriber.receive(0)
            for stamp in range(10):
                first.publish(POSE_RAW, raw(stamp))
            assert stamps(subscriber, 10) == list(range(10))
        with Publisher(endpoint, reliable={"reader"}, resume=Resume(first.id, {POSE_RAW: 4})) as second:
            while not second.subscribers:
                subscriber.receive(0)
            for stamp in range(4, 4 + 2 * WINDOW):  # more than it waits for: who had them says so
                while not second.publish(POSE_RAW, raw(stamp), timeout_s=0):
                    subscriber.receive(0.01)
                if stamp >= 10:
                    assert stamps(subscriber, 1) == [stamp]
        assert not subscriber.dropped
        assert not subscriber.refused


def test_who_never_reads_is_named_and_waited_for_no_longer_than_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(delivery.time, "monotonic", lambda: now[0])
    deliveries = delivery.Deliveries({"reader"}, {})
    deliveries.join(delivery.Listener("reader", 1, (POSE_RAW,)))
    now[0] += 3600.0
    assert not deliveries.silent(2.0), "it had nothing to read"
    for _ in range(WINDOW):
        deliveries.sent(POSE_RAW, b"")
        assert not deliveries.silent(2.0), "it had no time yet"
    now[0] += delivery.DEAF_S
    assert deliveries.waited_for(POSE_RAW) == {"reader"}
    assert deliveries.silent(2.0) == {"reader"}
    assert not deliveries.is_taken(POSE_RAW, 0)
    now[0] += 1.0
    assert not deliveries.waited_for(POSE_RAW)
    assert deliveries.is_taken(POSE_RAW, 0), "nor is the stream's end"
    assert deliveries.silent(delivery.DEAF_S) == {"reader"}
    deliveries.take(delivery.Taken(1, 0, 200, POSE_RAW))
    assert not deliveries.silent(2.0)
    assert not deliveries.is_taken(POSE_RAW, 200), "who reads again is waited for again"


def test_a_second_one_of_a_name_takes_nothing_away_from_the_first() -> None:
    deliveries = delivery.Deliveries({"reader"}, {})
    first, second, heir = (delivery.Listener("reader", n, (POSE_RAW,)) for n in (1, 2, 3))
    deliveries.join(first)
    deliveries.join(second)
    for n in range(9):
        deliveries.sent(POSE_RAW, b"%d" % n)
    deliveries.take(delivery.Taken(1, 0, 7, POSE_RAW))
    deliveries.leave(second)
    assert deliveries.is_taken(POSE_RAW, 6)
    deliveries.leave(first)
    assert deliveries.join(heir) == [b"7", b"8"]


def test_what_is_kept_for_one_who_stays_away_has_an_end() -> None:
    deliveries = delivery.Deliveries({"reader"}, {})
    listener = delivery.Listener("reader", 1, (POSE_RAW,), context=10**9)
    deliveries.join(listener)
    deliveries.leave(listener)
    for n in range(5000):
        deliveries.sent(POSE_RAW, b"%d" % n)
    kept = deliveries.join(listener._replace(instance=2))
    assert kept[-1] == b"4999"
    assert len(kept) <= WINDOW + delivery.MAX_CONTEXT + 1


def test_who_has_more_than_a_resumed_publisher_has_sent_again_holds_it_up_for_nothing() -> None:
    deliveries = delivery.Deliveries({"reader"}, {POSE_RAW: 100})
    deliveries.join(delivery.Listener("reader", 1, (POSE_RAW,)))
    for _ in range(WINDOW):
        deliveries.sent(POSE_RAW, b"")
    assert deliveries.waited_for(POSE_RAW)
    deliveries.take(delivery.Taken(1, 0, 100 + 2 * WINDOW, POSE_RAW))
    assert not deliveries.waited_for(POSE_RAW)
    assert deliveries.is_taken(POSE_RAW, 100 + WINDOW - 1)
    deliveries.take(delivery.Taken(1, 0, 90, POSE_RAW))
    assert deliveries.is_taken(POSE_RAW, 100 + WINDOW - 1), "nobody gives back what it has taken"
