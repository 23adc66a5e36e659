"""``steadypose complete``: key frames to motion, a part of a body to all of it."""

from typing import Annotated

import tyro
from rich.progress import Progress

from steadypose.nodes.commands import output
from steadypose.nodes.commands.output import File, In, Out
from steadypose.nodes.graph.launch import read_toml
from steadypose.nodes.graph.threads import one_thread
from steadypose.nodes.offline import alternative_of, complete_source, load_completer
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sinks.plot.figure import IMAGES, draw_completion, save
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
    samples: Annotated[int, tyro.conf.arg(metavar="N")] = 0,
    force: bool = False,
) -> int:
    """Fill in gaps between key frames, and unobserved parts of a body, offline.

    A joint is missing in a frame if it is NaN or has confidence 0. A frame is missing between stamps more than 1/20 s
    apart. Known joints stay unchanged, so clean a noisy recording first: steadypose clean IN CLEAN.

    OUT has one frame every 1/30 s from the first observation to the last, interpolated if the input has another rate.
    Completed joints have the state IMPUTED, and a standard deviation that grows with the time to the nearest
    observation. Gaps of up to two seconds get plausible motion, longer ones less so. After 8 s without any joint, a new
    segment begins.

    If the pelvis is always at the origin, as in many files of poses lifted from images, the path over the floor is
    predicted from the body's motion. It lies in world_positions or pose/world.

    Try:
      steadypose complete keys.npz motion.npz
      steadypose complete upper_body.npz whole --picture whole.png

    See docs/complete.md.

    Args:
        source: a recording; a .csv; an .npz with positions (T, J, 3) in metres, skeleton, and stamp_ns (T,) or fps,
            NaN or confidence 0 where a joint is missing; or motion capture, as for 'clean'. In an .npz or .csv from
            'clean', imputed joints count as missing.
        out: the result: a recording, or an .npz or .csv.
        optimise: then optimise the motion with HM-VAE, a generative model, to fit the known joints. Takes several
            seconds per window of 64 frames and needs the extra 'train'. The error is not lower, but fast motion is
            less smoothed.
        weights: weights of the completer: 'default', or a .safetensors file.
        skeletons: TOML file, or launch file, with joint layouts of your own as [skeletons.NAME].
        rig: TOML file that describes motion capture which is not recognised: see 'clean'.
        picture: plot to write: .png, .svg or .pdf.
        samples: also write N alternatives, OUT.1 to OUT.N (for an .npz OUT.1.npz and so on), because what is missing
            could be otherwise: their completed joints differ from OUT's by about the standard deviation.
        force: replace OUT if it is a recording, an .npz or a .csv.
    """
    if skeletons is not None:
        add_layouts(read_toml(skeletons).get("skeletons", {}))
    alternatives = {seed: out.with_name(f"{out.stem}.{seed}{out.suffix}") for seed in range(1, samples + 1)}
    output.check_poses_file(source, out, *([picture] if picture else []), replace=force)
    for other in alternatives.values():
        output.check_poses_file(source, other, replace=force)
    if samples < 0:
        raise LaunchError(f"--samples: expected 0 or more, got {samples}")
    if picture is not None and picture.suffix not in IMAGES:
        raise LaunchError(f"--picture: expected a name ending in .png, .svg or .pdf, got {picture}")
    one_thread()
    fill, uncertainty = load_completer(weights)
    if optimise:
        from steadypose.prior.fit.optimise import Optimiser

        fill = Optimiser.load("default", fill)
    terminal = output.console()
    with Progress(console=terminal, disable=not terminal.is_terminal) as progress:
        bar = progress.add_task(source.name, total=None)
        completed = complete_source(
            open_recording(source, read_toml(rig) if rig else NO_RIG),
            fill,
            uncertainty,
            lambda frames, total: progress.update(bar, completed=frames, total=total),
        )
        output.write_output(out, completed.arrays, completed.messages)
        for seed, other in alternatives.items():
            drawn = alternative_of(completed, uncertainty, seed)
            output.write_output(other, drawn.arrays, drawn.messages)
    completion = completed.completion
    people = len({stretch.body for stretch, _ in completion.done})
    longest = max(done.span for _, done in completion.done) / FPS
    terminal.print(
        f"{out}: {output.plural(len(completion.clean) - 1, 'frame')} of {output.plural(people, 'body', 'bodies')}; "
        f"{completion.given:.0%} of their joints were given, the rest completed; the longest gap was {longest:.1f} s"
    )
    for body in completion.centred:
        terminal.print(f"  body {body}: the pelvis is always at the origin, so the path is predicted from the motion")
    for other in alternatives.values():
        terminal.print(f"  wrote an alternative: {other}")
    output.print_faults(terminal, completed.refused, completed.problems)
    if picture is not None:
        save(draw_completion(completion, source.name), picture)
        terminal.print(f"wrote {picture}")
    return 0
