"""Shared by the viewer and the plots: colours, bones, and the transform to the world."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steadypose.msgs.types import CONTACTS, JOINTS, JointState, Pose
from steadypose.prior.body.skeleton import PARENTS, J

# Okabe and Ito's palette: distinguishable with any colour vision, on white and on black.
STATE_COLOURS: dict[JointState, str] = {
    JointState.UNKNOWN: "#8c8c8c",
    JointState.SEEN: "#10a37f",
    JointState.REFINED: "#56b4e9",
    JointState.IMPUTED: "#e8710a",
}
RAW_COLOUR = "#b9a7c9"
CLEAN_COLOUR = "#0072b2"
WORLD_COLOUR = "#c98500"
TRUTH_COLOUR = "#7f7f7f"
CONTACT_COLOUR = "#f0c808"
ALARM_COLOUR = "#d81b60"
LEFT_COLOUR, RIGHT_COLOUR, MIDDLE_COLOUR = "#0072b2", "#d55e00", "#3c3c3c"
"""Colours of a body's sides on white."""
DARK, ON_DARK = "#12141a", ("#56b4e9", "#f08c2e", "#d7dbe4")
"""Colours of a dark background, and of left, right and middle on it."""
FAINT = 0.3  # opacity of unobserved joints and bones
CONTACT_INDICES: NDArray[np.intp] = np.array([J[name] for name in CONTACTS])
"""(8,) canonical joints of the contact probabilities in ``pose/world``."""


def bones(observable: NDArray[np.bool_]) -> NDArray[np.intp]:
    """(B, 2) parent and child of the bones to draw between the canonical joints that a sensor has, ``observable``
    (22,).

    A joint that the sensor's skeleton lacks is skipped, and its children are connected to its nearest ancestor; where a
    collar is skipped, the shoulder to the neck. For a joint that is missing only temporarily, leave out its bones.
    """
    pairs = []
    for child in range(len(JOINTS)):
        parent = PARENTS[child]
        while parent >= 0 and not observable[parent]:
            parent = J["neck"] if JOINTS[parent].endswith("collar") else PARENTS[parent]
        if observable[child] and parent >= 0:
            pairs.append((parent, child))
    return np.array(pairs, dtype=np.intp).reshape(-1, 2)


ALL_BONES: NDArray[np.intp] = bones(np.ones(len(JOINTS), dtype=bool))
"""(21, 2) parent and child of each canonical bone."""
SIDES: NDArray[np.intp] = np.array([0 if "left" in name else 1 if "right" in name else 2 for name in JOINTS])
"""(22,) side of each canonical joint: 0 left, 1 right, 2 middle."""


def bone_states(state: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(21,) state of each canonical bone: that of its less certain end. UNKNOWN is the least certain."""
    doubt = np.where(state == JointState.UNKNOWN, len(JointState), state)
    worse = doubt[ALL_BONES].max(axis=1)
    return np.where(worse == len(JointState), JointState.UNKNOWN, worse).astype(np.uint8)


def to_world(positions: NDArray[np.floating], sensor_pose: Pose) -> NDArray[np.float64]:
    """Transform positions (..., 3) metres from a message's frame to the z-up world. Positions not finite become NaN."""
    rotation = Rotation.from_quat(sensor_pose.orientation)
    flat = np.where(np.isfinite(positions), positions, np.nan).astype(np.float64).reshape(-1, 3)
    return (rotation.apply(flat) + sensor_pose.position).reshape(positions.shape)


_QUARTER = Rotation.from_euler("z", 90.0, degrees=True)


def ahead(root: NDArray[np.floating], rotations: NDArray[np.floating]) -> tuple[NDArray[np.float64], ...]:
    """Turn a body's root (..., 3) and root rotation (..., 4) xyzw about the vertical, for animation programs.

    A person who faces the camera, which looks along y, then faces x, and so +z in y-up axes, which is the front in
    these programs. A y-up file is written as it was read.
    """
    return _QUARTER.apply(root), (_QUARTER * Rotation.from_quat(rotations)).as_quat()


def facing(positions: NDArray[np.floating]) -> NDArray[np.float64] | None:
    """(3,) horizontal unit vector in which the hips and shoulders of (22, 3) world joints face; None if unobserved."""
    across = np.nansum(
        [positions[J[f"left_{part}"]] - positions[J[f"right_{part}"]] for part in ("hip", "shoulder")], axis=0
    )
    forward = np.array([across[1], -across[0], 0.0])
    length = float(np.linalg.norm(forward))
    return forward / length if length > 0.05 else None
