"""The process that keeps the last minutes of drawings and serves them, with the page that shows them."""

from __future__ import annotations

import ctypes
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from urllib.parse import quote

from steadypose.nodes.graph.extras import require_extra

HOST = "127.0.0.1"
MEMORY = "256MB"
"""of drawings that the server keeps for browsers that come later: about five minutes of one body"""


class ViewerError(RuntimeError):
    """The viewer cannot start. The text says what to do."""


class ViewerServer:
    """The Rerun process that keeps the drawings and serves them, with the page that shows them, to browsers.

    It listens on this machine alone: a picture of people in a room is not for whoever shares the network, and
    Rerun's own ``serve_grpc`` would listen on every address. To look from another machine, carry both ports over
    ssh: ``ssh -L 9090:localhost:9090 -L 9091:localhost:9091 robot``.
    """

    def __init__(self, port: int) -> None:
        """Start serving.

        Args:
            port: of the page; the drawings come on the next one.

        Raises:
            LaunchError: Rerun is not installed.
            ViewerError: a port is taken, or the server does not come up.
        """
        require_extra("view")
        import rerun_cli

        for wanted in (port, port + 1):
            _refuse_used(wanted)
        self.data_url = f"rerun+http://{HOST}:{port + 1}/proxy"
        self.url = f"http://{HOST}:{port}/?url={quote(self.data_url, safe='')}"
        binary = Path(next(iter(rerun_cli.__path__)), "rerun")
        command = [str(binary), "--serve-web", "--bind", HOST, "--web-viewer-port", str(port), "--port", str(port + 1)]
        # The server must not outlive a node that is killed, or its ports stay taken.
        self._process = subprocess.Popen(
            [*command, "--server-memory-limit", MEMORY, "--newest-first"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            preexec_fn=_die_with_parent if sys.platform == "linux" else None,
        )
        try:
            for wanted in (port, port + 1):
                self._wait_for(wanted)
        except RuntimeError:
            self.close()
            raise

    def check(self) -> None:
        """Raises:
        RuntimeError: the server has stopped; to be started again, unlike what a `ViewerError` says.
        """
        if self._process.poll() is not None:
            raise RuntimeError(f"Rerun's server has stopped, exit code {self._process.returncode}")

    def close(self) -> None:
        self._process.terminate()
        try:
            self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def __enter__(self) -> ViewerServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _wait_for(self, port: int, timeout_s: float = 20.0) -> None:
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            self.check()
            with socket.socket() as probe:
                if probe.connect_ex((HOST, port)) == 0:
                    return
            time.sleep(0.05)
        raise ViewerError(f"Rerun's server did not open port {port} within {timeout_s:.0f} s")


def _refuse_used(port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            raise ViewerError(
                f"port {port} is not to be had ({error.strerror}): another viewer may be running; "
                "close it, or set another [viewer] port (it needs that port and the next)"
            ) from error


def _die_with_parent() -> None:
    PR_SET_PDEATHSIG = 1
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
