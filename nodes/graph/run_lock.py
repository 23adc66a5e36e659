"""One run at an address: a lock for each that a run's nodes publish at, taken before it starts any of them.

The system lets a lock go with the process that holds it, however that ends; the files stay, and mean nothing by
themselves.
"""

from __future__ import annotations

import fcntl
import os
from contextlib import ExitStack, suppress

from steadypose.msgs.addresses import local_directory, make_private
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.settings import LaunchError

HEALTH = "health"


class RunLock:
    """The addresses of a run's nodes, and where there is no other run, ``health.json``. A context manager.

    Attributes:
        has_health: whether ``health.json`` is this run's to write; the other run there has other nodes.
    """

    def __init__(self, launch: Launch) -> None:
        """Raises:
        LaunchError: another run has one of the addresses.
        """
        directory = launch.transport.make_ipc_directory()
        self.has_health = True
        with ExitStack() as stack:
            for name in launch.nodes:
                endpoint = launch.transport.endpoint(name)
                if endpoint.startswith("ipc://"):
                    holder = _take(stack, endpoint.removeprefix("ipc://") + ".lock")
                else:  # whatever the directory of this launch's sockets
                    make_private(local_directory())
                    holder = _take(stack, f"{local_directory()}/{endpoint.replace('/', '')}.lock")
                if holder is not None:
                    raise LaunchError(
                        f"{name} runs already at {endpoint}, in another `steadypose run`{holder}: stop that one, or "
                        "give this one addresses of its own ([transport] directory, or [transport.endpoints])"
                    )
            self.has_health = _take(stack, f"{directory}/{HEALTH}.lock") is None
            self._held = stack.pop_all()

    def __enter__(self) -> RunLock:
        return self

    def __exit__(self, *_: object) -> None:
        self._held.close()


def _take(stack: ExitStack, path: str) -> str | None:
    """Take a lock; returns None, or what is known of who has it."""
    try:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
    except OSError as error:
        raise LaunchError(f"cannot make {path}: {error.strerror}") from error
    stack.callback(os.close, file)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        pid = os.read(file, 16).decode("ascii", "replace").strip()
        return f" (process {pid})" if pid else ""
    os.ftruncate(file, 0)
    with suppress(OSError):  # a full disk: the lock holds all the same
        os.write(file, str(os.getpid()).encode())
    return None
