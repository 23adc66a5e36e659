"""Our own buffer of transforms, against tf2's own: the C++ core in Debian's `python3-tf2`.

That is ROS 1's package, for the system's Python, from which ROS 2's `tf2::BufferCore` was ported.
"""

import json
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from steadypose.nodes.ros2.definitions import stamp_ns
from steadypose.nodes.sinks.ros2.messages import tf_message, transform
from steadypose.nodes.sources.ros2 import TransformBuffer, TransformError

pytestmark = pytest.mark.slow

SYSTEM_PYTHON = Path("/usr/bin/python3")
TF2 = """
import json, sys
from genpy import Duration, Time
from geometry_msgs.msg import TransformStamped
from tf2_py import BufferCore, ConnectivityException, ExtrapolationException, LookupException

print("ready", flush=True)
for line in sys.stdin:
    asked = json.loads(line)
    buffer, results = BufferCore(Duration(10)), []
    for stamp, parent, child, place, turned, static in asked["transforms"]:
        sent = TransformStamped()
        sent.header.stamp, sent.header.frame_id, sent.child_frame_id = Time(*divmod(stamp, 10**9)), parent, child
        at, q = sent.transform.translation, sent.transform.rotation
        (at.x, at.y, at.z), (q.x, q.y, q.z, q.w) = place, turned
        (buffer.set_transform_static if static else buffer.set_transform)(sent, "test")
    for target, source, stamp in asked["lookups"]:
        try:
            found = buffer.lookup_transform_core(target, source, Time(*divmod(stamp, 10**9))).transform
            at, q = found.translation, found.rotation
            results.append([[at.x, at.y, at.z], [q.x, q.y, q.z, q.w]])
        except ExtrapolationException:
            results.append("extrapolation")
        except (ConnectivityException, LookupException):
            results.append("no path")
    print(json.dumps(results), flush=True)
"""
Lookup = tuple[str, str, int]
Ask = Callable[[list[tuple[Any, bool]], list[Lookup]], list[Any]]


@pytest.fixture(scope="module")
def tf2() -> Iterator[Ask]:
    """Asks a new tf2 buffer, after (message, whether it is static) in this order."""
    if not SYSTEM_PYTHON.exists():
        pytest.skip("tf2: there is no /usr/bin/python3")
    with subprocess.Popen(
        [SYSTEM_PYTHON, "-c", TF2], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as it:
        assert it.stdin
        assert it.stdout
        if not it.stdout.readline():
            pytest.skip("tf2: not installed: apt-get install python3-tf2 (Debian, Ubuntu)")
        wants, results = it.stdin, it.stdout

        def ask(sent: list[tuple[Any, bool]], lookups: list[Lookup]) -> list[Any]:
            transforms = [
                (stamp_ns(one.header), one.header.frame_id, one.child_frame_id, *_values(one.transform), static)
                for message, static in sent
                for one in message.transforms
            ]
            wants.write(json.dumps({"transforms": transforms, "lookups": lookups}) + "\n")
            wants.flush()
            return json.loads(results.readline())

        yield ask
        it.stdin.close()


def _values(of: Any) -> tuple[list[float], list[float]]:
    at, q = of.translation, of.rotation
    return [at.x, at.y, at.z], [q.x, q.y, q.z, q.w]


def _assert_pose(found: Any, place: Any, turned: Rotation, atol: float = 1e-6) -> None:
    np.testing.assert_allclose(found[0], place, atol=atol)
    np.testing.assert_allclose(Rotation.from_quat(found[1]).as_matrix(), turned.as_matrix(), atol=atol)


def _ours(buffer: TransformBuffer, lookup: Lookup) -> Any:
    try:
        return buffer.lookup(*lookup)
    except TransformError as error:
        return "no path" if "no path" in str(error) else "extrapolation"


@st.composite
def _trees(draw: st.DrawFn) -> tuple[list[tuple[Any, bool]], list[Lookup]]:
    """One or two trees of frames whose transforms come out of order, and questions within and beyond their stamps."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.integers(2, 8))
    named = [f"f{index}" for index in range(count)]
    sent = []
    stamps = st.integers(1, 12_000_000_000)
    for index in range(1, count):
        parent = draw(st.sampled_from([*named[:index], "elsewhere"]))
        static = draw(st.booleans())
        for stamp in draw(st.lists(stamps, min_size=1, max_size=1 if static else 6)):
            place, turned = rng.normal(size=3), Rotation.random(rng=rng).as_quat()
            sent.append((tf_message([transform(stamp, parent, named[index], place, turned)]), static))
    known = sorted(
        {
            name
            for message, _ in sent
            for one in message.transforms
            for name in (one.child_frame_id, one.header.frame_id)
        }
    )
    at = st.one_of(stamps, st.sampled_from([stamp_ns(message.transforms[0].header) for message, _ in sent]))
    lookups = draw(st.lists(st.tuples(st.sampled_from(known), st.sampled_from(known), at), min_size=1, max_size=20))
    return sent, lookups


@settings(max_examples=200)
@given(asked=_trees())
def test_our_buffer_answers_as_tf2_does(tf2: Ask, asked: tuple[list[tuple[Any, bool]], list[Lookup]]) -> None:
    sent, lookups = asked
    # what is more than ten seconds older than the newest restarts our buffer, and is refused by tf2
    newest: dict[str, int] = {}
    kept = []
    for message, static in sent:
        one = message.transforms[0]
        stamp = stamp_ns(one.header)
        if stamp >= newest.get(one.child_frame_id, 0) - 10_000_000_000:
            newest[one.child_frame_id] = max(stamp, newest.get(one.child_frame_id, 0))
            kept.append((message, static))
    buffer = TransformBuffer()
    for message, static in kept:
        buffer.add(message, static=static)
    for lookup, theirs in zip(lookups, tf2(kept, lookups), strict=True):
        ours = _ours(buffer, lookup)
        if ours == "no path":  # on the way to there being none, tf2 may meet a moment that is not known
            assert theirs in ("no path", "extrapolation"), lookup
        elif isinstance(theirs, str) or isinstance(ours, str):
            assert ours == theirs, lookup
        else:
            _assert_pose(ours, theirs[0], Rotation.from_quat(theirs[1]))
