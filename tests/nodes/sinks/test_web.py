import errno
import http.client
import json
import os
import secrets
import socket
import stat
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest.mock import Mock
from urllib.parse import urlsplit

import numpy as np
import pytest
from conftest import repeated, running, until
from tests.helpers.msg_strategies import diagnostics, events, raw, world
from tests.helpers.synthetic_poses import messages_on

from steadypose.msgs.topics import POSE_EVENTS, POSE_WORLD
from steadypose.msgs.transport import Publisher
from steadypose.msgs.types import EventKind, JointState
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.settings import LaunchError
from steadypose.nodes.sinks.web.node import WebNode, hello, kept_token, to_json
from steadypose.nodes.sinks.web.server import FILES, MAX_CLIENTS, STATIC, WebServer

pytest.importorskip("websockets", reason="the extra 'web' is not installed")

TOKEN = "a-token-of-this-test"


@pytest.fixture
def server() -> Iterator[WebServer]:
    server = WebServer("127.0.0.1", 0, ["kiosk.local"], TOKEN, hello())
    yield server
    server.close()


def get(server: WebServer, path: str, host: str = "127.0.0.1") -> tuple[int, dict[str, str], str]:
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=20)
    connection.request("GET", path, headers={"Host": host})
    response = connection.getresponse()
    return response.status, dict(response.getheaders()), response.read().decode()


def client(server: WebServer, token: str = TOKEN, **options: Any) -> Any:
    from websockets.sync.client import connect

    return connect(f"ws://127.0.0.1:{server.port}/ws?token={token}", open_timeout=20, **options)


def test_pages_are_served_and_may_load_nothing_from_elsewhere(server: WebServer) -> None:
    for path, name in FILES.items():
        status, headers, body = get(server, path)
        assert (status, body) == (200, (STATIC / name).read_text())
        assert "default-src 'none'" in headers["Content-Security-Policy"]
        assert f"connect-src 'self' ws://127.0.0.1:{80};" in headers["Content-Security-Policy"]
        assert "http" not in body.replace("http://127.0.0.1", "").replace("/^http/", ""), "an address of elsewhere"
    assert get(server, "/steadypose.js")[1]["Access-Control-Allow-Origin"] == "*"
    assert "Access-Control-Allow-Origin" not in get(server, "/")[1]


