"""Python and the packages of an installation."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, requires, version

from steadypose.nodes.commands.doctor.finding import INSTALL, PROJECT, Finding, Verdict
from steadypose.nodes.graph.extras import EXTRAS, install_command

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
