"""The recorder: writes topics to a rosbag2 directory.

It can run for months: it splits the recording into parts and removes the oldest beyond a limit. While the disk is full
it drops and counts messages. After a restart it continues with the next part.
"""

import errno
import itertools
import logging
import math
import os
import shutil
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from steadypose.msgs.recording import RecordingError, RecordingWriter
from steadypose.msgs.recording_writer import recorded_parts
from steadypose.msgs.topics import DIAGNOSTICS, TOPICS
from steadypose.msgs.types import Diagnostics, Message
from steadypose.nodes.graph.clock import Clock
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.node import Node
from steadypose.nodes.settings import LaunchError, as_text, path_setting
from steadypose.nodes.sources.registry import open_input
from steadypose.nodes.sources.source import LiveSource
from steadypose.prior.settings import nearest

logger = logging.getLogger(__name__)

LEAST_FREE_MB = 1.0
"""Smallest free disk space in which messages are written: a part's header may fit where its messages do not."""
CHECK_NS = 1_000_000_000  # interval between checks of the free disk space, nanoseconds
QUIET_S = 0.3  # time without a message after which everything in flight has arrived, when the node stops, seconds
LAST_NS = 2_000_000_000
"""Longest time that a stopping node goes on recording publishers that do not stop, such as a tracker, nanoseconds."""
WAITING = 1000
"""Largest number of diagnostics kept until the first pose. The oldest are left out: no source may come for days."""
NO_SPACE = (errno.ENOSPC, errno.EDQUOT)


@dataclass(frozen=True)
class RecorderSettings:
    """``[recorder]``: what is recorded, and where."""

    directory: str = path_setting()
    """the rosbag2 directory to create; relative to the launch file"""
    topics: list[str] = field(default_factory=lambda: list(TOPICS))
    split_mb: float = 1000.0
    """size at which the next part starts, MB; 0: never"""
    split_s: float = 3600.0
    """duration of the stream after which the next part starts, seconds; 0: never"""
    keep_mb: float = 0.0
    """total size above which the oldest parts are removed, MB; 0: keep all"""
    free_mb: float = 500.0
    """free disk space below which messages are dropped and counted, MB; at least 1"""
    sync_s: float = 5.0
    """interval of writing to the disk, which limits what a power failure can lose, seconds; 0: left to the operating
    system"""

    def __post_init__(self) -> None:
        for topic in self.topics:
            if topic not in TOPICS:
                got = f"{topic!r}{nearest(topic, TOPICS)}"
                raise LaunchError(f"[recorder] topics: expected some of {', '.join(TOPICS)}, got {got}")
        for name in ("split_mb", "split_s", "keep_mb", "free_mb", "sync_s"):
            if not 0 <= getattr(self, name) < math.inf:
                raise LaunchError(f"[recorder] {name}: expected 0 or more, got {getattr(self, name)}")
        if 0 < self.keep_mb < (least := 2 * self.split_mb):
            raise LaunchError(f"[recorder] keep_mb: expected two parts or more, {least:g}, got {self.keep_mb:g}")

    def writer(self) -> RecordingWriter:
        """Open the recording for writing. Raises RecordingError if the directory holds something else, or cannot be
        made.
        """
        return RecordingWriter(
            self.directory,
            go_on=True,
            split_bytes=round(self.split_mb * 1e6),
            split_ns=round(self.split_s * 1e9),
            keep_bytes=round(self.keep_mb * 1e6),
        )


def check_recorder(launch: Launch) -> None:
    """Raise LaunchError if no directory is set, or a setting cannot be used."""
    if not launch.settings(RecorderSettings).directory:
        raise LaunchError("[recorder] directory: expected the recording to make, got none; give --record")


def free_directory(launch: Launch) -> Path | None:
    """The directory to record to instead of the configured one; None if that can be used. Raises as `open_input`.

    A restarted live run continues the same recording with its next part, because stamps increase and limits apply to
    the whole recording. A replay would repeat the same stamps, so it gets a new directory. So does a run whose
    directory contains something else.
    """
    directory = launch.settings(RecorderSettings).directory
    wanted = Path(directory)
    if not directory or not os.path.lexists(wanted):
        return None
    if _is_recording(wanted) and ("pose_input" not in launch.nodes or isinstance(open_input(launch), LiveSource)):
        return None
    others = (wanted.with_name(f"{wanted.name}-{number}") for number in itertools.count(2))
    return next(other for other in others if not os.path.lexists(other))


def _is_recording(directory: Path) -> bool:
    try:
        recorded_parts(directory)
    except (OSError, RecordingError):
        return False
    return True


AHEAD_NS = 10_000_000_000  # jump ahead of a topic's stamps of which a single one counts as wrong, nanoseconds


