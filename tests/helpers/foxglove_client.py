"""A client of Foxglove's WebSocket, as far as tests need one."""

import json
from typing import Any

import pytest


def first_message(port: int, topic: str) -> tuple[dict[str, Any], bytes]:
    """What a server says of a topic's channel, and the first message on it."""
    client = pytest.importorskip("websockets.sync.client", reason="the extra 'web' is not installed")
    with client.connect(f"ws://localhost:{port}", subprotocols=["foxglove.sdk.v1"], max_size=None) as connection:
        offered: dict[str, dict[str, Any]] = {}
        while topic not in offered:
            told = json.loads(connection.recv(20))
            offered |= {channel["topic"]: channel for channel in told.get("channels", ())}
        asked = {"op": "subscribe", "subscriptions": [{"id": 1, "channelId": offered[topic]["id"]}]}
        connection.send(json.dumps(asked))
        while not isinstance(said := connection.recv(20), bytes) or said[0] != 1:
            # the SDK offers a channel a moment before it knows it, and refuses who subscribes in between
            if isinstance(said, str) and "unknown channel" in said.lower():
                connection.send(json.dumps(asked))
        return offered[topic], said[13:]  # after four bytes of subscription and eight of time