@pytest.mark.parametrize("path", ["/../settings.py", "/static/index.html", "//etc/passwd", "/%2e%2e/a", "/wsx", "//["])
def test_nothing_else_is_served(server: WebServer, path: str) -> None:
    assert get(server, path)[0] == 404


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost:8766", "[::1]:1", "192.168.1.7", "kiosk.local"])
def test_names_of_its_own_are_answered(server: WebServer, host: str) -> None:
    assert get(server, "/", host)[0] == 200


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example", "", "localhost:x", "evil.it:80", "[evil"])
@pytest.mark.parametrize("path", ["/", f"/ws?token={TOKEN}"])
def test_names_that_others_have_pointed_here_are_not(server: WebServer, path: str, host: str) -> None:
    assert get(server, path, host)[0] == 421


def test_a_request_that_names_two_hosts_is_refused(server: WebServer) -> None:
    with socket.create_connection(("127.0.0.1", server.port), 20) as it:
        it.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nHost: localhost\r\n\r\n")
        assert it.recv(100).startswith(b"HTTP/1.1 421")


@pytest.mark.parametrize("token", ["", "wrong", TOKEN[:-1], TOKEN + "x", "%ff"])
def test_without_the_token_nothing_is_told(server: WebServer, token: str) -> None:
    from websockets.exceptions import InvalidStatus

    with pytest.raises(InvalidStatus, match="401"), client(server, token):
        pass
    assert server.clients == 0


def test_a_client_gets_names_first_then_the_newest_of_each_stream_and_all_events(server: WebServer) -> None:
    server.send("a", '"old"', replaces=True)
    server.send("a", '"new"', replaces=True)
    server.send("b", '"b"', replaces=True)
    with client(server) as it:
        assert json.loads(it.recv(20))["topic"] == "hello"
        assert {it.recv(20), it.recv(20)} == {'"new"', '"b"'}
        server.send("a", '"newer"', replaces=True)
        assert it.recv(20) == '"newer"'
        for index in range(50):
            server.send("e", json.dumps(index), replaces=False)
        assert [json.loads(it.recv(20)) for _ in range(50)] == list(range(50)), "kept for who is slow for a moment"
        for _ in range(300):  # it may send what it likes, and leave
            it.send("x" * 1000)
        assert it.ping().wait(20)  # the pong comes after what was sent was read
    until(lambda: server.clients == 0)


def test_who_is_slow_misses_frames_that_are_counted_and_holds_up_nobody(server: WebServer) -> None:
    with client(server, max_queue=1) as slow, client(server) as fast:
        slow.recv(20)
        fast.recv(20)
        filler = "x" * 200_000
        for index in range(300):
            server.send("a", json.dumps([index, filler]), replaces=True)
            assert json.loads(fast.recv(20))[0] == index
        until(lambda: server.dropped > 100)
        last = -1
        while last < 299:  # and what it gets in the end is the newest
            index = json.loads(slow.recv(20))[0]
            assert index > last
            last = index


def test_there_are_no_more_clients_than_there_is_room_for_and_one_server_at_a_port(server: WebServer) -> None:
    from websockets.exceptions import InvalidStatus

    with ExitStack() as stack:
        for _ in range(MAX_CLIENTS):
            stack.enter_context(client(server))
        until(lambda: server.clients == MAX_CLIENTS)
        with pytest.raises(InvalidStatus, match="503"), client(server):
            pass
    until(lambda: server.clients == 0)
    with pytest.raises(LaunchError, match=f"port {server.port} at 127.0.0.1 cannot be opened"):
        WebServer("127.0.0.1", server.port, [], TOKEN, hello())


def test_what_fails_again_and_again_is_logged_once(server: WebServer, caplog: pytest.LogCaptureFixture) -> None:
    for _ in range(100):  # as asyncio does without a free file descriptor
        server._loop.call_soon_threadsafe(server._loop.call_exception_handler, {"message": "out of system resource"})
    assert get(server, "/")[0] == 200
    assert [record.message for record in caplog.records] == ["out of system resource"]


def test_messages_as_json() -> None:
    names = json.loads(hello())
    assert names["states"][JointState.IMPUTED] == "IMPUTED"
    assert names["events"][EventKind.POINTS] == "POINTS"
    assert names["vrm"][names["joints"].index("left_elbow")] == "leftLowerArm"
    message = world(1_500_000_000)
    message.bodies[0].positions[3] = np.nan
    message.bodies[0].sigma[4] = np.inf
    message.bodies[0].contacts[2] = np.nan
    as_json = json.loads(to_json(message) or "")
    (body,) = as_json["bodies"]
    assert (as_json["topic"], as_json["stamp"], as_json["frame"]) == ("pose/world", 1.5, "world")
    assert (body["id"], body["tracking"], body["positions"][2]) == (7, "COASTING", [6.0, 7.0, 8.0])
    assert body["positions"][3] == [None] * 3
    np.testing.assert_allclose(body["rotations"], message.bodies[0].rotations, atol=1e-4)
    assert body["sigma"][4] is None
    assert [contact is None for contact in body["contacts"]] == [k == 2 for k in range(8)]
    (event,) = json.loads(to_json(events()) or "")["events"]
    assert (event["kind"], event["phase"], event["hand"], event["direction"]) == ("POINTS", "BEGINS", "LEFT", [1, 0, 0])
    assert json.loads(to_json(diagnostics()) or "")["values"]["rate"] == "30.0"
    assert to_json(raw()) is None


@pytest.mark.parametrize("found_no_room", [False, True])
def test_the_token_is_kept_where_only_this_user_reads(tmp_path: Path, found_no_room: bool) -> None:
    if found_no_room:  # on the disk, when it was drawn
        (tmp_path / "token").touch(0o600)
    token = kept_token(tmp_path / "token")
    assert len(token) >= 32
    assert kept_token(tmp_path / "token") == token
    assert stat.S_IMODE((tmp_path / "token").stat().st_mode) == 0o600


def test_on_a_full_disk_a_token_is_drawn_and_not_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "write", Mock(side_effect=OSError(errno.ENOSPC, "No space left on device")))
    assert len(kept_token(tmp_path / "token")) >= 32
    assert not (tmp_path / "token").read_text()


def test_nodes_that_start_at_once_draw_one_token(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tokens: list[str] = []
    other = threading.Thread(target=lambda: tokens.append(kept_token(tmp_path / "token")))
    draw = secrets.token_urlsafe

    def while_another_starts(length: int) -> str:
        if not other.ident:
            other.start()
            other.join(0.2)  # it waits for this token
        return draw(length)

    monkeypatch.setattr(secrets, "token_urlsafe", while_another_starts)
    tokens.append(kept_token(tmp_path / "token"))
    other.join()
    assert len(set(tokens)) == 1


def test_the_node_serves_what_the_others_publish(make_launch: Callable[..., Launch]) -> None:
    launch = make_launch(nodes='["trajectory", "events", "web"]', web__port="0", transport__lossless="false")
    node, topics, last = WebNode(launch), set(), messages_on(POSE_WORLD, 1.0)[-1]
    with (
        Publisher(launch.transport.endpoint("trajectory")) as trajectory,
        Publisher(launch.transport.endpoint("events")) as others,
        running(node),
    ):
        until(lambda: bool(node.url))
        assert node._server is not None
        token = urlsplit(node.url).fragment

        def publish() -> None:
            trajectory.publish(POSE_WORLD, last)
            others.publish(POSE_EVENTS, events())

        with repeated(publish), client(node._server, token) as it:
            while not topics >= {"hello", POSE_WORLD, POSE_EVENTS}:
                topics.add(json.loads(it.recv(20))["topic"])
        assert node.status()["dropped.slow client"].isdecimal()
