"""``steadypose plot``: what happened in a recording, as one plot, or as a video.

Panels that a recording has nothing for are left out, so that one of `pose/raw` alone is drawn too. One body is
drawn, the one seen the longest unless another is asked for; the trajectory over the floor is that of all of them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from steadypose.nodes.commands.output import plural, unfinished
from steadypose.nodes.sinks.plot.figure import check_picture, draw, save
from steadypose.nodes.sinks.plot.history import PlotError, history_of_path


def plot(
    recording: Annotated[Path, tyro.conf.Positional],
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE")] = None,
    body: Annotated[int | None, tyro.conf.arg(metavar="ID")] = None,
    video: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    over: Annotated[Path | None, tyro.conf.arg(metavar="VIDEO")] = None,
) -> None:
    """Plot a recording as an image or a video.

    Try:
      steadypose plot walk_turn
      steadypose plot cleaned --video walk.gif

    Args:
        recording: rosbag2 directory or .mcap with any of pose/raw, pose/clean, pose/world, pose/truth; or a file of
            poses in a format of 'clean'.
        output: image to write: .png, .svg or .pdf. Default: named after the recording, in the current folder.
        body: id of the body to draw. Default: the one that is visible longest.
        video: video to write instead: .gif, or .mp4 (needs the extra 'oak'). It shows raw, clean and world side by
            side.
        over: the video that was cleaned, as in 'steadypose clean walk.mp4 walk'. With --video, raw (not in an .npz)
            and clean are drawn over its images, with the field of view that 'clean' assumes.

    Raises:
        RecordingError: the recording cannot be read.
        PlotError: there is nothing to draw, no such body, or nowhere to write to.
    """
    import matplotlib  # noqa: F401  (first of all: what is not installed is said before anything else)

    _refuse_folder(recording)
    if over is not None and video is None:
        raise PlotError("over: expected --video FILE.mp4 too, the video to write")
    if video is not None:
        from steadypose.nodes.sinks.plot.video import VIDEOS, write_overlay, write_video

        check_picture(video, VIDEOS)
        with unfinished(video) as part:
            if over is not None:
                frames = write_overlay(recording, over, part, body)
            else:
                frames = write_video(history_of_path(recording), part, body)
            part.replace(video)
        print(f"wrote {video}: {plural(frames, 'frame', 'frames')}")
        return
    output = output or Path(f"{recording.resolve().stem}.png")
    check_picture(output)
    with unfinished(output) as part:
        save(draw(history_of_path(recording), body), part)
        part.replace(output)
    print(f"wrote {output}")


def _refuse_folder(path: Path) -> None:
    """Raises PlotError if the path is a folder of recordings, with which there are."""
    if path.is_dir() and not any(path.glob("*.mcap")) and (inside := sorted({f.parent for f in path.glob("*/*.mcap")})):
        names = ", ".join(str(found) for found in inside[:4])
        raise PlotError(f"{path}: expected one recording, got a folder of {len(inside)}; name one, such as {names}")
