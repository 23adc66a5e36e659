"""``steadypose export``: cleaned motion for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from steadypose.nodes.commands.output import check_output
from steadypose.nodes.graph.extras import require_extra
from steadypose.nodes.graph.settings import LaunchError
from steadypose.prior.body.avatars import NAMES

FORMATS = (".bvh", ".glb", ".vrma", ".csv", ".trc")
NAMED = (".bvh", ".glb")
"""those in which joints may have the names of another rig"""


def export(
    source: Annotated[Path, tyro.conf.arg(name="in", metavar="IN")],
    out: Annotated[Path, tyro.conf.arg(metavar="OUT")],
    body: Annotated[int | None, tyro.conf.arg(metavar="ID")] = None,
    names: Literal["smpl22", "vrm", "mixamo"] = "smpl22",
    force: bool = False,
) -> int:
    """Write cleaned motion for other programs: .bvh, .glb, .vrma, .csv or .trc, by the name of OUT.

    One body, in the world (its floor at 0), at the rate of the input's stamps, its bones of constant length, moved by
    the rotations that 'clean' found; the rest pose is a T.
      .bvh   animation programs: centimetres, y up, facing +z
      .glb   Blender, Unity, Unreal, browsers: animated bones with a skin; metres, y up (extra 'export')
      .vrma  any VRM avatar: three-vrm, UniVRM, VRM Posing Desktop (extra 'export')
      .csv   spreadsheets, and steadypose itself: metres, z up, and quaternions xyzw
      .trc   OpenSim: markers at the joints; millimetres, y up

    Try:
      steadypose clean take.npz clean.npz && steadypose export clean.npz take.bvh
      steadypose export my_recording take.glb --body 2

    Args:
        source: what 'steadypose clean' or 'run --record' has written: a recording with pose/world, or .npz.
        out: the file to make.
        names: of the joints in .bvh and .glb: those of the rig that the motion is for.
        body: id of the body, of several; that which is there longest unless given.
        force: replace what is at OUT.
    """
    check_output(source, out)
    if out.suffix not in FORMATS:
        raise LaunchError(f"{out}: expected a name ending in {', '.join(FORMATS)}, got {out.suffix or 'none'}")
    if names != "smpl22" and out.suffix not in NAMED:
        raise LaunchError(f"--names {names}: expected OUT to end in {' or '.join(NAMED)}, got {out.suffix}")
    if out.exists() and not force:
        raise LaunchError(f"{out} exists: expected a new path, or --force to replace it")
    if not source.exists():
        raise LaunchError(f"{source} does not exist: expected a recording with pose/world, or an .npz of 'clean'")
    if out.suffix in (".glb", ".vrma"):
        require_extra("export")
    # scipy, after it is known that there is something to do
    from steadypose.nodes.sinks.files.bvh import to_bvh
    from steadypose.nodes.sinks.files.motion import read_motion
    from steadypose.nodes.sinks.files.tables import to_csv, to_trc

    motion = read_motion(source, body)
    if out.suffix in (".glb", ".vrma"):
        from steadypose.nodes.sinks.files.glb import to_glb, to_vrma

        content = to_glb(motion, NAMES[names]) if out.suffix == ".glb" else to_vrma(motion)
    elif out.suffix == ".bvh":
        content = to_bvh(motion, NAMES[names])
    else:
        content = {".csv": to_csv, ".trc": to_trc}[out.suffix](motion)
    partial = out.with_name(f".{out.name}.part")
    partial.write_bytes(content)
    partial.replace(out)
    length = f"{len(motion.root)} frames at {motion.fps:g} Hz"
    Console(stderr=True).print(f"{out}: {length}", highlight=False, markup=False, soft_wrap=True)
    return 0
