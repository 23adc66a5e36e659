"""``steadypose doctor``: what works on this machine, what is missing, and what to type about it."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator
from importlib.metadata import PackageNotFoundError, requires, version
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console
from rich.table import Table
from rich.text import Text

from steadypose.nodes.commands.doctor_checks import INSTALL, MACHINE, PROJECT, Finding, Verdict
from steadypose.nodes.extras import EXTRAS, install_command
from steadypose.nodes.settings import LaunchError

if TYPE_CHECKING:  # the doctor starts where not even numpy is installed
    from steadypose.msgs.types import PoseRaw


def doctor(live: bool = False, launch: Annotated[str, tyro.conf.arg(metavar="FILE")] = "replay") -> int:
    """Check this machine: what works, what is missing, and which command mends it.

    Try:
      steadypose doctor
      steadypose doctor --live   while your tracker runs

    Args:
        live: listen for three seconds to your tracker and to running nodes, and report problems.
        launch: with --live, a launch file, or the name of a bundled one, at whose addresses to listen.

    Returns:
        0 if `steadypose run` can work here, otherwise 1; with `live`, 0 if nothing is wrong.

    Raises:
        LaunchError: there is a launch file, but nothing to listen for.
    """
    console = Console(highlight=False, markup=False)
    if live:
        return listen(launch, console)
    if launch != "replay":
        raise LaunchError(f"--launch: expected --live with it; without, try `steadypose run {launch}`, which checks it")
    table = Table("", "what", box=None, pad_edge=False, header_style="bold")
    table.add_column("found", overflow="fold")
    with console.status("looking"):
        findings = [finding for check in CHECKS for finding in _examine(check)]
    for finding in findings:
        table.add_row(Text(*finding.verdict.value), finding.what, finding.found)
    console.print(table)
    for finding in findings:
        if finding.fix:
            console.print(Text.assemble("\n", finding.verdict.value, f" {finding.what}: {finding.found}"))
            console.print(f"  {finding.fix}", soft_wrap=True)
    bad = [finding.what for finding in findings if finding.verdict is Verdict.BAD]
    console.print()
    console.print(f"`steadypose run` cannot work yet: {', '.join(bad)}" if bad else "`steadypose run` can work here")
    return 1 if bad else 0


LISTEN_NS = 3_000_000_000  # time in nanoseconds that a tracker is listened to


def listen(launch_file: str, console: Console) -> int:
    """Listen for three seconds, where a launch file says, to the tracker and to the nodes' `diagnostics`.

    Prints the problems; returns 0 if there are none, otherwise 1. Raises LaunchError if the file cannot be used.
    """
    from steadypose.msgs.topics import DIAGNOSTICS, POSE_RAW
    from steadypose.msgs.transport import Subscriber
    from steadypose.msgs.types import Diagnostics, PoseRaw
    from steadypose.nodes.checks.problem import check_wire, error, from_values
    from steadypose.nodes.checks.stream import AT_ONCE, StreamChecks
    from steadypose.nodes.graph.clock import POLL_S, Clock
    from steadypose.nodes.graph.launch import Launch
    from steadypose.nodes.graph.topology import POSE_NODES
    from steadypose.prior.clean.settings import PriorSettings

    clock, launch = Clock(), Launch.read(launch_file)
    transport, keys = launch.transport, launch.transport.curve_keys()
    streams = len(launch.server.clients) or 1
    check = StreamChecks(launch.settings(PriorSettings), streams)
    addresses, nodes_at = launch.addresses("pose_input"), [transport.endpoint(name) for name in POSE_NODES]
    reported: dict[str, str] = {}
    frames: list[PoseRaw] = []
    with (
        Subscriber(addresses, POSE_RAW, keys=keys, clear_text=transport.clear_text) as tracker,
        Subscriber(nodes_at, DIAGNOSTICS, keys=keys, clear_text=transport.clear_text) as nodes,
        console.status(f"listening at {', '.join(addresses)}"),
    ):
        end_ns = clock.monotonic_ns() + LISTEN_NS
        while clock.monotonic_ns() < end_ns:
            if (received := tracker.receive(POLL_S)) and isinstance(raw := received[1], PoseRaw):
                check.see(raw, clock.now_ns())
                frames.append(raw)
            while received := nodes.receive(0):
                if isinstance(news := received[1], Diagnostics):
                    reported |= {cause: f"{news.node}: {text}" for cause, text in from_values(news.values).items()}
        refused = {tracker.addresses: tracker.refused}
    # a replay's stamps are long past, and so is what a tracker's may be: neither says that they should be of now
    *_, found = [check.problems(clock.now_ns(), live=False) for _ in range(0, streams, AT_ONCE)]
    problems = [*found, *check_wire(refused)]
    if not frames and not problems:
        remedy = "start the tracker, or name its launch file: steadypose doctor --live --launch FILE"
        text = f"nothing came on {POSE_RAW} at {', '.join(addresses)}: expected a publisher there; {remedy}"
        problems.append(error("no_source", text))
    for problem in problems:
        console.print(f"{problem.level.name} {problem}", markup=False, soft_wrap=True)
    for cause, text in reported.items():
        if cause not in {problem.cause for problem in problems}:
            console.print(f"{cause}: {text}", markup=False, soft_wrap=True)
    for source in {raw.source: None for raw in frames}:
        own = [raw for raw in frames if raw.source == source]
        newest = own[-1]
        rate = f"{len(own) / (LISTEN_NS / 1e9):.1f} Hz"
        bodies = max(len(raw.bodies) for raw in own)
        sensor = f"frame {newest.frame_id!r}, {'calibrated' if newest.calibrated else 'not calibrated'}"
        console.print(f"{source!r}: {rate}, skeleton {newest.skeleton!r}, bodies: {bodies}, {sensor}")
    if problems or reported:
        return 1
    console.print("no problems found")
    return 0


def _examine(check: Callable[[], Iterator[Finding]]) -> list[Finding]:
    found: list[Finding] = []
    try:
        found.extend(check())
    except Exception as error:  # one broken check must not hide the results of the others
        name = check.__name__.removeprefix("check_").replace("_", " ")
        found.append(Finding(name, Verdict.BAD, f"{type(error).__name__}: {error}", INSTALL))
    return found


KEY_PACKAGES = ("numpy", "numba", "rosbags", "pyzmq")


def check_python() -> Iterator[Finding]:
    running = ".".join(map(str, sys.version_info[:3]))
    if (3, 10) <= sys.version_info[:2] <= (3, 13):  # for which all packages of an installation are available
        yield Finding("Python", Verdict.GOOD, running)
    else:
        fix = "install Python 3.10 to 3.13, and reinstall steadypose with it"
        yield Finding("Python", Verdict.BAD, running, fix)


def check_packages() -> Iterator[Finding]:
    """What steadypose requires, and its optional extras."""
    needed, extras = required()
    if missing := _missing(needed):
        yield Finding("packages", Verdict.BAD, "; ".join(missing), INSTALL)
    else:
        yield Finding("packages", Verdict.GOOD, ", ".join(f"{name} {version(name)}" for name in KEY_PACKAGES))
    for extra, wanted in sorted(extras.items()):
        if _missing(wanted):
            size = f" ({EXTRAS[extra].size})" if EXTRAS[extra].size else ""
            found = f"not installed, for {EXTRAS[extra].purpose}{size}: {install_command(extra)}"
            yield Finding(f"extra {extra}", Verdict.NOTE, found)


def required() -> tuple[list[str], dict[str, list[str]]]:
    """What running takes, and what each extra does: of the checkout, or else of the installed wheel."""
    if PROJECT.exists():
        # not what the installed distribution says of itself: that is older than the checkout after a pull
        import tomlkit

        project = tomlkit.parse(PROJECT.read_text(encoding="utf-8")).unwrap()["project"]
        return project["dependencies"], project["optional-dependencies"]
    needed: list[str] = []
    extras: dict[str, list[str]] = {}
    for requirement in requires("steadypose") or ():
        extra = re.search(r"""extra\s*==\s*['"]([\w-]+)""", requirement)
        (extras.setdefault(extra[1], []) if extra else needed).append(requirement)
    return needed, extras


def _missing(wanted: list[str]) -> list[str]:
    """Of these requirements, those that are not installed, or not in the version wanted."""
    from packaging.requirements import Requirement

    missing = []
    for requirement in map(Requirement, wanted):
        # the extra that it belongs to is asked about; the machine it is for may be another
        if requirement.marker and not any(requirement.marker.evaluate({"extra": name}) for name in EXTRAS):
            continue
        try:
            installed = version(requirement.name)
        except PackageNotFoundError:
            installed = ""
        if not installed or not requirement.specifier.contains(installed, prereleases=True):
            missing.append(f"{requirement.name} {installed or 'not installed'}, expected {requirement.specifier}")
    return missing


CHECKS: tuple[Callable[[], Iterator[Finding]], ...] = (check_python, check_packages, *MACHINE)
