"""``steadypose complete``: key frames to motion, a part of a body to all of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.progress import Progress

from steadypose.msgs.topics import POSE_CLEAN, POSE_RAW, POSE_WORLD
from steadypose.msgs.types import JOINTS, JointState, Message, PoseRaw
from steadypose.nodes.commands.output import (
    File,
    In,
    Out,
    check_poses_file,
    console,
    plural,
    write_output,
)
from steadypose.nodes.graph.launch import read_toml
from steadypose.nodes.graph.settings import LaunchError
from steadypose.nodes.graph.threads import one_thread
from steadypose.nodes.sinks.arrays import NpzCollector
from steadypose.nodes.sinks.drawing import ALL_BONES, STATE_COLOURS
from steadypose.nodes.sources.recording import NO_RIG, open_recording, with_end
from steadypose.nodes.sources.source import RecordedSource
from steadypose.prior.body.layouts import add_layouts
from steadypose.prior.complete.body import Fill, Uncertainty
from steadypose.prior.complete.parts import PartsCompleter
from steadypose.prior.complete.stream import Completion, complete_raws, moved, root_steps
from steadypose.prior.models.completer import LiveCompleter
from steadypose.prior.timing.rate import FPS
from steadypose.prior.world.pipeline import TrajectoryPipeline
from steadypose.prior.world.settings import TrajectorySettings

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FIGURES = 16
_GIVEN, _COMPLETED = STATE_COLOURS[JointState.SEEN], STATE_COLOURS[JointState.IMPUTED]


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
    if picture is not None and picture.suffix not in (".png", ".svg", ".pdf"):
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
        draw(completion, source.name, picture)
        terminal.print(f"wrote {picture}")
    return 0


class CompletedSource(NamedTuple):
    """What came of a source."""

    raws: list[PoseRaw]
    """``pose/raw`` as it was, with its end"""
    answers: list[tuple[str, Message]]
    """``pose/clean`` and ``pose/world`` with their topics, in order"""
    completion: Completion
    refused: dict[str, int]
    """what was refused or dropped, by cause"""

    def messages(self) -> list[tuple[str, Message]]:
        """All messages, by their stamps."""
        every = [*((POSE_RAW, message) for message in self.raws), *self.answers]
        return sorted(every, key=lambda pair: pair[1].stamp_ns)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays of ``clean``, with a row for each frame of the grid on which there is a body."""
        collector = NpzCollector()
        for _, message in self.answers:
            collector.add(message)
        return collector.arrays(np.array([message.stamp_ns for message in self.completion.clean[:-1]], np.int64))


def load_completer(weights: str) -> tuple[PartsCompleter, Uncertainty]:
    """The completer of a weight set, and the standard deviations of its output."""
    completer = LiveCompleter.load(weights)
    return PartsCompleter(completer), Uncertainty(completer.config.never_sigma, completer.config.half_frames)


def complete_source(
    frames: RecordedSource,
    name: str,
    fill: Fill,
    uncertainty: Uncertainty,
    began: Callable[[int], None] = lambda frames: None,
    advanced: Callable[[int], None] = lambda frame: None,
) -> CompletedSource:
    """Complete what a source has; ``name`` is what errors call it, the rest as of `complete_raws`.

    Raises:
        LaunchError: it has no frame.
        CompletionError: as `complete_raws`.
    """
    raws = [message for _, message in with_end(frames) if isinstance(message, PoseRaw)]
    if not raws:
        raise LaunchError(f"{name}: expected frames, but none of {len(frames)} could be read")
    completion = complete_raws(name, raws[:-1], fill, uncertainty, began, advanced)
    settings = TrajectorySettings()
    world, steps = TrajectoryPipeline(settings), root_steps(completion, settings.weights)
    answers: list[tuple[str, Message]] = []
    for message in completion.clean:
        answers.append((POSE_CLEAN, message))
        answers += [(POSE_WORLD, answer) for answer in world.process(moved(message, steps, completion.anchor_ns))]
    refused = {cause: n for cause, n in (frames.refused + world.counters).items() if n}
    return CompletedSource(raws, answers, completion, refused)


def draw(completion: Completion, title: str, path: Path) -> None:
    """Write the picture of the longest stretch that was completed: joints given when, stick figures, the trajectory."""
    import matplotlib

    from steadypose.nodes.commands.plot_panels import draw_bones, side_by_side

    matplotlib.use("Agg")
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure

    stretch, completed = max(completion.done, key=lambda pair: len(pair[0].given))
    joints, known = completed.positions, completed.known
    there = np.flatnonzero(np.isfinite(joints).all(axis=(1, 2)))
    figure = Figure(figsize=(15, 9), layout="constrained")
    figure.suptitle(f"{title} · body {stretch.body} · given in green, completed in orange", fontsize=13, weight="bold")
    grid = figure.add_gridspec(2, 2, height_ratios=[1, 1.2], width_ratios=[2.2, 1])
    sticks = figure.add_subplot(grid[0, :])
    chosen = there[np.linspace(0, len(there) - 1, min(FIGURES, len(there))).round().astype(int)]
    for row, flat in zip(chosen, *side_by_side(sticks, chosen / FPS, joints[chosen]), strict=True):
        colours = [_GIVEN if known[row, list(ends)].all() else _COMPLETED for ends in ALL_BONES]
        draw_bones(sticks, flat, ALL_BONES, colours, width=2.0)
    which = figure.add_subplot(grid[1, 0])
    shown = np.where(np.isfinite(joints[..., 0]), np.where(known, 1, 2), 0)
    which.imshow(
        shown.T, aspect="auto", interpolation="nearest", vmin=0, vmax=2,
        cmap=ListedColormap(["white", _GIVEN, _COMPLETED]), extent=(0.0, len(shown) / FPS, 21.5, -0.5),
    )  # fmt: skip
    which.set_yticks(range(len(JOINTS)), JOINTS, fontsize=7)
    which.set(title="which joints were given when", xlabel="seconds")
    _draw_trajectory(figure.add_subplot(grid[1, 1]), joints[:, 0], known[:, 0])
    figure.savefig(path, dpi=110)


def _draw_trajectory(axis: Axes, root: NDArray[np.float64], given: NDArray[np.bool_]) -> None:
    for mask, colour in ((given, _GIVEN), (~given, _COMPLETED)):
        axis.plot(root[mask, 0], root[mask, 1], ".", color=colour, markersize=3)
    axis.set(title="the pelvis from above, m", aspect="equal")
    axis.grid(alpha=0.25)
