"""Keeps the last minutes of drawings and serves them, with the page that shows them."""

from __future__ import annotations

import ctypes
import secrets
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from steadypose.nodes.graph.extras import require_extra
from steadypose.nodes.sinks.viewer.drawings import Drawings
from steadypose.nodes.sinks.viewer.page import DRAWINGS, PageServer

if TYPE_CHECKING:
    import rerun as rr

LOOPBACK = "127.0.0.1"
FLUSH_S = 0.05
"""between batches of drawings: longer looks jerky, shorter costs more in wrapping than in drawings"""


class ViewerError(RuntimeError):
    """The viewer cannot start. The text says what to do."""


class ViewerServer:
    """Keeps the drawings and serves them, with the page that shows them, to browsers that know the token.

    It listens on this machine alone, unless told otherwise: a picture of people in a room is not for whoever shares
    the network, nor, by the token, for other users of the machine. The page is that of a Rerun process, which has no
    drawings, passed on with a Content-Security-Policy, so that a browser lets it call nobody but this server: by itself
    it would send telemetry and ask for news of its version.
    """

    def __init__(self, port: int, host: str = LOOPBACK) -> None:
        """Start serving.

        Args:
            port: of the page and the drawings.
            host: address to serve at.

        Raises:
            LaunchError: Rerun is not installed.
            ViewerError: a port is taken, or the server does not come up.
        """
        require_extra("view")
        self._page: PageServer | None = None
        self._drawings = Drawings()
        self._closed = threading.Event()
        import rerun_cli

        _refuse_used(host, port)
        shown = socket.gethostname() if host in ("0.0.0.0", "::") else host
        inner, unused, token = _free_port(), _free_port(), secrets.token_urlsafe(24)
        at = f"http://{shown}:{port}"
        self.data_url = f"{at}/{token}/{DRAWINGS}"
        self.url = f"{at}/?theme=dark&url={quote(self.data_url, safe='')}"
        binary = Path(next(iter(rerun_cli.__path__)), "rerun")
        # The server must not outlive a node that is killed.
        self._process = subprocess.Popen(
            [str(binary), "--serve-web", "--bind", LOOPBACK, "--web-viewer-port", str(inner), "--port", str(unused)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            preexec_fn=_die_with_parent if sys.platform == "linux" else None,
        )
        try:
            self._wait_for(inner)
            self._page = PageServer(host, port, f"http://{LOOPBACK}:{inner}", token, self._drawings)
        except RuntimeError:
            self.close()
            raise

    def show(self, recording: rr.RecordingStream) -> None:
        """Serve what is drawn into a recording, from now on."""
        import rerun as rr

        stream = rr.binary_stream(recording)

        def read() -> None:
            while not self._closed.wait(FLUSH_S):
                if piece := stream.read():
                    self._drawings.add(piece)

        threading.Thread(target=read, daemon=True).start()

    def check(self) -> None:
        """Raises:
        RuntimeError: the server has stopped; to be started again, unlike what a `ViewerError` says.
        """
        if self._process.poll() is not None:
            raise RuntimeError(f"Rerun's server has stopped, exit code {self._process.returncode}")

    def close(self) -> None:
        self._closed.set()
        self._drawings.close()
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
                if probe.connect_ex((LOOPBACK, port)) == 0:
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
                "close it, or set another [viewer] port"
            ) from error


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return probe.getsockname()[1]


def _die_with_parent() -> None:
    PR_SET_PDEATHSIG = 1
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
