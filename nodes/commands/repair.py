"""``steadypose repair``: what can be read of a damaged recording, as a whole one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from steadypose.msgs.recording import RecordingReader, RecordingWriter


def repair(
    source: Annotated[Path, tyro.conf.arg(name="in", metavar="IN")],
    out: Annotated[Path, tyro.conf.arg(metavar="OUT")],
) -> int:
    """Write what can be read of a recording into a new one, with its index and metadata, and say what is lost.

    For recordings whose writer was killed, which other programs may not read, and for damaged files: of these a chunk
    is lost, half a second at most, for each place that is damaged. The exit status is 1 if anything is lost.

    Args:
        source: a rosbag2 directory or an .mcap.
        out: the directory to make.
    """
    with RecordingReader(source) as recording, RecordingWriter(out) as writer:
        saved = 0
        for topic, stamp_ns, message in recording:
            writer.write(topic, message, stamp_ns)
            saved += 1
        undecodable = recording.refused.total()
        print(f"{out}: {saved} messages; lost: {recording.lost_bytes} bytes in {recording.gaps} places", end="")
        print(f", {undecodable} messages that cannot be decoded" if undecodable else "")
        return 1 if recording.lost_bytes or undecodable else 0
