"""``steadypose complete``: key frames to motion, a part of a body to all of it."""

from __future__ import annotations

from typing import Annotated

import tyro
from rich.progress import Progress

from steadypose.nodes.commands.output import File, In, Out, check_poses_file, console, plural, write_output
from steadypose.nodes.graph.launch import read_toml
from steadypose.nodes.graph.threads import one_thread
from steadypose.nodes.offline import complete_source, load_completer
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sinks.plot.figure import PICTURES, draw_completion, save
from steadypose.nodes.sources.recording import NO_RIG, open_recording
from steadypose.prior.body.layouts import add_layouts
from steadypose.prior.timing.rate import FPS


def complete(
    source: In,
    out: Out,
    optimise: bool = False,
    weights: Annotated[str, tyro.conf.arg(metavar="NAME")] = "default",
    skeletons: File = None,
    rig: File = None,
    picture: File = None,
    force: bool = False,
) -> int:
    """Complete recorded poses: motion between key frames, and unobserved parts of a body.

    Missing are joints that are NaN or of confidence 0, in any frame, and frames between stamps more than 1/20 s apart.
    Known joints stay unchanged, so clean a noisy recording first: steadypose clean IN CLEAN. OUT has a frame every
    1/30 s from the first stamp to the last, interpolated where the input has other stamps. Completed joints have the
    state IMPUTED, and a standard deviation that grows with the time to the nearest observation. In gaps of up to two
    seconds the motion is plausible; in longer ones it becomes less so, and after 8 s without any joint a new stretch
    begins.

    Where the pelvis lies at the origin all the time, as in many files of poses lifted from images, the way over the
    floor is read from the motion of the body; world_positions, or pose/world, have it.

    Key frames to motion: steadypose complete keys.npz motion.npz. A part of a body to all of it, as a recording, and a
    picture of what was done: steadypose complete upper_body.npz whole --picture whole.png. More in docs/complete.md.

    Args:
        source: a recording, a .csv, or .npz with positions (T, J, 3) in metres, skeleton, and stamp_ns (T,) or fps;
            what is missing is NaN, or 0 in confidence (T, J); or motion, as 'clean' reads it. Of an .npz or .csv
            that 'clean' wrote, what it imputed is missing.
        out: the recording to make, or .npz or .csv.
        optimise: search HM-VAE for the motion that fits what is known, as the paper does: first its latent vectors,
            then its decoder, from the answer of the feed-forward completer. Takes seconds for each window of 64
            frames and the extra 'train'; no nearer to the truth than the completer, but as fast-moving as people.
        weights: weight set of the completer: 'default', or a .safetensors file of your own.
        skeletons: TOML with [skeletons.NAME] of joint layouts of your own; a launch file with them will do.
        rig: TOML that says of files of motion what they do not: see 'clean'.
        picture: what was done, as .png, .svg or .pdf.
        force: replace what is at OUT, if it is a recording, an .npz or a .csv.
    """
    if skeletons is not None:
        add_layouts(read_toml(skeletons).get("skeletons", {}))
    check_poses_file(source, out, *([picture] if picture else []), replace=force)
    if picture is not None and picture.suffix not in PICTURES:
        raise LaunchError(f"--picture: expected a name ending in .png, .svg or .pdf, got {picture}")
    one_thread()
    fill, uncertainty = load_completer(weights)
    if optimise:
        from steadypose.prior.fit.optimise import Optimiser

        fill = Optimiser.load("default", fill)
    terminal = console()
    with Progress(console=terminal, disable=not terminal.is_terminal) as progress:
        bar = progress.add_task(source.name, total=None)
        completed = complete_source(
            open_recording(source, read_toml(rig) if rig else NO_RIG),
            str(source),
            fill,
            uncertainty,
            began=lambda frames: progress.update(bar, total=frames),
            advanced=lambda frame: progress.update(bar, completed=frame),
        )
    write_output(out, completed.arrays, completed.messages)
    completion = completed.completion
    people = len({stretch.body for stretch, _ in completion.done})
    longest = max(done.span for _, done in completion.done) / FPS
    terminal.print(
        f"{out}: {len(completion.clean) - 1} frames of {plural(people, 'body', 'bodies')}; {completion.given:.0%} of "
        f"their joints were given, the rest completed; the longest gap was {longest:.1f} s"
    )
    if completion.unreached:
        terminal.print(f"  left out, for nothing near them is known: {completion.unreached} joints", style="yellow")
    for body in completion.centred:
        terminal.print(f"  body {body} stands on its pelvis: its trajectory is predicted from its motion")
    for cause, count in completed.refused.items():
        terminal.print(f"  refused or dropped, {cause}: {count}")
    if picture is not None:
        save(draw_completion(completion, source.name), picture)
        terminal.print(f"wrote {picture}")
    return 0
