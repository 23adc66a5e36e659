import contextlib
import dataclasses
import struct
import tracemalloc
from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore
from tests.helpers.msg_strategies import ANY, EXAMPLES, clean, diagnostics, raw

from steadypose.msgs.codec import ROS_DEFINITIONS, DecodeError, decode, encode, typestore, wire_type
from steadypose.msgs.topics import DIAGNOSTICS, POSE_CLEAN, POSE_RAW, POSE_WORLD, TOPICS
from steadypose.msgs.types import Diagnostics, Message, PoseEvents

PAYLOADS = {topic: encode(message) for topic, message in EXAMPLES.items()}
TOPIC_NAMES = st.sampled_from(list(TOPICS))


@given(ANY)
@settings(max_examples=30)
def test_round_trip(sent: tuple[str, Message]):
    topic, message = sent
    assert decode(topic, encode(message)) == message


@pytest.mark.parametrize("topic", TOPICS)
def test_the_other_byte_order_is_read_too(topic: str):
    store, name = typestore(), wire_type(TOPICS[topic])
    big_endian = store.serialize_cdr(store.deserialize_cdr(PAYLOADS[topic], name), name, little_endian=False)
    assert bytes(big_endian[:2]) == b"\0\0"
    assert decode(topic, bytes(big_endian)) == EXAMPLES[topic]


@pytest.mark.parametrize("name", ROS_DEFINITIONS)
@pytest.mark.parametrize("store", [Stores.ROS2_HUMBLE, Stores.LATEST])
def test_messages_of_ros_are_what_ros_says_they_are(name: str, store: Stores):
    assert typestore().hash_rihs01(name) == get_typestore(store).hash_rihs01(name)


def test_what_is_decoded_owns_its_arrays_and_what_is_not_contiguous_is_encoded_by_value() -> None:
    payload = bytearray(PAYLOADS[POSE_CLEAN])
    message = decode(POSE_CLEAN, memoryview(payload))
    payload[:] = bytes(len(payload))
    assert message == clean()
    message.bodies[0].positions[0] = 5  # type: ignore[union-attr]
    message = raw()
    message.bodies[0].positions = np.asfortranarray(message.bodies[0].positions)
    message.bodies[0].confidence = np.ones(64, np.float32)[::2]
    assert decode(POSE_RAW, encode(message)) == raw()


@given(st.data(), TOPIC_NAMES)
@settings(max_examples=120)
def test_mutated_messages_are_refused_or_read(data: st.DataObject, topic: str):
    payload = bytearray(PAYLOADS[topic])
    for _ in range(data.draw(st.integers(1, 8))):
        at = data.draw(st.integers(0, len(payload) - 1))
        new = data.draw(st.binary(min_size=1, max_size=8))
        payload[at : at + (len(new) if data.draw(st.booleans()) else 0)] = new
    with contextlib.suppress(DecodeError):
        assert type(decode(topic, bytes(payload))) is TOPICS[topic]


@pytest.mark.parametrize("topic", TOPICS)
def test_truncated_messages_are_refused(topic: str):
    payload = PAYLOADS[topic]
    for size in range(len(payload)):
        with pytest.raises(DecodeError, match=f"{topic}: {size} bytes are not a "):
            decode(topic, payload[:size])


@pytest.mark.parametrize("claimed", [2**31 - 1, 2**31, 2**32 - 1])
@pytest.mark.parametrize("what", ["positions", "confidence", "bodies", "source", "values"])
def test_a_hostile_length_allocates_nothing(what: str, claimed: int):
    topic, payload, at = _length_field(what)
    hostile = payload[:at] + struct.pack("<I", claimed) + payload[at + 4 :]
    tracemalloc.start()
    try:
        with pytest.raises(DecodeError):
            decode(topic, hostile)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 2**20


