"""Python processes of our own, which import nothing from the folder they are started in: it may hold a socket.py."""

from __future__ import annotations

import os
import sys

_SCRIPT = (
    # as python -P, which 3.10 does not have
    "import sys; sys.path[:] = [p for p in sys.path if p]; "
    "from importlib import import_module; module, _, name = sys.argv.pop(1).partition(':'); "
    "sys.exit(getattr(import_module(module), name)())"
)


def command(function: str, *arguments: str) -> list[str]:
    """The command line of a process that calls a function, and exits with what it returns.

    Args:
        function: as ``module:name``.
        arguments: what it finds in `sys.argv`.
    """
    return [sys.executable, "-c", _SCRIPT, function, *arguments]


def environment() -> dict[str, str]:
    """This process' environment for such a process: without the working folder, which an empty part of a path means."""
    found = dict(os.environ)
    if parts := found.get("PYTHONPATH"):
        found["PYTHONPATH"] = os.pathsep.join(part for part in parts.split(os.pathsep) if part)
    return found | {"PYTHONSAFEPATH": "1"}
