"""``steadypose keys``: CurveZMQ keys for messages that leave this machine."""

from __future__ import annotations

from pathlib import Path

from steadypose.msgs.keys import create_keys
from steadypose.nodes.graph.settings import LaunchError


def keys(directory: Path) -> None:
    """Make a pair of CurveZMQ keys: who has no key on the list hears nothing.

    Copy own.key of each machine that listens into clients/ here, and own.key of here to those machines as
    server.key. Then name the directory as 'keys' under [transport] of the launch file.

    Args:
        directory: where the keys go; own.key_secret never leaves it.
    """
    try:
        create_keys(directory)
    except ValueError as error:
        raise LaunchError(str(error)) from error
    print(f"{directory}/own.key: to hand out")
    print(f"{directory}/own.key_secret: to keep")
    print(f"{directory}/clients/: the keys of those who may listen")
