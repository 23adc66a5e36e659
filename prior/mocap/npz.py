"""Motion that comes as arrays: CMU clips as exponential maps, and SMPL poses as AMASS stores them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import IO

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steadypose.prior.body.rigs import UNITS
from steadypose.prior.body.skeleton import PARENTS, REST_OFFSETS
from steadypose.prior.mocap.clip import MotionError, documented, forward
from steadypose.prior.mocap.tables import CMU_BVH
from steadypose.prior.npz import open_npz


def read_expmap(file: IO[bytes]) -> Iterator[tuple[float, str, float, NDArray[np.float64]]]:
    """CMU clips as root translations and exponential maps (``cmu_expmap.npz``).

    The archive's own positions are passed over: its offsets are those of the BVH conversion that has lost the
    thorax and a third of the forearm, which are put back here.

    Yields:
        for each clip: which share of them is read, its name, frames a second, and (T, J, 3) metres, y up, for the
        joints of the rig ``cmu_bvh``.
    """
    with open_npz(file, "names", "parents", "offsets_m", "fps") as archive:
        joints = [str(n).replace("HeadEnd", "Head_end") for n in archive["names"]]
        parents = [int(p) for p in archive["parents"]]
        offsets, fps = archive["offsets_m"].copy(), float(archive["fps"])
        for joint, multiple in CMU_BVH.lost_bones.items():
            offsets[joints.index(joint)] = multiple * offsets[parents[joints.index(joint)]]
        wanted = [joints.index(j) for j in CMU_BVH.skeleton.joints]
        names = [n.removesuffix("/expmap") for n in archive.files if n.endswith("/expmap")]
        for done, name in enumerate(names, start=1):
            values = archive[f"{name}/expmap"].astype(np.float64)
            maps = values[:, 3:].reshape(-1, 3)
            # The file's convention is row vectors; the transpose serves columns.
            local = Rotation.from_rotvec(maps).inv().as_matrix().reshape(len(values), len(joints), 3, 3)
            steps = np.tile(offsets, (len(values), 1, 1))
            steps[:, 0] = values[:, :3] * UNITS["CMU"]
            yield done / len(names), name, fps, forward(parents, steps, local)[0][:, wanted]


@documented
def read_amass(file: IO[bytes]) -> tuple[float, NDArray[np.float64]]:
    """SMPL, SMPL-H or SMPL-X poses as AMASS stores them: ``poses``, ``trans`` and the frame rate.

    No body model is used, so that its licence binds nobody: the rotations move the rest skeleton of
    `prior.body.skeleton`, a generic adult, whatever the subject's shape. Joint angles are the recording's own, bone
    lengths and the height of the root above the floor are not.

    Returns:
        frames a second, and (T, 22, 3) metres, canonical joints, z up.

    Raises:
        MotionError: an array is missing or has another shape.
    """
    with open_npz(file, "poses", "trans") as archive:
        rate = next((k for k in ("mocap_framerate", "mocap_frame_rate") if k in archive), None)
        if rate is None:
            raise MotionError("expected an array mocap_framerate (or mocap_frame_rate, as SMPL-X' files name it)")
        fps, poses = float(archive[rate]), archive["poses"].astype(np.float64)
        trans = archive["trans"].astype(np.float64)
    if poses.ndim != 2 or poses.shape[1] < 3 * len(PARENTS) or trans.shape != (len(poses), 3):
        raise MotionError(f"expected poses (T, 66 or more) and trans (T, 3), got {poses.shape} and {trans.shape}")
    maps = poses[:, : 3 * len(PARENTS)].reshape(-1, 3)
    local = Rotation.from_rotvec(maps).as_matrix().reshape(len(poses), len(PARENTS), 3, 3)
    # SMPL's rest pose faces +z with y up; ours faces +x with z up.
    steps = np.tile(REST_OFFSETS[:, [1, 2, 0]], (len(poses), 1, 1))
    steps[:, 0] = trans
    return fps, forward(PARENTS, steps, local)[0]
