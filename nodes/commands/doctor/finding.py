"""What a check of the doctor finds, and how to get back what an installation lacks."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from steadypose import PACKAGE
from steadypose.nodes.graph.extras import install_command

PROJECT = PACKAGE.parents[1] / "pyproject.toml"
"""of a checkout; an installed wheel has none"""
INSTALL = install_command()


class Verdict(Enum):
    """How a check came out, as it is printed."""

    GOOD = "[green]ok[/]"
    NOTE = "[yellow]note[/]"
    """works, but not as well as it could, or for want of something optional"""
    BAD = "[bold red]missing[/]"
    """`steadypose run` cannot work"""


@dataclass(frozen=True)
class Finding:
    """What one check found, and what to type to change it."""

    what: str
    verdict: Verdict
    found: str
    fix: str = ""


def restored(what: str) -> str:
    """What to type to restore files that came with steadypose."""
    return f"git checkout -- {what}" if PROJECT.exists() else INSTALL
