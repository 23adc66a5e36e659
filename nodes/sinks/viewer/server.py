"""Keeps the last minutes of drawings, and serves them with Rerun's page to browsers with access (`sinks.serving`)."""

from __future__ import annotations

import ctypes
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from http.client import InvalidURL
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.error import HTTPError, URLError
from urllib.parse import quote, urlsplit
from urllib.request import urlopen

from steadypose.msgs import Closing
from steadypose.nodes.sinks.serving import called, is_token, own_names, port_taken, shown

if TYPE_CHECKING:
    import rerun as rr

MOST_BYTES = 2**28
"""Largest size of the drawings kept for browsers that connect later, bytes; about five minutes of one body."""
FIRST = 100  # number of first pieces that are never dropped. They include names, colours and layout.
WAIT_S = 0.5
"""Longest time a reader waits for the next piece before it checks whether its browser is connected, seconds."""


class Drawings:
    """A buffer of self-contained pieces of Rerun's data format. Thread-safe."""

    def __init__(self) -> None:
        self._first: list[bytes] = []
        self._later: deque[bytes] = deque()
        self._dropped = 0
        self._bytes = 0
        self._closed = False
        self._changed = threading.Condition()

    def add(self, piece: bytes) -> None:
        """Add a piece, and drop the oldest ones beyond the limit."""
        with self._changed:
            if len(self._first) < FIRST:
                self._first.append(piece)
            else:
                self._later.append(piece)
                self._bytes += len(piece)
            while self._bytes > MOST_BYTES:
                self._bytes -= len(self._later.popleft())
                self._dropped += 1
            self._changed.notify_all()

    def follow(self) -> Iterator[bytes]:
        """The kept pieces, then each new one; an empty one now and then while there is none."""
        at = 0  # index among all pieces ever added
        while not self._closed:
            with self._changed:
                first, later = self._first[at:], []
                if not first:
                    start = max(at - FIRST - self._dropped, 0)
                    later = [self._later[index] for index in range(start, len(self._later))]
                    at = FIRST + self._dropped + len(self._later) if later else at
                at += len(first)
                if not first and not later:
                    self._changed.wait(WAIT_S)
            yield from first or later or [b""]

    def close(self) -> None:
        """End the iteration of all readers."""
        self._closed = True
        with self._changed:
            self._changed.notify_all()


KEPT = ("Content-Type", "Content-Length", "Content-Encoding", "Cache-Control", "ETag")
"""Headers of Rerun's responses that are passed on."""
POLICY = (
    "default-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob: data:; "
    "connect-src 'self' blob: data:; frame-src 'none'; form-action 'none'; base-uri 'self'"
)
DRAWINGS = "drawings.rrd"  # last part of the drawings' path, after the token


class PageServer:
    """Serves the pages of another server, ``origin``, and the drawings at ``/token/drawings.rrd``, in threads."""

    def __init__(self, host: str, port: int, origin: str, token: str, drawings: Drawings) -> None:
        names = own_names(host, socket.getfqdn())
        own_path = f"/{token}/{DRAWINGS}"

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                with suppress(BrokenPipeError, ConnectionResetError):  # the browser disconnected
                    if called(self.headers.get("Host"), names) is None:
                        self.send_error(403, "expected this machine's own name or address")
                        return
                    try:
                        path = urlsplit(self.path).path  # the query is for the page in the browser
                        if path.endswith(DRAWINGS):
                            self._send_drawings(path)
                        else:
                            self._send_page(path)
                    except (ValueError, InvalidURL):
                        self.send_error(400, "expected a path of the page")

            def _send_drawings(self, path: str) -> None:
                if not is_token(path, own_path):
                    self.send_error(403, "expected the address that was printed, with its token")
                    return
                self.send_response(200)
                self.send_header("Content-Type", "application/octet-stream")
                self.send_header("Cache-Control", "no-store")
                self.end_headers()
                for piece in drawings.follow():
                    self.wfile.write(piece)

            def _send_page(self, path: str) -> None:
                try:
                    with urlopen(f"{origin}{path}", timeout=20) as answer:
                        self.send_response(answer.status)
                        for name in KEPT:
                            if value := answer.headers.get(name):
                                self.send_header(name, value)
                        self.send_header("Content-Security-Policy", POLICY)
                        self.send_header("Referrer-Policy", "no-referrer")
                        self.end_headers()
                        shutil.copyfileobj(answer, self.wfile)
                except HTTPError as error:
                    self.send_error(error.code)
                except URLError:
                    self.send_error(502)

            def log_message(self, format: str, *args: object) -> None:
                pass

        self._server = ThreadingHTTPServer((host, port), Handler)
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()


LOOPBACK = "127.0.0.1"
FLUSH_S = 0.05
"""Interval between batches of drawings, seconds. Longer looks jerky; shorter costs more overhead than drawing."""


class ViewerError(RuntimeError):
    """The viewer cannot start. The text says what to do."""


class ViewerServer(Closing):
    """Keeps the drawings, and serves them and the page that shows them to browsers with the token.

    By default it listens on this machine only. The token keeps out other users of this machine. The page comes from a
    Rerun process that has no drawings. It is passed on with a Content-Security-Policy that lets it connect only to this
    server; otherwise it would send telemetry and check for new versions.
    """

    def __init__(self, port: int, host: str = LOOPBACK) -> None:
        """Start serving. Raises ViewerError if the port is taken, or Rerun's server does not start."""
        import rerun_cli

        self._page: PageServer | None = None
        self._drawings = Drawings()
        self._closed = threading.Event()
        inner, unused, token = _free_port(), _free_port(), secrets.token_urlsafe(24)
        at = f"http://{shown(host)}:{port}"
        self.data_url = f"{at}/{token}/{DRAWINGS}"
        self.url = f"{at}/?theme=dark&url={quote(self.data_url, safe='')}"
        binary = Path(next(iter(rerun_cli.__path__)), "rerun")
        # preexec_fn: the server must not outlive a node that is killed
        self._process = subprocess.Popen(
            [str(binary), "--serve-web", "--bind", LOOPBACK, "--web-viewer-port", str(inner), "--port", str(unused)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            preexec_fn=_die_with_parent if sys.platform == "linux" else None,
        )
        try:
            self._page = PageServer(host, port, f"http://{LOOPBACK}:{inner}", token, self._drawings)
            self._wait_for(inner)
        except OSError as error:
            self.close()
            raise ViewerError(port_taken("viewer", host, port, error)) from error
        except RuntimeError:
            self.close()
            raise

    def connect(self) -> rr.RecordingStream:
        """A recording; what is drawn into it is served."""
        import rerun as rr

        recording = rr.RecordingStream("steadypose", batcher_config=rr.ChunkBatcherConfig(flush_tick=FLUSH_S))
        stream = rr.binary_stream(recording)

        def read() -> None:
            while not self._closed.wait(FLUSH_S):
                if piece := stream.read():
                    self._drawings.add(piece)

        threading.Thread(target=read, daemon=True).start()
        return recording

    def check(self) -> None:
        """Raise RuntimeError if Rerun's server has stopped. Unlike after a `ViewerError`, a restart helps."""
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

    def _wait_for(self, port: int, timeout_s: float = 20.0) -> None:
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            self.check()
            with socket.socket() as probe:
                if probe.connect_ex((LOOPBACK, port)) == 0:
                    return
            time.sleep(0.05)
        raise ViewerError(f"Rerun's server did not open port {port} within {timeout_s:.0f} s")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return probe.getsockname()[1]


def _die_with_parent() -> None:
    PR_SET_PDEATHSIG = 1
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
