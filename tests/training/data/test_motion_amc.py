"""ASF/AMC against a hand-written walk down the bones."""

from __future__ import annotations

import numpy as np
import pytest
from tests.training.data.test_motion_bvh import turn

from steadypose.prior.mocap.clip import MotionError
from steadypose.training.data.cmu import read_amc, read_asf

ASF = """# comment
:version 1.10
:name test
:units
  mass 1.0
  length 0.45
  angle deg
:root
  order TX TY TZ RX RY RZ
  axis XYZ
  position 0 0 0
  orientation 0 0 0
:bonedata
  begin
    id 1
    name femur
    direction 0 -1 0
    length 7.0
    axis 0 0 20 XYZ
    dof rx ry rz
    limits (-160.0 20.0)
           (-70.0 70.0)
           (-60.0 70.0)
  end
  begin
    id 2
    name tibia
    direction 0.6 -0.8 0
    length 8.0
    axis 10 20 30 XYZ
    dof rx
    limits (-10.0 170.0)
  end
  begin
    id 3
    name foot
    direction 0 0 1
    length 2.0
    axis 0 0 0 XYZ
  end
:hierarchy
  begin
    root femur
    femur tibia
    tibia foot
  end
"""
AMC = """#!OML:ASF test
:FULLY-SPECIFIED
:DEGREES
1
root 1 2 3 10 20 30
femur -5 15 25
tibia 40
2
root 1 2 4 0 0 90
femur 0 0 0
tibia 0
"""
UNIT = 0.0254 / 0.45


def turn_xyz(x: float, y: float, z: float) -> np.ndarray:
    """About the fixed x axis first, then y, then z."""
    return turn("Z", z) @ turn("Y", y) @ turn("X", x)


def test_positions_are_those_of_hand_written_kinematics() -> None:
    skeleton = read_asf(ASF.replace("\n", "\r\n"))
    assert skeleton.joints == ("root", "femur", "tibia", "foot")
    positions = read_amc(AMC.replace("\n", "\r\n"), skeleton)

    frames = [((1, 2, 3), (10, 20, 30), (-5, 15, 25), 40), ((1, 2, 4), (0, 0, 90), (0, 0, 0), 0)]
    for got, (at, root, femur, tibia) in zip(positions, frames, strict=True):
        world = turn_xyz(*root)
        place = np.array(at) * UNIT
        expected = [place]
        for direction, length, axis, angles in (
            ((0, -1, 0), 7, (0, 0, 20), femur),
            ((0.6, -0.8, 0), 8, (10, 20, 30), (tibia, 0, 0)),
            ((0, 0, 1), 2, (0, 0, 0), (0, 0, 0)),
        ):
            frame = turn_xyz(*axis)
            world = world @ frame @ turn_xyz(*angles) @ frame.T
            place = place + world @ np.array(direction) * length * UNIT
            expected.append(place)
        np.testing.assert_allclose(got, expected, atol=1e-9)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda t: t.replace("angle deg", "angle rad"), "degrees"),
        (lambda t: t.replace(":hierarchy", ":other"), "section ':hierarchy'"),
        (lambda t: t.replace("order TX TY TZ RX RY RZ", "order TX TY TZ"), "six freedoms"),
        (lambda t: t.replace("root femur", "root thigh"), "not known"),
        (lambda t: t.replace("length 7.0", "length long"), "expected numbers"),
        (lambda t: t.replace("length 7.0", ""), "bone cannot be read"),
    ],
)
def test_what_is_no_skeleton_is_refused_in_words(spoil, message: str) -> None:
    with pytest.raises(MotionError, match=message):
        read_asf(spoil(ASF))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda t: "", "expected frames"),
        (lambda t: t.replace("tibia 0", ""), "cut or mixed"),
        (lambda t: t.replace("tibia", "fibula"), "bone 'tibia': expected 1 angles"),
        (lambda t: t.replace("femur 0 0 0\ntibia 0", "tibia 0\nfemur 0 0 0"), "same place"),
        (lambda t: t.replace("tibia 40", "tibia x"), "bone 'tibia'"),
        (lambda t: t.replace("root", "boot"), "move 'root'"),
    ],
)
def test_a_motion_that_does_not_fit_is_refused_in_words(spoil, message: str) -> None:
    with pytest.raises(MotionError, match=message):
        read_amc(spoil(AMC), read_asf(ASF))
