from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from conftest import VirtualClock, raw, walking
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tests.helpers.given import Given

from steadypose.nodes.ros2.definitions import serialise
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sinks.ros2.messages import tf_message, transform
from steadypose.nodes.sources import ros2 as module
from steadypose.nodes.sources.registry import InputSettings, open_input
from steadypose.nodes.sources.ros2 import CACHE_NS, TfSettings, TfSource, TransformBuffer, TransformError

FRAME_NS = 33_333_333


def said(stamp_ns: int, parent: str, child: str, place: Any, turned: Rotation) -> Any:
    return tf_message([transform(stamp_ns, parent, child, np.asarray(place, float), turned.as_quat())])


def matrix(place: Any, turned: Rotation) -> np.ndarray:
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = turned.as_matrix(), place
    return whole


@given(st.integers(0, 2**32 - 1), st.sampled_from(["map", "odom", "base", "camera", "arm", "tool"]), st.data())
def test_any_frame_in_any_other_is_the_product_of_matrices(seed: int, target: str, data: st.DataObject) -> None:
    tree = {"odom": "map", "base": "odom", "camera": "base", "arm": "base", "tool": "arm"}
    rng, buffer, world = np.random.default_rng(seed), TransformBuffer(), {"map": np.eye(4)}
    for child, parent in tree.items():
        place, turned = rng.normal(size=3), Rotation.from_rotvec(rng.normal(size=3))
        buffer.add(said(10, parent, child, place, turned), static=child in ("camera", "tool"))
        world[child] = world[parent] @ matrix(place, turned)
    source = data.draw(st.sampled_from(sorted(world)))
    place, quaternion = buffer.lookup(target, source, 10)
    expected = np.linalg.inv(world[target]) @ world[source]
    np.testing.assert_allclose(matrix(place, Rotation.from_quat(quaternion)), expected, atol=1e-9)


def test_between_two_stamps_it_is_interpolated_and_beyond_them_unknown() -> None:
    buffer = TransformBuffer()
    for step in range(3):
        turned = Rotation.from_euler("z", 40 * step, degrees=True)
        buffer.add(said(1000 + 100 * step, "odom", "base", [2.0 * step, 0, 0], turned), static=False)
    place, quaternion = buffer.lookup("odom", "base", 1150)
    np.testing.assert_allclose(place, [3.0, 0, 0])
    assert Rotation.from_quat(quaternion).as_euler("zyx", degrees=True)[0] == pytest.approx(60)
    for at_ns, words in ((999, "older than the oldest"), (1201, "newer than the newest")):
        with pytest.raises(TransformError, match=words):
            buffer.lookup("odom", "base", at_ns)
    with pytest.raises(TransformError, match=r"no path from 'camera' to 'odom'.*frames heard of: base, odom"):
        buffer.lookup("odom", "camera", 1100)


def test_it_forgets_what_is_old_and_begins_anew_where_time_does() -> None:
    buffer, none = TransformBuffer(), Rotation.identity()
    for stamp_ns in (CACHE_NS, CACHE_NS * 3 // 2, CACHE_NS * 5 // 2):
        buffer.add(said(stamp_ns, "odom", "base", [stamp_ns / 1e9, 0, 0], none), static=False)
    with pytest.raises(TransformError):
        buffer.lookup("odom", "base", CACHE_NS)
    buffer.add(said(5, "odom", "base", [7.0, 0, 0], none), static=False)
    assert buffer.lookup("odom", "base", 5)[0][0] == 7.0
    buffer.add(tf_message([transform(6, "odom", "base", np.full(3, np.nan), none.as_quat())]), static=False)
    assert buffer.lookup("odom", "base", 5)[0][0] == 7.0


class Robot:
    """In the place of ROS: says what the test tells it to, when it is listened to."""

    def __init__(self) -> None:
        self.heard: dict[str, Callable[[bytes], None]] = {}
        self.queue: list[tuple[str, Any]] = []

    def subscribe(
        self, topic: str, kind: str, heard: Callable[[bytes], None], *, latched: bool = False, depth: int = 10
    ) -> None:
        self.heard[topic] = heard

    def spin(self, timeout_s: float) -> None:
        for topic, message in self.queue:
            self.heard[topic](serialise(message))
        self.queue.clear()

    def close(self) -> None:
        self.heard.clear()


def test_a_message_waits_for_the_transform_of_its_stamp(clock: VirtualClock, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "check_ros", lambda: None)
    robot, frame = Robot(), raw(0, walking(0), stamp_ns=2_000)
    settings = TfSettings(fixed_frame="odom", sensor_frame="eye")
    source = TfSource(Given(frame, None, None), settings, clock, lambda _: robot)  # type: ignore[arg-type, return-value]
    frames = source.frames()
    robot.queue = [("tf_static", said(0, "base", "eye", [0, 0, 1.5], Rotation.from_euler("z", 90, degrees=True)))]
    robot.queue.append(("tf", said(1_000, "odom", "base", [0, 0, 0], Rotation.identity())))
    assert next(frames) is None, "not yet: the robot has only said where it was before"
    robot.queue = [("tf", said(3_000, "odom", "base", [4, 0, 0], Rotation.identity()))]
    found = next(frames)
    assert found
    assert found.calibrated
    np.testing.assert_allclose(found.sensor_pose.position, [2.0, 0, 1.5])
    np.testing.assert_allclose(
        Rotation.from_quat(found.sensor_pose.orientation).as_euler("zyx", degrees=True), [90, 0, 0], atol=1e-9
    )
    assert not source.problems()


def test_one_that_waits_in_vain_is_dropped_and_told(clock: VirtualClock, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "check_ros", lambda: None)
    settings = TfSettings(fixed_frame="odom")
    source = TfSource(Given(raw(0, walking(0)), None), settings, clock, lambda _: Robot())  # type: ignore[arg-type]
    frames = source.frames()
    assert next(frames) is None
    clock.time_ns += 300_000_000
    assert next(frames) is None
    assert source.refused["without a transform"] == 1
    (problem,) = source.problems()
    assert "no path from 'camera' to 'odom'" in problem.text
    assert "ROS_DOMAIN_ID" in problem.text


def test_a_recording_is_not_asked_of_tf(tmp_path: Any) -> None:
    np.savez(tmp_path / "x.npz", positions=np.zeros((3, 22, 3)), skeleton="smpl22", fps=30.0)
    settings = InputSettings(recording=str(tmp_path / "x.npz"), tf=TfSettings(fixed_frame="odom"))
    with pytest.raises(LaunchError, match="for live sources"):
        open_input(settings, VirtualClock())
