"""``steadypose export`` and ``retarget``: cleaned motion for other programs, and for robots."""

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from rich.progress import Progress

from steadypose import PACKAGE
from steadypose.msgs.topics import POSE_WORLD
from steadypose.msgs.types import PoseWorld
from steadypose.nodes.commands import output
from steadypose.nodes.commands.output import File, In, Out
from steadypose.nodes.driving import OfflineRun
from steadypose.nodes.extras import require_extra
from steadypose.nodes.settings import STREAMS, LaunchError, located
from steadypose.nodes.sources.recording import open_recording
from steadypose.prior.body.skeleton import AVATAR_NAMES

FORMATS = (".bvh", ".glb", ".vrma", ".csv", ".trc")
NAMED = (".bvh", ".glb")  # those in which joints may have the names of another rig


def export(
    source: In,
    out: Out,
    body: Annotated[int | None, tyro.conf.arg(metavar="ID")] = None,
    names: Literal["smpl22", "vrm", "mixamo"] = "smpl22",
    force: bool = False,
) -> int:
    """Write cleaned motion as a file for other programs. The ending of OUT chooses the format.

    The file holds one person, in the world frame (floor at 0 if the sensor's pose is calibrated), at the input's frame
    rate. Bone lengths are constant, the rotations are those of 'clean', the body is placed by all its joints, and the
    rest pose is a T-pose.
      .bvh   animation programs: centimetres, y up; who faces the camera faces +z
      .glb   Blender, Unity, Unreal, browsers: a body with bones; metres, y up
      .vrma  VRM avatars: three-vrm, UniVRM, VRM Posing Desktop
      .csv   spreadsheets, and steadypose itself: metres, z up, and quaternions xyzw
      .trc   OpenSim: markers at the joints; millimetres, y up
    .glb and .vrma need the extra 'export'.

    Try:
      steadypose clean walk_turn clean.npz       a bundled recording
      steadypose export clean.npz walk.bvh
      steadypose export cleaned walk.glb --body 2   of several people

    Args:
        source: what 'steadypose clean' or 'run --record' wrote: a recording with pose/world, or an .npz.
        out: the file to write: .bvh, .glb, .vrma, .csv or .trc.
        names: names of the joints in .bvh and .glb: those of steadypose, VRM or Mixamo.
        body: id of the person, as 'steadypose info IN' lists them. Default: the one that is visible longest.
        force: replace OUT if it exists.
    """
    source = located(str(source), Path(), STREAMS)
    output.check_file(source, out, FORMATS, replace=force)
    if names != "smpl22" and out.suffix not in NAMED:
        raise LaunchError(f"--names {names}: expected OUT to end in {' or '.join(NAMED)}, got {out.suffix}")
    if not source.exists():
        raise LaunchError(f"{source} does not exist: expected a recording with pose/world, or an .npz of 'clean'")
    if source.is_file() and source.suffix not in (".npz", ".mcap"):
        remedy = f"clean it first: steadypose clean {source} {source.with_suffix('.npz').name}"
        got = source.suffix or "a file"
        raise LaunchError(f"{source}: expected a recording with pose/world, or an .npz of 'clean', got {got}; {remedy}")
    if out.suffix in (".glb", ".vrma"):
        require_extra("export")
    # scipy, after it is known that there is something to do
    from steadypose.nodes.sinks.motion_files import read_motion, to_bvh, to_csv, to_trc

    motion = read_motion(source, body)
    if out.suffix in (".glb", ".vrma"):
        from steadypose.nodes.sinks.glb import to_glb, to_vrma

        content = to_glb(motion, AVATAR_NAMES[names]) if out.suffix == ".glb" else to_vrma(motion)
    elif out.suffix == ".bvh":
        content = to_bvh(motion, AVATAR_NAMES[names])
    else:
        content = {".csv": to_csv, ".trc": to_trc}[out.suffix](motion)
    with output.unfinished(out) as part:
        part.write_bytes(content)
    output.console().print(f"{out}: {output.plural(len(motion.root), 'frame')} at {motion.fps:g} Hz")
    return 0


