"""Motion capture of a leg or an arm, in files as small as can be: what readers are tried on, whole and damaged."""

import io
from collections.abc import Sequence
from typing import Any

import numpy as np

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


def bvh_text(order: str = "ZYX", frames: Sequence[Sequence[float]] = ((0.0,) * 12,)) -> str:
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
Frame Time: 0.04
{rows}
"""


def npz(**arrays: Any) -> io.BytesIO:
    file = io.BytesIO()
    np.savez(file, **arrays)
    file.seek(0)
    return file
