"""BVH against a forward kinematics written out by hand, joint by joint and frame by frame."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from steadypose.prior.mocap.bvh import read_bvh
from steadypose.prior.mocap.clip import MotionError

Matrix = NDArray[np.float64]


def turn(axis: str, degrees: float) -> Matrix:
    """Right-handed turn about a coordinate axis."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return {
        "X": np.array([[1, 0, 0], [0, c, -s], [0, s, c]]),
        "Y": np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]),
        "Z": np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]),
    }[axis]


def bvh_text(order: str, frames: list[list[float]], seconds: str = "0.04") -> str:
    """A root, an arm whose middle joint can shift, and a hand with two end sites. 12 numbers a frame."""
    rotation = " ".join(f"{a}rotation" for a in order)
    rows = "\n".join(" ".join(f"{v:.9f}" for v in frame) for frame in frames)
    return f"""HIERARCHY
ROOT hip
{{
  OFFSET 1 2 3
  CHANNELS 6 Xposition Yposition Zposition {rotation}
  JOINT arm
  {{
    OFFSET 0 0.5 0
    CHANNELS 6 Zposition Xposition Yposition Yrotation Xrotation Zrotation
    End Site
    {{
      OFFSET 0.3 0 0
    }}
    End Site
    {{
      OFFSET 0 0 0.2
    }}
  }}
}}
MOTION
Frames: {len(frames)}
Frame Time: {seconds}
{rows}
"""


angles = st.floats(-180, 180, width=32)
shifts = st.floats(-5, 5, width=32)


@given(
    order=st.permutations(["X", "Y", "Z"]),
    frames=st.lists(
        st.tuples(st.lists(shifts, min_size=6, max_size=6), st.lists(angles, min_size=6, max_size=6)),
        min_size=1,
        max_size=3,
    ),
)
def test_positions_are_those_of_hand_written_kinematics(
    order: list[str], frames: list[tuple[list[float], list[float]]]
) -> None:
    rows = [s[:3] + a[:3] + s[3:] + a[3:] for s, a in frames]
    bvh = read_bvh(bvh_text("".join(order), rows))

    assert bvh.joints == ("hip", "arm", "arm_end", "arm_end2")
    assert bvh.fps == pytest.approx(25)
    positions = bvh.positions()
    for (shift, angle), got in zip(frames, positions, strict=True):
        root = turn(order[0], angle[0]) @ turn(order[1], angle[1]) @ turn(order[2], angle[2])
        arm = root @ turn("Y", angle[3]) @ turn("X", angle[4]) @ turn("Z", angle[5])
        hip_at = np.array([1, 2, 3]) + shift[:3]  # at a root, added to the offset
        arm_at = hip_at + root @ [shift[4], shift[5], shift[3]]  # elsewhere, in the offset's place
        expected = [hip_at, arm_at, arm_at + arm @ [0.3, 0, 0], arm_at + arm @ [0, 0, 0.2]]
        np.testing.assert_allclose(got, expected, atol=1e-6)


def test_a_bone_that_the_converter_lost_is_put_back_only_where_it_is_lost() -> None:
    text = bvh_text("ZYX", [[0.0] * 12]).replace("OFFSET 0.3 0 0", "OFFSET 0 0 0")
    bvh = read_bvh(text)
    # The arm's own offset is along y: twice as long for one end, untouched for the other.
    mended = bvh.positions({"arm_end": 2.0, "arm_end2": 9.0})[0]
    np.testing.assert_allclose(mended[2] - mended[1], [0, 1.0, 0], atol=1e-9)
    np.testing.assert_allclose(mended[3] - mended[1], [0, 0, 0.2], atol=1e-9)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda t: t.replace("MOTION", ""), "no MOTION"),
        (lambda t: t.replace("HIERARCHY", ""), "expected HIERARCHY"),
        (lambda t: t.replace("OFFSET 1 2 3", "OFFSET 1 two 3"), "number in the hierarchy"),
        (lambda t: t.replace("}\nMOTION", "MOTION"), "braces"),
        (lambda t: t.replace("Xrotation", "Wrotation", 1), "unknown channels"),
        (lambda t: t.replace("Frames: 1", "Frames: 2"), "expected 2 frames of 12 numbers, found 12"),
        (lambda t: t.replace("Frame Time: 0.04", "Frame Time: 0"), "frame time above zero"),
        (lambda t: t[: t.rindex("0.0")] + "x", "number in the motion"),
        (lambda t: t[: t.index("JOINT")] + t[t.index("MOTION") :], "cut short"),
        (lambda t: "", "no MOTION"),
    ],
)  # fmt: skip
def test_what_is_no_bvh_is_refused_in_words(spoil, message: str) -> None:
    with pytest.raises(MotionError, match=message):
        read_bvh(spoil(bvh_text("ZYX", [[0.0] * 12])))
