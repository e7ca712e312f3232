"""The server answers what it has to whom it may, and survives everything else."""

from __future__ import annotations

import http.client
import json
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.viewing import server as serving
from gsdmsr_cli.viewing.server import MOST_CONNECTIONS, Answer, Server, document


def _broken() -> Answer:
    raise DataError("a file cannot be read")


PAGES = {
    "/": lambda: Answer("index.html", b"<p>page"),
    "/scene.dsplat": lambda: Answer("scene.dsplat", b"splats", "v1"),
    "/state.json": lambda: document("state.json", {"progress": 0.5}),
    "/nothing": lambda: None,
    "/broken": _broken,
}


@contextmanager
def serve(token: str | None = None) -> Iterator[Server]:
    server = Server("127.0.0.1", 0, PAGES, token)
    thread = threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()


@pytest.fixture
def server() -> Iterator[Server]:
    with serve() as running:
        yield running


def ask(
    server: Server, path: str, method: str = "GET", **headers: str
) -> tuple[int, bytes, http.client.HTTPMessage]:
    connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1], timeout=10)
    try:
        connection.request(
            method, path, headers={k.replace("_", "-"): v for k, v in headers.items()}
        )
        answer = connection.getresponse()
        return answer.status, answer.read(), answer.headers
    finally:
        connection.close()


def test_pages_are_answered(server: Server) -> None:
    status, body, headers = ask(server, "/")
    assert (status, body) == (200, b"<p>page")
    assert headers["Content-Type"] == "text/html; charset=utf-8"
    assert headers["X-Content-Type-Options"] == "nosniff" and headers["Cache-Control"] == "no-store"
    status, body, _ = ask(server, "/state.json?of=3")
    assert (status, json.loads(body)) == (200, {"progress": 0.5})


def test_what_a_browser_has_is_not_sent_again(server: Server) -> None:
    _, body, headers = ask(server, "/scene.dsplat")
    assert body == b"splats" and headers["ETag"] == '"v1"'
    assert ask(server, "/scene.dsplat", If_None_Match='"v1"')[:2] == (304, b"")
    assert ask(server, "/scene.dsplat", If_None_Match='"v0"')[:2] == (200, b"splats")


def test_a_head_has_no_body(server: Server) -> None:
    status, body, headers = ask(server, "/", "HEAD")
    assert (status, body, headers["Content-Length"]) == (200, b"", "7")


@pytest.mark.parametrize(
    ("path", "status", "why"),
    [
        ("/nothing", 404, "nothing yet"),
        ("/other", 404, "no such page"),
        ("/../etc/passwd", 404, "no such page"),
        ("//evil/", 404, "no such page"),
        ("/broken", 503, "a file cannot be read"),
    ],
)
def test_what_is_not_there_is_said(server: Server, path: str, status: int, why: str) -> None:
    found, body, _ = ask(server, path)
    assert found == status and why in json.loads(body)["error"]


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "", "127.0.0.1.evil.example"])
def test_a_page_from_elsewhere_may_not_read_it(server: Server, host: str) -> None:
    assert ask(server, "/", Host=host)[0] == 403


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1:80", "[::1]:80"])
def test_names_of_this_machine_are_its_own(server: Server, host: str) -> None:
    assert ask(server, "/", Host=host)[0] == 200


def test_others_need_the_token() -> None:
    with serve("secret") as server:
        assert server.address.endswith("/?token=secret")
        for path in ("/", "/?token=", "/?token=secre", "/?token=%C3%A9"):
            assert ask(server, path)[0] == 401
        assert ask(server, "/?token=secret", Host="machine.example")[0] == 200


GARBAGE = (
    b"\0\1\2\3\r\n\r\n",
    b"GET\r\n\r\n",
    b"BREW / HTTP/1.1\r\n\r\n",
    b"GET / HTTP/9\r\n\r\n",
    b"GET /" + b"a" * 70000 + b" HTTP/1.1\r\n\r\n",
    b"POST / HTTP/1.1\r\nContent-Length: 5\r\n\r\nabcde",
    b"",
)


@pytest.mark.parametrize("sent", GARBAGE, ids=range(len(GARBAGE)))
def test_garbage_does_no_harm(server: Server, sent: bytes) -> None:
    with socket.create_connection(("127.0.0.1", server.server_address[1]), timeout=10) as client:
        client.sendall(sent)
        client.shutdown(socket.SHUT_WR)
        answer = client.recv(100)
    assert not answer or b" 200 " not in answer
    assert ask(server, "/")[0] == 200


def test_too_many_connections_are_turned_away_and_the_server_lives(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ExitStack() as held:
        for _ in range(100):
            address = "127.0.0.1", server.server_address[1]
            held.enter_context(socket.create_connection(address, timeout=10))
        deadline = time.monotonic() + 10
        while threading.active_count() < MOST_CONNECTIONS and time.monotonic() < deadline:
            time.sleep(0.01)
        assert threading.active_count() < 100
    deadline = time.monotonic() + 10
    while time.monotonic() < deadline:  # until those that were held are gone
        try:
            if ask(server, "/")[0] == 200:
                return
        except (OSError, http.client.HTTPException):
            time.sleep(0.05)
    pytest.fail("the server does not answer any more")


def test_a_client_that_stalls_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serving._Handler, "timeout", 0.2)
    with serve() as server:
        address = "127.0.0.1", server.server_address[1]
        with socket.create_connection(address, timeout=10) as client:
            client.sendall(b"GET / HTTP/1.1\r\nHost: loc")  # and no more
            assert client.recv(100) == b""


def test_a_port_that_is_taken_is_an_error(server: Server) -> None:
    with pytest.raises(OSError, match="in use"):
        Server("127.0.0.1", server.server_address[1], PAGES, None)
