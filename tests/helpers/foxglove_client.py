"""A client of Foxglove's WebSocket, as far as tests need one."""

from __future__ import annotations

import base64
import json
import os
import socket
import struct
from typing import Any


class FoxgloveClient:
    """A client of as much of RFC 6455 as Foxglove's server speaks."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=20)
        key = base64.b64encode(os.urandom(16)).decode()
        self._socket.sendall(
            f"GET / HTTP/1.1\r\nHost: localhost:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n"
            f"Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n".encode()
        )
        self._file = self._socket.makefile("rb")
        assert b"101" in self._file.readline()
        while self._file.readline().strip():
            pass

    def channels(self, *topics: str) -> dict[str, dict[str, Any]]:
        """Wait until all of these are offered; what is said of each channel by then, by topic."""
        offered: dict[str, dict[str, Any]] = {}
        while not set(topics) <= set(offered):
            kind, data = self._receive()
            if kind == 1 and (told := json.loads(data))["op"] == "advertise":
                offered |= {channel["topic"]: channel for channel in told["channels"]}
        return offered

    def first(self, channel: dict[str, Any]) -> bytes:
        """Subscribe to a channel and wait for a message.

        The SDK offers a channel a moment before it knows it, and refuses who subscribes in between.
        """
        self._subscribe(channel)
        while True:
            kind, data = self._receive()
            if kind == 2 and data[0] == 1:  # then four bytes of subscription and eight of time
                return data[13:]
            if kind == 1 and (told := json.loads(data))["op"] == "status":
                assert "unknown channel" in told["message"].lower(), told
                self._subscribe(channel)

    def _subscribe(self, channel: dict[str, Any]) -> None:
        asked = {"op": "subscribe", "subscriptions": [{"id": 1, "channelId": channel["id"]}]}
        data = json.dumps(asked).encode()
        assert len(data) < 126
        self._socket.sendall(bytes([0x81, 0x80 | len(data), 0, 0, 0, 0]) + data)

    def close(self) -> None:
        self._file.close()
        self._socket.close()

    def _receive(self) -> tuple[int, bytes]:
        first, second = self._file.read(2)
        length = second & 0x7F
        if length > 125:
            (length,) = struct.unpack(">H" if length == 126 else ">Q", self._file.read(2 if length == 126 else 8))
        return first & 0x0F, self._file.read(length)
