"""``steadypose doctor --live``: listen to what a tracker publishes, and say what is wrong with it."""

from __future__ import annotations

from rich.console import Console

from steadypose.msgs.topics import DIAGNOSTICS, POSE_RAW
from steadypose.msgs.transport import Subscriber
from steadypose.msgs.types import Diagnostics, PoseRaw
from steadypose.nodes.checks.problem import Problem, error, from_values
from steadypose.nodes.checks.stream import StreamCheck
from steadypose.nodes.graph.clock import POLL_S, Clock, SystemClock
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.topology import POSE_NODES
from steadypose.prior.clean.settings import PriorSettings

LISTEN_NS = 3_000_000_000


def listen(launch_file: str, console: Console, clock: Clock | None = None) -> int:
    """Listen for three seconds, to the tracker and to the nodes' `diagnostics`, and print what is wrong.

    Args:
        launch_file: whose addresses to listen at.
        console: to print on.
        clock: the system's.

    Raises:
        LaunchError: the launch file cannot be used.

    Returns:
        0 if nothing is, otherwise 1.
    """
    clock = clock or SystemClock()
    launch = Launch.read(launch_file)
    transport, keys = launch.transport, launch.transport.curve_keys()
    settings = PriorSettings.from_dict(launch.table("prior"))
    check = StreamCheck(settings.max_bodies, identified=settings.identify.enabled)
    addresses = launch.addresses("pose_input")
    reported: dict[str, str] = {}
    frames: list[PoseRaw] = []
    with (
        Subscriber(addresses, POSE_RAW, keys=keys, clear_text=transport.clear_text) as tracker,
        Subscriber(
            [transport.endpoint(name) for name in POSE_NODES],
            DIAGNOSTICS,
            keys=keys,
            clear_text=transport.clear_text,
        ) as nodes,
        console.status(f"listening at {', '.join(addresses)}"),
    ):
        end_ns = clock.now_ns() + LISTEN_NS
        while (now_ns := clock.now_ns()) < end_ns:
            if (received := tracker.receive(POLL_S)) and isinstance(raw := received[1], PoseRaw):
                check.see(raw, now_ns)
                frames.append(raw)
            while received := nodes.receive(0):
                if isinstance(news := received[1], Diagnostics):
                    reported |= {cause: f"{news.node}: {text}" for cause, text in from_values(news.values).items()}
        refused = sum(tracker.refused.values())
    # a replay's stamps are long past, and so is what a tracker's may be: neither says that they should be of now
    problems = check.problems(clock.now_ns(), live=False)
    if not frames:
        problems.append(_silence(addresses, refused))
    for problem in problems:
        console.print(f"{problem.level.name} {problem.cause}: {problem.text}", markup=False, soft_wrap=True)
    for cause, text in reported.items():
        if cause not in {problem.cause for problem in problems}:
            console.print(f"{cause}: {text}", markup=False, soft_wrap=True)
    if frames:
        newest = frames[-1]
        rate = len(frames) / (LISTEN_NS / 1e9)
        bodies = max(len(raw.bodies) for raw in frames)
        console.print(
            f"{len(frames)} messages, {rate:.1f} Hz, of {newest.source!r}: skeleton {newest.skeleton!r}, up to "
            f"{bodies} bodies, frame {newest.frame_id!r}, {'calibrated' if newest.calibrated else 'not calibrated'}"
        )
    if problems or reported:
        return 1
    console.print("nothing is wrong with it")
    return 0


def _silence(addresses: list[str], refused: int) -> Problem:
    if refused:
        return error(
            "not_a_message",
            f"{refused} of what came were no messages: expected the topic, a zero byte, a header of 9 bytes, and CDR "
            "(docs/other_languages.md)",
        )
    return error(
        "no_source",
        f"nothing came on {POSE_RAW} at {', '.join(addresses)}: expected a publisher there; start the tracker, or "
        "name its launch file: steadypose doctor --live --launch FILE",
    )