ROOT = ("root_x", "root_y", "root_z", "root_qx", "root_qy", "root_qz", "root_qw")


def retarget(
    source: In,
    out: Out,
    urdf: File = None,
    links: Annotated[tuple[str, ...], tyro.conf.arg(name="link", metavar="PART=LINK")] = (),
    sole: float = 0.0,
    body: Annotated[int | None, tyro.conf.arg(metavar="ID")] = None,
    force: bool = False,
) -> int:
    """Clean a recording, and convert the person's motion to that of a robot.

    Joints respect the position and velocity limits of the URDF, and standing feet are held in place. If there are
    several people, the robot follows one at a time. The exit status is 1 if OUT cannot be trusted, as for `clean`.

    Try:
      steadypose retarget walk_turn walk.csv --urdf launch/robots/humanoid29.urdf

    Args:
        source: a recording, .csv or .npz, as for `steadypose clean`.
        out: .csv with one row per frame: seconds, root (metres, xyzw), joints in radians; or .npz with stamp_ns (T,),
            root (T, 7), joints (T, N), joint_names (N,) and stands (T, 2), true while the left or right foot stands.
        urdf: URDF file of the robot.
        links: link of a body part, such as left_foot=l_sole, if its name is not recognised. Repeatable.
        sole: height in metres of the foot links' origins above the floor while the robot stands.
        body: id of the person to follow. Default: the first one visible.
        force: replace OUT if it exists.
    """
    output.check_file(source, out, output.ARRAY_FILES, replace=force)
    if urdf is None:
        example = PACKAGE / "launch" / "robots" / "humanoid29.urdf"
        raise LaunchError(f"expected --urdf FILE, the robot's; {example} is one to try with")
    require_extra("retarget")
    from steadypose.nodes.sinks.retarget import Follower, Retargeter
    from steadypose.nodes.sinks.robot import load_robot

    given = {}
    for link in links:
        part, separator, name = link.partition("=")
        if not separator:
            raise LaunchError(f"--link: expected PART=LINK, such as left_foot=l_sole, got {link!r}")
        given[part] = name
    recording = open_recording(source)
    run = OfflineRun(recording, {"prior": {}, "trajectory": {}})
    robot = load_robot(urdf, given)
    follower = Follower(Retargeter(robot, sole), body)
    poses = []
    terminal = output.console()
    with Progress(console=terminal, disable=not terminal.is_terminal) as progress:
        bar = progress.add_task(source.name, total=len(recording))
        for topic, message in run:
            progress.update(bar, completed=run.diagnosis.frames)
            # a simulated recording also has its truth, as PoseWorld
            world = message if topic == POSE_WORLD and isinstance(message, PoseWorld) else None
            if world and (pose := follower.process(world)) is not None:
                poses.append(pose)
    output.print_faults(terminal, {}, run.diagnosis.texts)
    if not poses:
        whom, frames = "nobody" if body is None else f"no body {body}", output.plural(run.diagnosis.frames, "frame")
        raise LaunchError(f"{source}: {whom} to follow in {frames}; `steadypose info {source}` says who is there")
    stamp_ns, root, joints, stands = (np.array(column) for column in zip(*poses, strict=True))
    with output.unfinished(out) as part:
        if out.suffix == ".npz":
            names = np.array(robot.joints)
            np.savez(part, stamp_ns=stamp_ns, root=root, joints=joints, stands=stands, joint_names=names)
        else:
            table = np.column_stack([(stamp_ns - stamp_ns[0]) / 1e9, root, joints])
            np.savetxt(part, table, "%.6f", ",", header=",".join(["time", *ROOT, *robot.joints]), comments="")
    print(f"{out}: {output.plural(len(poses), 'frame')} of {len(robot.joints)} joints")
    if not run.diagnosis.trusted:
        terminal.print(f"  {output.UNTRUSTED}", style="red")
    return 0 if run.diagnosis.trusted else 1
