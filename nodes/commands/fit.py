"""``steadypose fit``: test-time optimisation of one recording (HuMoR, section 4)."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.progress import Progress

from steadypose.msgs.types import JOINTS
from steadypose.nodes.commands.output import In, Out, check_poses_file, console, write_output
from steadypose.nodes.driving import clean_joints
from steadypose.nodes.extras import require_extra
from steadypose.nodes.offline import fit_source, load_transitions, with_bones
from steadypose.nodes.settings import STREAMS, LaunchError, located
from steadypose.nodes.sinks.plot.figure import draw_misfit, save
from steadypose.nodes.sources.key_points import check_up, has_key_points, read_key_points
from steadypose.nodes.sources.npz import NpzError, read_arrays
from steadypose.nodes.sources.recording import open_recording
from steadypose.prior.arrays import Floats

if TYPE_CHECKING:
    from steadypose.prior.fit.bodies import Fit
    from steadypose.prior.fit.windows import FittedTrack


def fit(
    source: In,
    out: Out,
    weights: Annotated[str, tyro.conf.arg(metavar="NAME")] = "default",
    delay: Annotated[int, tyro.conf.arg(metavar="K")] = 8,
    smpl: Annotated[Path | None, tyro.conf.arg(metavar="MODEL.npz")] = None,
    force: bool = False,
) -> int:
    """Fit a motion to a whole recording, offline, by optimisation with a learned motion model (HuMoR).

    Starts from the result of `clean`, and optimises poses, bone lengths and floor, so that joints match the
    observations, the motion is likely, and feet in contact stand still. Takes a second or more per second of recording
    and body. If it is stopped, the same command resumes after the last finished window. If a fit fails, the result of
    `clean` is kept and flagged as an anomaly.

    Instead of positions, an .npz may contain 2D key points of one person from one camera: `keypoints` (T, J, 2)
    pixels, skeleton, fps or stamp_ns, `focal` and `centre` in pixels, and optionally confidence (T, J), `up` (default
    -y, a level camera) and `camera_height` in metres. Either kind of .npz may also contain `points` (T, N, 3) metres:
    surface points of the body from a depth camera, in the same frame.

    Also writes OUT.misfit.npz (the residual of each joint and frame, bones and ground) and OUT.fit.png (a plot of it).
    Needs the extra 'train'.

    Try:
      steadypose fit walk_turn fitted.npz

    Args:
        source: a recording, .csv or .npz, as for `clean`; or an .npz with key points.
        out: the result: a recording, or an .npz or .csv with one row per input row. For key points, an .npz at 30 Hz.
        weights: weights of the motion model: 'default', or a .safetensors file.
        delay: delay of `clean`, which initialises the fit, in frames at 30 Hz. Not used for key points.
        smpl: your copy of SMPL or SMPL-H. OUT.smpl.0.npz is then the motion of the first body in AMASS format,
            OUT.smpl.1.npz that of the second, and so on.
        force: replace OUT if it is a recording, an .npz or a .csv.
    """
    source = located(str(source), Path(), STREAMS)
    if not source.exists():
        raise LaunchError(f"{source} does not exist: expected a recording, an .npz or a .csv")
    check_poses_file(source, out, replace=force)
    two_d = has_key_points(source)
    if two_d and out.suffix != ".npz":
        raise LaunchError(f"{out}: expected an .npz, for key points have no recording to go with; got {out.name}")
    require_extra("train")
    import torch

    from steadypose.prior.fit.smpl import SmplShape

    shape = SmplShape.read(smpl) if smpl else None
    torch.set_num_threads(max((os.cpu_count() or 2) // 2, 1))
    model = load_transitions(weights)
    terminal, started = console(), time.perf_counter()
    folder = out.with_name(f".{out.name}.fit")
    folder.mkdir(exist_ok=True)
    try:
        with Progress(console=terminal, disable=not terminal.is_terminal) as progress:
            if two_d:
                frames, tracks, lines = _fit_key_points(source, out, model, folder, progress)
            else:
                frames, tracks, lines = _fit_poses(source, out, model, folder, delay, progress)
        if shape is not None:
            lines += _write_smpl(out, shape, tracks)
        shutil.rmtree(folder)
    finally:
        with suppress(OSError):  # it holds windows, from which the next call resumes, or is gone
            folder.rmdir()
    spent = time.perf_counter() - started
    terminal.print(f"{out}: {frames} frames, fitted in {spent:.1f} s")
    for line in lines:
        terminal.print(f"  {line}")
    return 0


def _fit_poses(
    source: Path, out: Path, model: Any, folder: Path, delay: int, progress: Progress
) -> tuple[int, list[FittedTrack | None], list[str]]:
    """Fit 3D joints, initialised by the nodes' own pipelines: the number of frames, what was fitted, and lines to
    print.
    """
    from steadypose.prior.fit.windows import window_bounds

    bar = progress.add_task(source.name, total=None)
    points = read_arrays(source, ("points",)).get("points") if source.suffix == ".npz" else None
    fitted = fit_source(
        open_recording(source), points, model=model, delay=delay, folder=folder,
        began=lambda bodies: progress.update(bar, total=sum(len(window_bounds(len(b.bodies))) for b in bodies)),
        advanced=lambda: progress.advance(bar),
    )  # fmt: skip
    write_output(out, fitted.arrays, lambda: fitted.messages)
    fits = fitted.fits
    _explain(out, [(fit.seen.id, fit.seen.stamps_ns, fit.misfit, fit.track) for fit in fits], "m")
    return len(fitted.stamps_ns), [fit.track for fit in fits], [*map(_line, fits), *fitted.problems]


def _line(fit: Fit) -> str:
    who = f"body {fit.seen.id}, {len(fit.misfit)} frames"
    if fit.track is None:
        return f"{who}: the fit failed; the result of `clean` is kept and flagged"
    known = fit.misfit[np.isfinite(fit.misfit)]
    far = f"; median residual of observed joints {np.median(known) * 1e3:.0f} mm" if len(known) else ""
    kept = f"; third stage kept in {fit.track.kept.sum()} of {len(fit.track.kept)} windows"
    return f"{who}: floor at {fit.track.ground[:, 0].mean():.3f} m{far}{kept}"


def _fit_key_points(
    source: Path, out: Path, model: Any, folder: Path, progress: Progress
) -> tuple[int, list[FittedTrack | None], list[str]]:
    """Fit key points of one camera; returns as `_fit_poses`."""
    from steadypose.prior.fit.picture import arrays_of_fit, fit_key_points
    from steadypose.prior.fit.solve import PICTURES
    from steadypose.prior.fit.windows import MIN_FRAMES, window_bounds

    recording = read_key_points(source)
    frames = len(recording.stamps_ns)
    if frames < MIN_FRAMES:
        raise NpzError(f"{source}: expected {MIN_FRAMES} frames at 30 Hz or more, got {frames}")
    bar = progress.add_task(source.name, total=len(window_bounds(frames)))
    track = fit_key_points(model, recording, PICTURES, folder, clean_joints, lambda: progress.advance(bar))
    write_output(out, lambda: with_bones(arrays_of_fit(recording, track), track), tuple)
    misfit = track.misfit[0]
    _explain(out, [(0, recording.stamps_ns, misfit, track)], "pixels")
    off = f"median residual of key points {np.nanmedian(misfit):.1f} pixels"
    return frames, [track], [off, *check_up(recording)]


def _write_smpl(out: Path, shape: Any, tracks: Sequence[FittedTrack | None]) -> list[str]:
    """Write the motion of each fitted body as SMPL's; lines to print."""
    from steadypose.prior.fit.smpl import smpl_motion

    lines = []
    for number, track in enumerate(tracks):
        if track is None:
            continue
        motion = smpl_motion(shape, track.joints, np.linalg.norm(track.offsets.mean(axis=0), axis=-1))
        path = out.with_name(f"{out.name}.smpl.{number}.npz")
        np.savez(path, **motion.arrays)
        off = np.linalg.norm(motion.joints - track.joints, axis=-1).mean() * 1e3
        lines.append(f"{path.name}: mean distance of SMPL's joints from the fitted ones {off:.0f} mm")
    return lines


def _explain(out: Path, fits: Sequence[tuple[int, NDArray[np.int64], Floats, Any]], unit: str) -> None:
    arrays: dict[str, Any] = {"joint_names": np.array(JOINTS), "unit": np.array(unit)}
    for number, (body, stamps, misfit, track) in enumerate(fits):
        arrays |= {f"{number}/body_id": np.array(body), f"{number}/stamp_ns": stamps, f"{number}/misfit": misfit}
        if track is not None:
            arrays |= {f"{number}/offsets": track.offsets, f"{number}/ground": track.ground}
            arrays |= {f"{number}/energies": track.energies}
    np.savez(out.with_name(f"{out.name}.misfit.npz"), **arrays)
    save(draw_misfit(fits, unit), out.with_name(f"{out.name}.fit.png"))