def _length_field(what: str) -> tuple[str, bytes, int]:
    message = raw(joints=32)
    body = message.bodies[0]
    start = {
        "positions": struct.pack("<I", 96) + body.positions.tobytes(),
        "confidence": struct.pack("<I", 32) + body.confidence.tobytes(),
        "bodies": struct.pack("<IiI", 1, body.id, 96),
        "source": struct.pack("<I", 5) + b"test\0",
        "values": struct.pack("<I", 2) + struct.pack("<I", 5) + b"rate\0",
    }[what]
    topic, payload = (DIAGNOSTICS, encode(diagnostics())) if what == "values" else (POSE_RAW, encode(message))
    assert payload.count(start) == 1
    return topic, payload, payload.index(start)


def test_what_decodes_and_is_no_message_is_refused():
    message = raw(joints=4)
    message.bodies[0].confidence = np.ones(3, np.float32)
    nanoseconds = bytearray(PAYLOADS[POSE_RAW])
    struct.pack_into("<I", nanoseconds, 8, 10**9)
    store, name = typestore(), wire_type(TOPICS[DIAGNOSTICS])
    array = store.deserialize_cdr(PAYLOADS[DIAGNOSTICS], name)
    array.status *= 2  # type: ignore[attr-defined]
    for topic, payload, match in (
        (POSE_RAW, encode(message), r"RawBody.confidence: expected shape \(4,\), got shape \(3,\)"),
        (POSE_RAW, bytes(nanoseconds), "nanosec"),
        (DIAGNOSTICS, bytes(store.serialize_cdr(array, name)), "status: expected one, got 2"),
        ("pose/row", PAYLOADS[POSE_RAW], "unknown topic 'pose/row': expected one of pose/raw"),
    ):
        with pytest.raises(DecodeError, match=match):
            decode(topic, payload)


@pytest.mark.parametrize("topic", TOPICS)
def test_more_than_a_message_may_hold_is_refused_before_it_is_decoded(topic: str):
    """A valid message of a million bytes, of bodies of nothing, would keep a node busy for seconds."""
    example: Any = EXAMPLES[topic]
    if isinstance(example, Diagnostics):
        fits, large = (dataclasses.replace(example, values={str(k): "" for k in range(n)}) for n in (1000, 1001))
    elif isinstance(example, PoseEvents):
        fits, large = (dataclasses.replace(example, events=example.events[:1] * n) for n in (2048, 2049))
    else:
        fits, large = (dataclasses.replace(example, bodies=example.bodies[:1] * n) for n in (128, 129))
    assert decode(topic, encode(fits)) == fits
    for payload in (encode(large), encode(large)[:300]):  # no more than counted is looked at
        with pytest.raises(DecodeError, match="expected at most"):
            decode(topic, payload)


ORIENTATION = np.array([0.1, -0.2, 0.3, 0.9])
"""x, y, z, w: no two alike, so that no order is another's."""


@pytest.mark.parametrize("field", ["frame_id", "source", "skeleton"])
def test_a_name_has_a_limit(field: str):
    for size in (1024, 1025):
        payload = encode(dataclasses.replace(raw(), **{field: "n" * size}))
        with pytest.raises(DecodeError, match="at most 1024 bytes, got 1025") if size > 1024 else nullcontext():
            decode(POSE_RAW, payload)


@pytest.mark.parametrize("topic", [POSE_RAW, POSE_CLEAN, POSE_WORLD])
def test_a_quaternion_of_ros_has_its_names_in_our_order(topic: str):
    store, name = typestore(), wire_type(TOPICS[topic])
    wire = store.deserialize_cdr(PAYLOADS[topic], name)
    pose = wire.bodies[0].root_pose if topic == POSE_WORLD else wire.sensor_pose  # type: ignore[attr-defined]
    quaternion = pose.orientation
    quaternion.x, quaternion.y, quaternion.z, quaternion.w = ORIENTATION.tolist()
    message = decode(topic, bytes(store.serialize_cdr(wire, name)))
    read = message.bodies[0].root_orientation if topic == POSE_WORLD else message.sensor_pose.orientation  # type: ignore[union-attr]
    assert read.tolist() == ORIENTATION.tolist()
    assert encode(message) == bytes(store.serialize_cdr(wire, name))