class LogTimes:
    """Assigns MCAP log times with which a recording plays in the order of arrival.

    The log time is the capture stamp or, if a topic's stamps went back, the highest stamp before. A single wrong stamp,
    far ahead, does not count, because all later messages would have its log time.
    """

    def __init__(self) -> None:
        self._highest_ns: dict[str, int] = {}
        self._ahead: set[str] = set()  # topics whose last stamp was far ahead

    def next(self, topic: str, stamp_ns: int) -> int:
        """Log time of the topic's next message, captured at ``stamp_ns``; nanoseconds."""
        highest_ns = self._highest_ns.get(topic, stamp_ns)
        if stamp_ns - highest_ns > AHEAD_NS and topic not in self._ahead:
            self._ahead.add(topic)
            return highest_ns
        self._ahead.discard(topic)
        self._highest_ns[topic] = max(stamp_ns, highest_ns)
        return self._highest_ns[topic]


NO_ROOM = "dropped.no room on the disk"


class RecorderNode(Node):
    """Records all published messages without loss, and completes the recording when it stops."""

    name = "recorder"

    def __init__(self, launch: Launch, clock: Clock | None = None) -> None:
        super().__init__(launch, clock)
        check_recorder(launch)
        self._settings = launch.settings(RecorderSettings)
        self._full = False
        self._checked_ns = self._synced_ns = 0
        self._log_times = LogTimes()
        self._before_first_pose: deque[Diagnostics] = deque(maxlen=WAITING)
        self._pose_ns: int | None = None
        self._written = 0
        self._writer: RecordingWriter | None = None

    def run(self) -> None:
        # before anything is received or reported, because the last part of a killed recorder is read through
        try:
            self._writer = self._settings.writer()
        except RecordingError as error:
            if not isinstance(error.__cause__, OSError) or error.__cause__.errno not in NO_SPACE:
                raise
            self._no_room(str(error))
        super().run()

    def work(self) -> None:
        try:
            super().work()
            asked_ns = self.clock.monotonic_ns()
            while self.take_next(QUIET_S) and self.clock.monotonic_ns() - asked_ns < LAST_NS:
                pass
        finally:
            with self._if_room():
                if self._writer:
                    self._writer.close()

    def take_next(self, timeout_s: float) -> bool:
        took = super().take_next(timeout_s)
        if not took:
            self._flush()
            self.settle()
        return took

    def _flush(self) -> None:
        with self._if_room():
            if self._writer:
                self._writer.flush()

    def settle(self, timeout_s: float = 0.0) -> bool:
        """As in every node, but a message is acknowledged only once it would survive this process."""
        return False if self._writer and self._writer.pending else super().settle(timeout_s)

    def handle(self, topic: str, message: Message) -> None:
        if topic not in self._settings.topics:
            return
        if isinstance(message, Diagnostics) and self._pose_ns is None:
            # the stream's time is unknown before the first pose
            self._before_first_pose.append(message)
            return
        if not isinstance(message, Diagnostics):
            self._pose_ns = message.stamp_ns
        while self._before_first_pose:
            self._write(DIAGNOSTICS, self._before_first_pose.popleft(), message.stamp_ns)
        # diagnostics of a node that has not received a pose have no stamp
        self._write(topic, message, message.stamp_ns or self._pose_ns or 0)
        if not isinstance(message, Diagnostics) and message.end_of_stream:
            self._flush()  # this process may be stopped as soon as the end of the stream is known

    def _write(self, topic: str, message: Message, stamp_ns: int) -> None:
        with self._if_room():
            self._look_at_disk()
            if self._writer and not self._full:
                self._writer.write(topic, message, self._log_times.next(topic, stamp_ns))
                self._written += 1
                return
        self.health.counts[NO_ROOM] += 1

    def _look_at_disk(self) -> None:
        now = self.clock.monotonic_ns()
        if self._checked_ns and now - self._checked_ns < CHECK_NS:
            return
        self._checked_ns = now
        self._writer = self._writer or self._settings.writer()
        free_mb = shutil.disk_usage(self._writer.directory).free / 1e6
        least_mb = max(self._settings.free_mb, LEAST_FREE_MB)
        if free_mb < least_mb:
            self._no_room(f"{free_mb:.1f} MB of the disk are free, less than {least_mb:g} (free_mb)")
        elif self._full:
            self._writer.split()
            self._full = False
            logger.info("recorder: the disk has room again; the next part starts")
        elif self._settings.sync_s and now - self._synced_ns >= self._settings.sync_s * 1e9:
            self._synced_ns = now
            self._writer.flush()  # the log times, by which it does so, stand still for hours if a clock was set back
            self._writer.sync()

    @contextmanager
    def _if_room(self) -> Iterator[None]:
        """Take what fails in the context for a full disk."""
        try:
            yield
        except (OSError, RecordingError) as error:
            self._no_room(error.strerror or str(error) if isinstance(error, OSError) else str(error))

    def _no_room(self, cause: str) -> None:
        if not self._full:
            logger.error("recorder: %s: messages are dropped until there is room", cause)
        self._full = True

    def status(self) -> dict[str, str]:
        return {"written": str(self._written), "recording": as_text(self._settings.directory)}
