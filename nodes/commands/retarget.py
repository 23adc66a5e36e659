"""``steadypose retarget``: a recording's person as a robot's motion, offline, with the sink's own code."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from steadypose.msgs.types import PoseRaw, PoseWorld
from steadypose.nodes.commands.output import check_output, check_replaceable, unfinished
from steadypose.nodes.driving import stream
from steadypose.nodes.graph.extras import require_extra
from steadypose.nodes.graph.settings import LaunchError
from steadypose.nodes.sources.recording import open_recording

ROOT = ("root_x", "root_y", "root_z", "root_qx", "root_qy", "root_qz", "root_qw")


def retarget(
    source: Annotated[Path, tyro.conf.arg(metavar="IN")],
    out: Path,
    urdf: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    links: Annotated[tuple[str, ...], tyro.conf.arg(name="link", metavar="PART=LINK")] = (),
    sole: float = 0.0,
    body: int | None = None,
    force: bool = False,
) -> int:
    """Clean a recording, and write the motion of a robot that does what its person does.

    Joints keep to the ranges and speeds of the URDF, feet that stand stay where they are. Of several people one is
    followed at a time.

    Try:
      steadypose retarget sim_data/walk_turn walk.csv --urdf launch/robots/humanoid29.urdf

    Args:
        source: a recording, a .csv, or .npz, as for `steadypose clean`.
        out: .csv with a row a frame: seconds, root (metres, xyzw), joints in radians; or .npz with stamp_ns (T,), root
            (T, 7), joints (T, N), joint_names (N,) and stands (T, 2), whether the left and the right foot do.
        urdf: the robot's.
        links: the link that plays a part of the body, such as left_foot=l_sole, where its name does not tell. May be
            given again.
        sole: metres from the floor to the origins of the foot links, when they stand.
        body: the id of the one to follow; the first who is there unless given.
        force: replace what is at OUT.
    """
    if out.suffix not in (".csv", ".npz"):
        raise LaunchError(f"expected OUT to end in .csv or .npz, got {out}")
    if urdf is None:
        raise LaunchError("expected --urdf FILE, the robot's; launch/robots/humanoid29.urdf is one to try with")
    check_output(source, out)
    if not (force and out.is_file()):
        check_replaceable(out, replace=False)
    require_extra("retarget")
    from steadypose.nodes.graph.prior_node import make_prior
    from steadypose.nodes.graph.threads import one_thread
    from steadypose.nodes.graph.trajectory_node import make_trajectory
    from steadypose.nodes.sinks.retarget.follower import Follower
    from steadypose.nodes.sinks.retarget.retargeter import Retargeter
    from steadypose.nodes.sinks.retarget.robot import load_robot

    given = {}
    for link in links:
        part, separator, name = link.partition("=")
        if not separator:
            raise LaunchError(f"--link: expected PART=LINK, such as left_foot=l_sole, got {link!r}")
        given[part] = name
    one_thread()
    robot = load_robot(urdf, given)
    follower = Follower(Retargeter(robot, sole), body)
    frames = 0
    poses = []
    for _, message in stream(open_recording(source), make_prior({}), make_trajectory({})):
        frames += isinstance(message, PoseRaw) and not message.end_of_stream
        if isinstance(message, PoseWorld) and (pose := follower.process(message)) is not None:
            poses.append(pose)
    if not poses:
        whom = "nobody" if body is None else f"no body {body}"
        raise LaunchError(
            f"{source}: {whom} to follow in {frames} frames; `steadypose info {source}` says who is there"
        )
    stamp_ns, root, joints, stands = (np.array(column) for column in zip(*poses, strict=True))
    with unfinished(out) as part:
        if out.suffix == ".npz":
            np.savez(
                part, stamp_ns=stamp_ns, root=root, joints=joints, stands=stands, joint_names=np.array(robot.joints)
            )
        else:
            table = np.column_stack([(stamp_ns - stamp_ns[0]) / 1e9, root, joints])
            np.savetxt(part, table, "%.6f", ",", header=",".join(["time", *ROOT, *robot.joints]), comments="")
        part.replace(out)
    print(f"{out}: {len(poses)} frames of {len(robot.joints)} joints")
    return 0
