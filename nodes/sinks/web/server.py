"""Serves the page and its WebSocket, in a separate thread.

**Access** (`nodes.sinks.serving`). The WebSocket requires a token. The printed address has it after a ``#``, so that it
appears in no log and no ``Referer``. The page and its scripts contain nothing secret.

**Slow clients.** Each client has a queue for the newest message of each stream, and for some events. A message that is
not sent before the next one arrives is dropped and counted. A client is therefore never further behind than its
connection's buffers.
"""

from __future__ import annotations

import asyncio
import logging
import mimetypes
import threading
from collections import deque
from collections.abc import Collection
from concurrent.futures import Future
from contextlib import suppress
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs

from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sinks.serving import called, is_token, own_names, port_taken, shown

if TYPE_CHECKING:
    from websockets.asyncio.server import Server, ServerConnection
    from websockets.http11 import Request, Response

STATIC = Path(__file__).parent / "static"
FILES = {"/": "index.html", "/kiosk": "kiosk.html"} | {
    f"/{name}": name for name in ("page.js", "kiosk.js", "steadypose.js", "steadypose.d.ts")
}
"""Served files by path; no other path is served."""
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'unsafe-inline'; img-src data:; connect-src 'self' {}; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
MAX_CLIENTS = 16
EVENTS_KEPT = 64  # largest number of event messages in a client's queue. Newer ones do not replace them.
STREAMS_KEPT = 64  # largest number of streams whose newest message is kept for clients that connect later


class WebServer:
    """HTTP and WebSocket at one port (0: any free one), for clients that give the token.

    Requests must call ``host``, this machine's own names, or one of ``names``. ``url`` is the page's address, with the
    token; ``dropped`` counts the messages dropped for slow clients.
    """

    def __init__(self, host: str, port: int, names: Collection[str], token: str, greeting: str) -> None:
        self._token, self._greeting = token, greeting
        self._clients: set[_Client] = set()
        self._latest: dict[str, str] = {}
        self._faults: set[str] = set()
        self.dropped = 0
        self._names = own_names(host, *names)
        started: Future[Server] = Future()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve(host, port, started)), daemon=True)
        self._thread.start()
        try:
            server = started.result(20)
        except OSError as error:
            raise LaunchError(port_taken("web", host, port, error)) from error
        self.port = next(iter(server.sockets)).getsockname()[1]
        self.url = f"http://{shown(host)}:{self.port}/#{token}"

    @property
    def clients(self) -> int:
        """Number of connected clients."""
        return len(self._clients)

    def send(self, stream: str, text: str, *, replaces: bool) -> None:
        """Send a message as JSON to all clients, and say whether it replaces an unsent older one of its stream."""
        self._loop.call_soon_threadsafe(self._offer, stream, text, replaces)

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._closing.set)
        self._thread.join(10)

    def _offer(self, stream: str, text: str, replaces: bool) -> None:
        self._latest[stream] = text
        if len(self._latest) > STREAMS_KEPT:
            del self._latest[next(iter(self._latest))]
        for client in self._clients:
            self.dropped += client.offer(stream, text, replaces)

    async def _serve(self, host: str, port: int, started: Future[Server]) -> None:
        from websockets.asyncio.server import serve

        logging.getLogger("websockets").setLevel(logging.WARNING)  # it logs every connection
        self._loop, self._closing = asyncio.get_running_loop(), asyncio.Event()
        self._loop.set_exception_handler(self._log_once)
        try:
            # clients send nothing; no compression, because it takes 300 kB per client and most are on this machine
            server = await serve(
                self._talk, host, port, process_request=self._respond, compression=None, max_size=1024, max_queue=1,
                close_timeout=1,
            )  # fmt: skip
        except OSError as error:
            started.set_exception(error)
            return
        async with server:
            started.set_result(server)
            await self._closing.wait()

    def _log_once(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Log the first fault of its kind. Without a free file descriptor, asyncio reports a hundred in a second."""
        if context["message"] not in self._faults:
            self._faults.add(context["message"])
            loop.default_exception_handler(context)

    async def _talk(self, connection: ServerConnection) -> None:
        from websockets.exceptions import ConnectionClosed

        client = _Client()
        for stream, text in self._latest.items():
            client.offer(stream, text, True)
        self._clients.add(client)
        feeding = asyncio.create_task(_feed(connection, client, self._greeting))
        try:
            with suppress(ConnectionClosed):
                while True:  # what a client sends is discarded, but read: behind it are pongs and the close frame
                    await connection.recv(decode=False)
        finally:
            self._clients.remove(client)
            feeding.cancel()
            await asyncio.gather(feeding, return_exceptions=True)

    def _respond(self, connection: ServerConnection, request: Request) -> Response | None:
        """The response to a request; None upgrades it to a WebSocket."""
        host = ", ".join(request.headers.get_all("Host"))
        own = called(host, self._names)
        if own is None:
            return connection.respond(
                HTTPStatus.MISDIRECTED_REQUEST,
                f"not served under the name {host!r}: add it to [web] names if browsers reach this machine by it\n",
            )
        path, _, query = request.path.partition("?")
        if path != "/ws":
            there = f"there are {', '.join(FILES)}, and the WebSocket /ws\n"
            return _file(FILES[path], own) if path in FILES else connection.respond(HTTPStatus.NOT_FOUND, there)
        if not is_token(parse_qs(query).get("token", [""])[0], self._token):
            return connection.respond(
                HTTPStatus.UNAUTHORIZED, "expected /ws?token=TOKEN, with the token after the # of the printed address\n"
            )
        if len(self._clients) >= MAX_CLIENTS:
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, f"there are {MAX_CLIENTS} clients already\n")
        return None


class _Client:
    """The queue of one client."""

    def __init__(self) -> None:
        self._newest: dict[str, str] = {}
        self._queue: deque[str] = deque(maxlen=EVENTS_KEPT)
        self._waiting = asyncio.Event()

    def offer(self, stream: str, text: str, replaces: bool) -> int:
        """Queue a message. Returns the number of messages dropped for it."""
        if replaces:
            dropped = int(self._newest.pop(stream, None) is not None)
            self._newest[stream] = text
        else:
            dropped = int(len(self._queue) == EVENTS_KEPT)
            self._queue.append(text)
        self._waiting.set()
        return dropped

    async def next(self) -> str:
        """The next message to send: events first, then the newest of each stream in turn."""
        while not self._queue and not self._newest:
            self._waiting.clear()
            await self._waiting.wait()
        return self._queue.popleft() if self._queue else self._newest.pop(next(iter(self._newest)))


async def _feed(connection: ServerConnection, client: _Client, greeting: str) -> None:
    """Send queued messages until the connection is closed."""
    await connection.send(greeting)
    while True:
        await connection.send(await client.next())


def _file(name: str, host: str) -> Response:
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    body = (STATIC / name).read_bytes()
    kind = "text/javascript" if name.endswith(".js") else mimetypes.guess_type(name)[0] or "text/plain"
    headers = Headers(
        {
            "Content-Type": f"{kind}; charset=utf-8",
            "Content-Length": str(len(body)),
            "Content-Security-Policy": POLICY.format(f"ws://{host}"),
            "Cache-Control": "no-cache",
            "Connection": "close",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
        }
    )
    if name.startswith("steadypose."):
        headers["Access-Control-Allow-Origin"] = "*"  # so that users' own pages on other hosts can import it
    return Response(HTTPStatus.OK, "OK", headers, body)
