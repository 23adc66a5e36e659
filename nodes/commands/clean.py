"""``steadypose clean``: one recording, or a folder of them."""

from typing import Annotated, Any

import tyro
from rich.progress import Progress

from steadypose.nodes.commands import output
from steadypose.nodes.commands.batch import clean_folder, is_folder_of_recordings
from steadypose.nodes.commands.output import File, In, Out
from steadypose.nodes.graph.launch import apply_override, check_settings, full_key, pipeline_sections, read_toml
from steadypose.nodes.graph.loops import compile_missing
from steadypose.nodes.settings import LaunchError, launch_errors, printable
from steadypose.prior.body.layouts import add_layouts


def clean(
    source: In,
    out: Out,
    delay: Annotated[int | None, tyro.conf.arg(metavar="K")] = None,
    settings: Annotated[tuple[str, ...], tyro.conf.arg(name="set", metavar="STAGE.OPTION=VALUE")] = (),
    skeletons: File = None,
    rig: File = None,
    events: File = None,
    jobs: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    ray: bool = False,
    force: bool = False,
) -> int:
    """Clean recorded poses offline, with the same result as `run` live.

    Given a folder, it cleans each recording in it into another folder, in parallel on all cores or on a Ray cluster.
    OUT/manifest.jsonl lists the result of each recording. If you run the command again, it does only what is left. A
    recording that cannot be cleaned does not stop the others.

    OUT is written whatever is wrong with the poses. The exit status is 1 if it cannot be trusted (units, axes, order of
    joints or rows are wrong, most frames give no pose, or there is nobody) or IN is damaged; of a folder, if this holds
    for a recording, or one cannot be cleaned.

    Try:
      steadypose clean walk_turn walk.npz             a bundled recording
      steadypose clean joints.csv clean.csv --delay 8
      steadypose clean takes/ cleaned/                all in a folder

    Args:
        source: a recording; a .csv; an .npz with positions (T, J, 3) in metres, skeleton, and stamp_ns (T,) or fps;
            motion capture (.bvh, .trc, .c3d, AMASS .npz, .npy); a folder of these, with subfolders; or one video.
        out: the result: a recording, or an .npz or .csv with one row per input row; or a folder.
        delay: frames at 30 Hz that the output lags behind, 0 to 16; more is more accurate. Default 4.
        settings: override a setting of [prior], [trajectory] or [events], such as gate.enabled=false or
            trajectory.contacts=false. A unique end of its name is enough. Repeatable. To use weights that you trained,
            set smooth.weights, reconstruct.weights or trajectory.weights to their name or .safetensors file.
        skeletons: TOML file, or launch file, with joint layouts of your own as [skeletons.NAME].
        rig: TOML file that describes motion capture which is not recognised: metres (length of its unit), up, fps,
            skeleton (of .npy), and [canonical], which names its joint for each of smpl22 (docs/sources.md).
        events: .csv file for what the people do: one row per event, with its begin and end (docs/events.md).
        jobs: for a folder, how many recordings to clean at once. Each takes 0.3 GB of memory, more if it lasts long.
            Default: the number of cores.
        ray: clean a folder on a Ray cluster: the one of this machine or of RAY_ADDRESS, or else a new local one. All
            its machines must see IN and OUT under the same paths. Needs the extra 'ray'.
        force: replace OUT if it is a recording, an .npz or a .csv, and the .csv of --events. In a folder, results of
            earlier calls are always replaced, and other files never.
    """
    table: dict[str, Any] = {"prior": {}, "trajectory": {}}
    if delay is not None:
        table["prior"]["delay"] = delay
    for override in settings:
        apply_override(table, full_key(override, pipeline_sections()))
    check_settings(table)
    if skeletons is not None:
        table["skeletons"] = read_toml(skeletons).get("skeletons")
        if not isinstance(table["skeletons"], dict):
            raise LaunchError(f"{skeletons}: expected sections [skeletons.NAME] with joints, got none")
        with launch_errors():
            add_layouts(table["skeletons"])
    if rig is not None:
        table["rig"] = read_toml(rig)
    output.check_format(out)
    output.check_output(source, out)
    if events is not None:
        output.check_file(source, events, (".csv",), replace=force)
        if events.resolve() == out.resolve():
            raise LaunchError(f"--events {events}: expected another path than OUT's")
    terminal = output.console()
    compile_missing(lambda line: terminal.print(printable(line)))
    if is_folder_of_recordings(source):
        if events is not None:
            raise LaunchError(f"--events: expected a single recording as IN, got a folder of them, {source}")
        return clean_folder(source, out, table, jobs, ray, terminal)
    if ray or jobs is not None:
        raise LaunchError(f"--{'ray' if ray else 'jobs'}: expected a folder of recordings as IN, got {source}, one")
    with Progress(console=terminal, disable=not terminal.is_terminal) as progress:
        bar = progress.add_task(source.name, total=None)
        done = output.clean_recording(
            source, out, table, events=events, replace=force,
            began=lambda frames: progress.update(bar, total=frames), advanced=lambda: progress.advance(bar),
        )  # fmt: skip
    spent = f"{done.duration_s:.1f} s, cleaned in {done.spent_s:.1f} s"
    terminal.print(f"{out}: {output.plural(done.frames, 'frame')}, {spent}")
    output.print_faults(terminal, done.refused, done.problems)
    if not done.poses:
        terminal.print(f"  {output.NO_POSE}; `steadypose info {source}` shows what it contains", style="red")
    elif not done.trusted:
        terminal.print(f"  {output.UNTRUSTED}", style="red")
    if done.unread:
        terminal.print(f"  {source} is damaged: the readable part is cleaned", style="red")
    return 1 if done.unread or not done.trusted else 0
