"""Commands of one call each: ``keys``, ``repair``, ``simulate`` and ``plot``."""

from pathlib import Path
from typing import Annotated

import tyro

from steadypose.msgs.recording import RecordingReader, RecordingWriter
from steadypose.msgs.security import create_keys
from steadypose.nodes.commands.output import File, In, Out, plural, unfinished
from steadypose.nodes.graph.launch import bundled
from steadypose.prior.sim.streams import ManifestError, read_manifest, record


def keys(directory: Annotated[Path, tyro.conf.arg(metavar="DIR")]) -> None:
    """Make a pair of CurveZMQ keys, so that only the subscribers that you list can receive messages.

    Make one on each machine. On the publishing machine, put own.key of each subscriber into clients/; on each
    subscriber, save own.key of the publisher as server.key. Then set `keys` to this folder, in [transport] of the
    launch file.

    Try:
      steadypose keys keys

    Args:
        directory: folder for the keys. Keep own.key_secret secret.
    """
    create_keys(directory)
    print(f"{directory}/own.key: to hand out")
    print(f"{directory}/own.key_secret: to keep")
    print(f"{directory}/clients/: the keys of those who may listen")


def repair(source: In, out: Out) -> int:
    """Write the readable part of a recording to a new one, with index and metadata, and print what is lost.

    Use it for damaged files, and for recordings whose writer was killed, which other programs may not read. Each
    damaged place costs half a second at most. The exit status is 1 if anything is lost.

    Try:
      steadypose repair take take-repaired

    Args:
        source: a rosbag2 directory or an .mcap.
        out: the directory to write.
    """
    with RecordingReader(source) as recording, RecordingWriter(out) as writer:
        saved = 0
        for topic, stamp_ns, message in recording:
            writer.write(topic, message, stamp_ns)
            saved += 1
        undecodable = recording.refused.total()
        lost = f"{recording.lost_bytes} bytes in {plural(recording.gaps, 'place')}"
        print(f"{out}: {plural(saved, 'message')}; lost: {lost}", end="")
        print(f", {plural(undecodable, 'message')} that cannot be decoded" if undecodable else "")
        return 1 if recording.lost_bytes or undecodable else 0


def simulate(
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")],
    stream: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME")] = (),
    manifest: File = None,
) -> None:
    """Simulate recordings of a depth camera, with the ground truth on the topic pose/truth.

    The same manifest gives the same bytes on the same machine. For your own scenes, copy sim_data/manifest.json,
    change script, seed, camera or noise, and pass it with --manifest.

    Try:
      steadypose simulate /tmp/streams                        all of sim_data
      steadypose simulate /tmp/streams --stream walk_turn
      steadypose run --input /tmp/streams/walk_turn --view

    Args:
        out: folder to write to. Each stream gets a new folder in it.
        stream: name of a stream to make. Repeatable. Default: all.
        manifest: what to simulate. Default: that of sim_data.
    """
    path = manifest or bundled("sim_data", "manifest.json")
    known = read_manifest(path)
    if unknown := set(stream) - known.keys():
        raise ManifestError(f"{path} has no stream {', '.join(sorted(unknown))}; it has {', '.join(known)}")
    for name in stream or known:
        record(known[name], out / name)
        print(f"{out / name}: {known[name].what}")


def plot(
    recording: Annotated[Path, tyro.conf.arg(metavar="IN")],
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE")] = None,
    body: Annotated[int | None, tyro.conf.arg(metavar="ID")] = None,
    video: File = None,
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
    import matplotlib  # noqa: F401  (first, so that a missing extra is reported before anything else)

    from steadypose.nodes.sinks.plot.figure import check_image, draw, save
    from steadypose.nodes.sinks.plot.history import PlotError, history_of_path

    if recording.is_dir() and not any(recording.glob("*.mcap")) and (inside := {*recording.glob("*/*.mcap")}):
        folders = sorted({str(file.parent) for file in inside})
        few = ", ".join(folders[:4])
        raise PlotError(f"{recording}: expected one recording, got a folder of {len(folders)}; name one, such as {few}")
    if over is not None and video is None:
        raise PlotError("over: expected --video FILE.mp4 too, the video to write")
    if video is not None:
        from steadypose.nodes.sinks.plot.video import VIDEOS, write_overlay, write_video

        check_image(video, VIDEOS)
        with unfinished(video) as part:
            if over is not None:
                frames = write_overlay(recording, over, part, body)
            else:
                frames = write_video(history_of_path(recording), part, body)
        print(f"wrote {video}: {plural(frames, 'frame')}")
        return
    output = output or Path(f"{recording.resolve().stem}.png")
    check_image(output)
    with unfinished(output) as part:
        save(draw(history_of_path(recording), body), part)
    print(f"wrote {output}")
