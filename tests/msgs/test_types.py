import dataclasses
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg
from scipy.spatial.transform import Rotation
from tests.helpers.msg_strategies import EXAMPLES, clean, diagnostics, raw, world

from steadypose.msgs.codec import DEFINITIONS
from steadypose.msgs.types import CONTACTS, JOINTS, EventKind, Hand, JointState, Phase, Pose, RawBody, Tracking


@pytest.mark.parametrize(("message", "field", "value", "start"), [
    (raw().bodies[0], "positions", np.zeros((17, 3)), "confidence: expected shape (17,), got shape (32,)"),
    (raw().bodies[0], "positions", np.zeros(96), "positions: expected shape (J, 3), got shape (96,)"),
    (raw().bodies[0], "confidence", ["sure"] * 32, "confidence: expected float32 numbers"),
    (raw().bodies[0], "id", 2**31, "id: expected an integer of"),
    (raw().bodies[0], "id", "1", "id: expected an integer, got '1'"),
    (raw(), "stamp_ns", -1, "stamp_ns: expected an integer of 0 or more"),
    (raw(), "stamp_ns", 1.5, "stamp_ns: expected an integer, got 1.5"),
    (raw(), "stamp_ns", 2**31 * 10**9, "stamp_ns: expected an integer"),
    (raw(), "skeleton", None, "skeleton: expected a string, got None"),
    (raw(), "bodies", clean().bodies, "bodies: expected a list of RawBody"),
    (raw(), "bodies", tuple(raw().bodies), "bodies: expected a list of RawBody"),
    (clean(), "delay_frames", -1, "delay_frames: expected an integer of 0 or more"),
    (clean().bodies[0], "positions", np.zeros((21, 3)), "positions: expected shape (22, 3), got shape (21, 3)"),
    (clean().bodies[0], "rotations", np.zeros((22, 3)), "rotations: expected shape (22, 4)"),
    (clean().bodies[0], "state", np.full(22, 4), "state: expected JointState values, 0 to 3"),
    (clean().bodies[0], "state", np.full(22, 256), "state: expected JointState values"),
    (clean().bodies[0], "anomaly", None, "anomaly: expected a number, got None"),
    (world().bodies[0], "covariance", np.eye(3), "covariance: expected shape (6, 6)"),
    (world().bodies[0], "contacts", np.zeros(9), "contacts: expected shape (8,)"),
    (world().bodies[0], "tracking", 3, "tracking: expected an integer of 0 or more and under 3, got 3"),
    (world(), "ground_plane", [0, 0, 1], "ground_plane: expected shape (4,)"),
    (diagnostics(), "level", 4, "level: expected an integer"),
    (diagnostics(), "values", {"rate": 30.0}, "values: expected strings"),
    (Pose.identity(), "orientation", np.eye(3), "orientation: expected shape (4,), got shape (3, 3)"),
])  # fmt: skip
def test_a_wrong_field_is_named(message: Any, field: str, value: object, start: str):
    with pytest.raises(ValueError, match="expected") as caught:
        dataclasses.replace(message, **{field: value})
    assert str(caught.value).startswith(f"{type(message).__name__}.{start}")


def test_arrays_get_their_type_from_lists_and_integers():
    body = RawBody(np.int64(3), [[1, 2, 3]], [1])  # type: ignore[arg-type]
    assert body.positions.dtype == body.confidence.dtype == np.float32
    assert type(body.id) is int
    assert type(world().bodies[0].tracking) is Tracking


@pytest.mark.parametrize("message", EXAMPLES.values(), ids=EXAMPLES)
def test_equality_is_by_value(message: Any):
    assert message == dataclasses.replace(message)
    assert message != dataclasses.replace(message, stamp_ns=1)
    assert message != "something else"


def test_nan_equals_nan_and_nothing_else():
    body = clean().bodies[0]
    assert np.isnan(body.raw_positions).all()
    assert body == dataclasses.replace(body, anomaly=0.5)
    assert dataclasses.replace(body, anomaly=np.nan) == dataclasses.replace(body, anomaly=np.nan)
    assert dataclasses.replace(body, anomaly=np.nan) != body
    assert dataclasses.replace(body, raw_positions=np.zeros((22, 3))) != body


@pytest.mark.parametrize(("up", "axis"), [("z", [0, 0, 1]), ("y", [0, 1, 0]), ("-y", [0, -1, 0])])
def test_from_up_turns_about_x_and_brings_the_axis_to_the_worlds_z(up: str, axis: list[int]):
    pose = Pose.from_up(up)
    turn = Rotation.from_quat(pose.orientation)
    np.testing.assert_allclose(turn.apply([axis, [1, 0, 0]]), [[0, 0, 1], [1, 0, 0]], atol=1e-12)
    assert not pose.position.any()
    for other in ("x", "-z", "Y", ""):
        with pytest.raises(ValueError, match=rf"expected one of 'z', 'y', '-y', got '{other}'"):
            Pose.from_up(other)


def test_the_definitions_name_joints_and_states_alike():
    body = constants("CleanBody")
    assert [body[name.upper()] for name in JOINTS] == list(range(22))
    assert constants("CleanBody", "STATE_") == {state.name: state.value for state in JointState}
    assert constants("WorldBody", "TRACKING_") == {tracking.name: tracking.value for tracking in Tracking}
    assert set(CONTACTS) < set(JOINTS)
    names = {one.name: one.value for kind in (EventKind, Phase) for one in kind}
    assert constants("Event") == names | {f"HAND_{hand.name}": hand.value for hand in Hand}


def constants(name: str, prefix: str = "") -> dict[str, Any]:
    """Values of a definition's constants with this prefix, by the rest of their names."""
    declared = get_types_from_msg((DEFINITIONS / f"{name}.msg").read_text(), name)[f"msg/{name}"][0]
    return {constant.removeprefix(prefix): value for constant, _, value in declared if constant.startswith(prefix)}
