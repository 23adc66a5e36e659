"""``steadypose doctor``: what works on this machine, what is missing, and what to type about it."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from rich.console import Console
from rich.table import Table

from steadypose.nodes.commands.doctor.finding import INSTALL, Finding, Verdict
from steadypose.nodes.commands.doctor.installation import check_packages, check_python
from steadypose.nodes.commands.doctor.machine import (
    check_camera,
    check_clock,
    check_memory,
    check_processor,
    check_webcam,
)
from steadypose.nodes.commands.doctor.running import check_loops, check_messages, check_models, check_streams


def doctor(live: bool = False, launch: str = "replay") -> int:
    """Check this machine: what works, what is missing, and what to type about it.

    Args:
        live: listen for three seconds to a tracker that publishes, and to nodes that run, and say what is wrong there.
        launch: the launch file whose addresses these are.

    Returns:
        0 if `steadypose run` can work here, otherwise 1; with `live`, 0 if nothing is wrong.
    """
    console = Console(highlight=False)
    if live:
        from steadypose.nodes.commands.doctor.live import listen

        return listen(launch, console)
    table = Table("", "what", "found", box=None, pad_edge=False, header_style="bold")
    with console.status("looking"):
        findings = [finding for check in CHECKS for finding in _examine(check)]
    for finding in findings:
        table.add_row(finding.verdict.value, finding.what, finding.found)
    console.print(table)
    for finding in findings:
        if finding.fix:
            console.print(f"\n{finding.verdict.value} {finding.what}: {finding.found}")
            console.print(f"  {finding.fix}", markup=False, soft_wrap=True)
    bad = [finding.what for finding in findings if finding.verdict is Verdict.BAD]
    console.print()
    console.print(f"`steadypose run` cannot work yet: {', '.join(bad)}" if bad else "`steadypose run` can work here")
    return 1 if bad else 0


def _examine(check: Callable[[], Iterator[Finding]]) -> list[Finding]:
    found: list[Finding] = []
    try:
        found.extend(check())
    except Exception as error:  # one broken check must not hide the results of the others
        found.append(Finding(_name(check), Verdict.BAD, f"{type(error).__name__}: {error}", INSTALL))
    return found


def _name(check: Callable[[], Iterator[Finding]]) -> str:
    return check.__name__.removeprefix("check_").replace("_", " ")


CHECKS: tuple[Callable[[], Iterator[Finding]], ...] = (
    check_python,
    check_packages,
    check_processor,
    check_memory,
    check_clock,
    check_messages,
    check_loops,
    check_models,
    check_streams,
    check_camera,
    check_webcam,
)
