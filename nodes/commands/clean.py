"""``steadypose clean``: one recording, or a folder of them."""

from __future__ import annotations

from typing import Annotated, Any

import tyro
from rich.progress import Progress

from steadypose.nodes.commands.batch import clean_folder, is_folder_of_recordings
from steadypose.nodes.commands.output import (
    File,
    In,
    Out,
    check_format,
    check_output,
    clean_recording,
    console,
    printable,
)
from steadypose.nodes.driving import NOBODY
from steadypose.nodes.graph.launch import apply_override, check_settings, full_key, pipeline_sections, read_toml
from steadypose.nodes.graph.loops import compile_missing
from steadypose.nodes.settings import LaunchError
from steadypose.prior.body.layouts import add_layouts


def clean(
    source: In,
    out: Out,
    delay: Annotated[int | None, tyro.conf.arg(metavar="K")] = None,
    settings: Annotated[tuple[str, ...], tyro.conf.arg(name="set", metavar="STAGE.OPTION=VALUE")] = (),
    skeletons: File = None,
    rig: File = None,
    jobs: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    ray: bool = False,
    force: bool = False,
) -> int:
    """Clean recorded poses: what `run` does live, offline, with the same numbers.

    A folder of recordings is cleaned into another, as many at once as there are cores, or on a Ray cluster.
    OUT/manifest.jsonl says what became of each; started again, the command does what is not done yet. A recording
    that cannot be cleaned does not stop the others. The exit status is 1 if one could not be cleaned, shows nobody, or
    is damaged so that a part of it could not be read.

    Args:
        source: a recording, a .csv, or .npz with positions (T, J, 3) in metres, skeleton, and stamp_ns (T,) or fps;
            motion, as .bvh of any rig, .trc, .c3d, AMASS' .npz or .npy; or a folder with any number of these, at any
            depth.
        out: the recording to make, or .npz or .csv with one row for each row of the input; or the folder for them.
        delay: frames at 30 Hz to wait for, 0 to 16; more is smoother. 4 unless given.
        settings: any setting of [prior] or [trajectory], such as gate.enabled=false or trajectory.contacts=false; the
            end of its name will do, where there is one such setting only. May be given again. Weights of your own
            ('steadypose train') are settings too: smooth.weights, reconstruct.weights, trajectory.weights=NAME, or the
            path of a .safetensors file.
        skeletons: TOML with [skeletons.NAME] of joint layouts of your own; a launch file with them will do.
        rig: TOML that says of files of motion what they do not: metres (the size of their unit), up, fps, skeleton (of
            arrays), and [canonical], which of their joints left_elbow and the others of smpl22 are.
        jobs: of a folder, how many recordings at once, each in a process of its own that takes about 1 GB of
            memory; as many as there are cores unless given.
        ray: clean a folder on the Ray cluster that this machine belongs to, or that RAY_ADDRESS names, or else on
            one started here; its machines must see IN and OUT under the same paths. Needs the extra 'ray'.
        force: replace what is at OUT, if it is a recording, an .npz or a .csv. In a folder, what an earlier call made
            is replaced without being asked for, and all else is kept in any case.
    """
    table: dict[str, Any] = {"prior": {}, "trajectory": {}}
    if delay is not None:
        table["prior"]["delay"] = delay
    for override in settings:
        apply_override(table, full_key(override, pipeline_sections()))
    check_settings(table)
    if skeletons is not None:
        table["skeletons"] = read_toml(skeletons).get("skeletons", {})
        add_layouts(table["skeletons"])
    if rig is not None:
        table["rig"] = read_toml(rig)
    check_format(out)
    check_output(source, out)
    terminal = console()
    compile_missing(lambda line: terminal.print(printable(line)))
    if is_folder_of_recordings(source):
        return clean_folder(source, out, table, jobs, ray, terminal)
    if ray or jobs is not None:
        raise LaunchError(f"--{'ray' if ray else 'jobs'}: expected a folder of recordings as IN; {source} is one alone")
    with Progress(console=terminal, disable=not terminal.is_terminal) as progress:
        bar = progress.add_task(source.name, total=None)
        done = clean_recording(
            source,
            out,
            table,
            replace=force,
            began=lambda frames: progress.update(bar, total=frames),
            advanced=lambda: progress.advance(bar),
        )
    spent = f"{done.duration_s:.1f} s, cleaned in {done.spent_s:.1f} s"
    terminal.print(f"{out}: {done.frames} frames, {spent}")
    for cause, count in done.refused.items():
        terminal.print(f"  refused or dropped, {cause}: {count}")
    for problem in done.problems:
        terminal.print(f"  {problem}", style="yellow")
    if not done.poses:
        terminal.print(f"  {NOBODY}; steadypose info {source} says what it holds", style="red")
    if done.unread:
        terminal.print(f"  {source} is damaged: what could be read of it is clean", style="red")
    return 1 if done.unread or not done.poses else 0
