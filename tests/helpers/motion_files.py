"""Motion capture of a leg, in files as small as can be: what readers are tried on, whole and damaged."""

from __future__ import annotations

import io

import numpy as np

BVH = """HIERARCHY
ROOT Hips
{
 OFFSET 0 0 0
 CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
 JOINT Leg
 {
  OFFSET 0 -1 0
  CHANNELS 3 Zrotation Xrotation Yrotation
  End Site
  {
   OFFSET 0 -1 0
  }
 }
}
MOTION
Frames: 2
Frame Time: 0.0333333
0 1 0 0 0 0 10 0 0
0 1 0 0 0 5 20 0 0
"""
ASF = """:units
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
  name leg
  direction 0 -1 0
  length 5
  axis 0 0 20 XYZ
  dof rx
 end
:hierarchy
 begin
  root leg
 end
"""
AMC = ":FULLY-SPECIFIED\n:DEGREES\n1\nroot 0 1 0 0 0 0\nleg 10\n2\nroot 0 1 0 0 0 5\nleg 20\n"


def amass() -> bytes:
    """Three frames of the rest pose, as AMASS has them."""
    file = io.BytesIO()
    np.savez(file, poses=np.zeros((3, 66)), trans=np.zeros((3, 3)), mocap_framerate=30.0)
    return file.getvalue()
