import dataclasses
from collections.abc import Callable
from itertools import count

import numpy as np
import pytest
from conftest import first_datagram
from scipy.spatial.transform import Rotation
from tests.helpers import synthetic_poses

from steadypose.msgs.topics import POSE_TRUTH
from steadypose.msgs.types import PoseWorld
from steadypose.nodes.graph.launch import Launch
from steadypose.prior.body.skeleton import PARENTS, J

pytest.importorskip("pythonosc", reason="the extra 'vmc' is not installed")

from pythonosc.osc_bundle import OscBundle
from pythonosc.osc_message import OscMessage

from steadypose.nodes.sinks.datagrams import BONES, VmcNode, osc_bundles


def world() -> PoseWorld:
    return synthetic_poses.messages_on(POSE_TRUTH, 0.5)[-1]


def messages(bundles: list[bytes]) -> list[tuple[str, list[object]]]:
    contents = [content for data in bundles for content in OscBundle(data)]
    assert all(isinstance(content, OscMessage) for content in contents)
    return [(content.address, list(content.params)) for content in contents if isinstance(content, OscMessage)]


def test_the_bones_give_the_body_back_in_unitys_axes_and_nobody_is_said_too() -> None:
    body = world().bodies[0]
    bundles = osc_bundles(1.5, body)
    assert all(len(data) < 1400 for data in bundles)
    sent = messages(bundles)
    assert sent[:3] == [
        ("/VMC/Ext/OK", [1]), ("/VMC/Ext/T", [1.5]), ("/VMC/Ext/Root/Pos", ["root", 0, 0, 0, 0, 0, 0, 1]),
    ]  # fmt: skip
    bones = {params[0]: np.array(params[1:], dtype=float) for address, params in sent if address.endswith("Bone/Pos")}
    assert tuple(bones) == BONES
    assert BONES[J["left_elbow"]] == "LeftLowerArm"
    # as Unity places them: in left-handed axes a quaternion's product is the same
    placed, turned = np.zeros((22, 3)), [Rotation.identity()] * 22
    for joint, parent in enumerate(PARENTS):
        place, turn = bones[BONES[joint]][:3], Rotation.from_quat(bones[BONES[joint]][3:])
        placed[joint] = place if parent < 0 else placed[parent] + turned[parent].apply(place)
        turned[joint] = turn if parent < 0 else turned[parent] * turn
    right, up, forward = placed.T
    np.testing.assert_allclose(np.stack([-right, -forward, up], axis=1), body.positions, atol=1e-4)
    assert messages(osc_bundles(0.0, None)) == [("/VMC/Ext/OK", [0]), ("/VMC/Ext/T", [0.0])]


def test_a_bone_without_an_estimate_is_left_as_it_was() -> None:
    body = world().bodies[0]
    places = np.array(body.positions)
    places[J["left_foot"]] = np.nan
    sent = messages(osc_bundles(0.0, dataclasses.replace(body, positions=places)))
    assert [params[0] for address, params in sent if address.endswith("Bone/Pos")] == [
        bone for bone in BONES if bone != "LeftToes"
    ]


def test_the_node_sends_to_where_it_is_told(make_launch: Callable[..., Launch]) -> None:
    one = world()
    worlds = (dataclasses.replace(one, stamp_ns=stamp_ns) for stamp_ns in count(0, 33_333_333))
    sent = messages([first_datagram(make_launch, VmcNode, worlds)])
    assert sent[0] == ("/VMC/Ext/OK", [1]), "from the first moment on, though stamps count from 0"
