"""``steadypose doctor``: what works on this machine, what is missing, and what to type about it."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator
from importlib.metadata import PackageNotFoundError, requires, version

from rich.console import Console
from rich.table import Table

from steadypose.nodes.commands.doctor_checks import (
    INSTALL,
    PROJECT,
    Finding,
    Verdict,
    check_camera,
    check_clock,
    check_loops,
    check_memory,
    check_messages,
    check_models,
    check_processor,
    check_streams,
    check_webcam,
)
from steadypose.nodes.graph.extras import EXTRAS, install_command


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
        from steadypose.nodes.commands.doctor_live import listen

        return listen(launch, console)
    table = Table("", "what", box=None, pad_edge=False, header_style="bold")
    table.add_column("found", overflow="fold")
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


PYTHONS = ((3, 10), (3, 13))
"""the oldest and the newest that all packages of an installation come for"""


KEY_PACKAGES = ("numpy", "numba", "rosbags", "pyzmq")


def check_python() -> Iterator[Finding]:
    running = ".".join(map(str, sys.version_info[:3]))
    oldest, newest = PYTHONS
    good = oldest <= sys.version_info[:2] <= newest
    fix = "" if good else f"install Python {_dotted(oldest)} to {_dotted(newest)}, and steadypose anew with it"
    yield Finding("Python", Verdict.GOOD if good else Verdict.BAD, running, fix)


def _dotted(number: tuple[int, int]) -> str:
    return ".".join(map(str, number))


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
            yield Finding(f"extra {extra}", Verdict.NOTE, f"{EXTRAS[extra].purpose}{size}: {install_command(extra)}")


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
