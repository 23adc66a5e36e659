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
from steadypose.nodes.sinks.viewer.page import PageServer

LOOPBACK = "127.0.0.1"
MEMORY = "256MB"
"""of drawings that the server keeps for browsers that come later: about five minutes of one body"""


class ViewerError(RuntimeError):
    """The viewer cannot start. The text says what to do."""


class ViewerServer:
    """The Rerun process that keeps the drawings and serves them, with the page that shows them, to browsers.

    It listens on this machine alone, unless told otherwise: a picture of people in a room is not for whoever shares
    the network. The page is Rerun's, passed on with a Content-Security-Policy, so that a browser lets it call nobody
    but this server: by itself it would send telemetry and ask for news of its version.
    """

    def __init__(self, port: int, host: str = LOOPBACK) -> None:
        """Start serving.

        Args:
            port: of the page; the drawings come on the next one.
            host: address to serve at.

        Raises:
            LaunchError: Rerun is not installed.
            ViewerError: a port is taken, or the server does not come up.
        """
        require_extra("view")
        self._page: PageServer | None = None
        import rerun_cli

        for wanted in (port, port + 1):
            _refuse_used(host, wanted)
        shown = socket.gethostname() if host in ("0.0.0.0", "::") else host
        self._host, inner = host, _free_port(host)
        self.data_url = f"rerun+http://{shown}:{port + 1}/proxy"
        self.url = f"http://{shown}:{port}/?url={quote(self.data_url, safe='')}"
        binary = Path(next(iter(rerun_cli.__path__)), "rerun")
        command = [str(binary), "--serve-web", "--bind", host, "--web-viewer-port", str(inner), "--port", str(port + 1)]
        # The server must not outlive a node that is killed, or its ports stay taken.
        self._process = subprocess.Popen(
            [*command, "--server-memory-limit", MEMORY, "--newest-first"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            preexec_fn=_die_with_parent if sys.platform == "linux" else None,
        )
        try:
            for wanted in (inner, port + 1):
                self._wait_for(wanted)
            self._page = PageServer(host, port, f"http://{shown}:{inner}", f"http://{shown}:{port + 1}")
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
        if self._page:
            self._page.close()
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
                if probe.connect_ex((self._host, port)) == 0:
                    return
            time.sleep(0.05)
        raise ViewerError(f"Rerun's server did not open port {port} within {timeout_s:.0f} s")


def _refuse_used(host: str, port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise ViewerError(
                f"port {port} is not to be had ({error.strerror}): another viewer may be running; "
                "close it, or set another [viewer] port (it needs that port and the next)"
            ) from error


def _free_port(host: str) -> int:
    with socket.socket() as probe:
        probe.bind((host, 0))
        return probe.getsockname()[1]


def _die_with_parent() -> None:
    PR_SET_PDEATHSIG = 1
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
