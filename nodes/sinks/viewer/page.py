"""Serves Rerun's page, and to who has the token the drawings, to browsers that came here under a name of this machine.

A picture of people is not for everybody with a login: any user of the machine can connect to its loopback ports, and
any page in a browser can, once its own name is made to lead to 127.0.0.1 (DNS rebinding). So drawings need a token, and
no request is answered that names another host. A Content-Security-Policy restricts the page's connections to here.
"""

from __future__ import annotations

import hmac
import ipaddress
import shutil
import socket
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.error import HTTPError, URLError
from urllib.parse import urlsplit
from urllib.request import urlopen

from steadypose.nodes.sinks.viewer.drawings import Drawings

KEPT = ("Content-Type", "Content-Length", "Content-Encoding", "Cache-Control", "ETag")
"""headers of Rerun's answers that are passed on"""
POLICY = (
    "default-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob: data:; "
    "connect-src 'self' blob: data:; frame-src 'none'; form-action 'none'; base-uri 'self'"
)
DRAWINGS = "drawings.rrd"
"""the last part of the drawings' path, after the token"""


def is_own_name(host: str | None, names: frozenset[str]) -> bool:
    """Whether a request's ``Host`` is this machine: an address, which leads where it says, or one of ``names``."""
    try:
        name = urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return False
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return name in names
    return True


class PageServer:
    """Serves another server's pages and the drawings, in threads.

    Args:
        host, port: to serve at.
        origin: the other server, such as ``http://127.0.0.1:40123``.
        token: that the path of the drawings begins with.
        drawings: that are served.
    """

    def __init__(self, host: str, port: int, origin: str, token: str, drawings: Drawings) -> None:
        names = frozenset({"localhost", host.lower(), socket.gethostname().lower(), socket.getfqdn().lower()})
        own_path = f"/{token}/{DRAWINGS}".encode()

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                if not is_own_name(self.headers.get("Host"), names):
                    self.send_error(403, "expected this machine's own name or address")
                    return
                try:
                    path = urlsplit(self.path).path  # what comes after is for the page in the browser
                    if path.endswith(DRAWINGS):
                        self._send_drawings(path)
                    else:
                        self._send_page(path)
                except (BrokenPipeError, ConnectionResetError):
                    pass  # the browser has gone

            def _send_drawings(self, path: str) -> None:
                if not hmac.compare_digest(path.encode(), own_path):
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
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
