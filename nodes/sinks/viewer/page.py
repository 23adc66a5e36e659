"""Serves Rerun's page with a Content-Security-Policy that restricts its connections to this server."""

from __future__ import annotations

import shutil
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.error import HTTPError, URLError
from urllib.request import urlopen

KEPT = ("Content-Type", "Content-Length", "Content-Encoding", "Cache-Control", "ETag")
"""headers of Rerun's answers that are passed on"""


def policy(data_url: str) -> str:
    """The Content-Security-Policy of a page that connects to ``data_url`` only."""
    return (
        "default-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob: data:; "
        f"connect-src 'self' blob: data: {data_url}; frame-src 'none'; form-action 'none'; base-uri 'self'"
    )


class PageServer:
    """Serves another server's pages under a policy, in a thread.

    Args:
        host, port: to serve at.
        origin: the other server, such as ``http://127.0.0.1:40123``.
        data_url: where the page may get its data.
    """

    def __init__(self, host: str, port: int, origin: str, data_url: str) -> None:
        allowed = policy(data_url)

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                try:
                    with urlopen(f"{origin}{self.path}", timeout=20) as answer:
                        self.send_response(answer.status)
                        for name in KEPT:
                            if value := answer.headers.get(name):
                                self.send_header(name, value)
                        self.send_header("Content-Security-Policy", allowed)
                        self.send_header("Referrer-Policy", "no-referrer")
                        self.end_headers()
                        shutil.copyfileobj(answer, self.wfile)
                except HTTPError as error:
                    self.send_error(error.code)
                except URLError:
                    self.send_error(502)
                except (BrokenPipeError, ConnectionResetError):
                    pass  # the browser has gone

            def log_message(self, format: str, *args: object) -> None:
                pass

        self._server = ThreadingHTTPServer((host, port), Handler)
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
