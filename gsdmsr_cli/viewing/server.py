"""A small HTTP server for the page of a run: a few addresses, read only, on this machine alone.

It is Python's own, with what that leaves to its user: a bound on connections and on how long one
may be silent, a check of the name that a browser was told (a page from elsewhere may not read this
one by a name of its own for this machine), and a token wherever others than this machine come in.
"""

from __future__ import annotations

import hmac
import json
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

from gsdmsr_cli import __version__
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import GsdmsrError

LOOPBACK = {"127.0.0.1", "localhost", "::1"}

MOST_CONNECTIONS = 32
"""At once; others are told to come again."""

LONGEST = 20.0
"""That a connection may be silent [s]."""

KINDS = {"html": "text/html; charset=utf-8", "json": "application/json", "png": "image/png"}
"""Media types by the ends of names; others are bytes."""


@dataclass(frozen=True)
class Answer:
    """What is sent.

    Attributes:
        name: whose end says what kind of data it is.
        data: the body.
        version: of the data; a browser that has it already is not sent it again. None if it is not
            to be kept.
    """

    name: str
    data: bytes
    version: str | None = None


Pages = Mapping[str, Callable[[], Answer | None]]
"""By the path of the address, what answers; None says that there is nothing (yet)."""


def document(name: str, value: Any) -> Answer:
    """Return plain JSON as an answer."""
    return Answer(name, json.dumps(value, allow_nan=False).encode())


class Server(ThreadingHTTPServer):
    """Serves pages until it is told to stop."""

    daemon_threads = True
    request_queue_size = MOST_CONNECTIONS

    def __init__(self, host: str, port: int, pages: Pages, token: str | None) -> None:
        """Listen.

        Args:
            host: address to listen at.
            port: to listen at; 0 takes a free one.
            pages: what there is.
            token: that every address must be asked with; None where nobody else comes in.

        Raises:
            OSError: nobody may listen there, or somebody does already.
        """
        self.pages, self.token = pages, token
        self._free = threading.BoundedSemaphore(MOST_CONNECTIONS)
        super().__init__((host, port), _Handler)

    @property
    def address(self) -> str:
        """Where a browser finds it."""
        host, port = self.server_address[:2]
        token = "" if self.token is None else f"?token={self.token}"
        return f"http://{host!s}:{port}/{token}"

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a thread, unless there are too many."""
        if not self._free.acquire(blocking=False):
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer, and make room for another."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing: a connection has broken off."""


class _Handler(BaseHTTPRequestHandler):
    server: Server
    protocol_version = "HTTP/1.1"
    server_version = f"gsdmsr/{__version__}"
    sys_version = ""
    timeout = LONGEST

    def do_GET(self) -> None:
        """Answer a request for one of the pages."""
        self._answer(with_body=True)

    def do_HEAD(self) -> None:
        """Answer without the body."""
        self._answer(with_body=False)

    def _answer(self, with_body: bool) -> None:
        asked = urlsplit(self.path)
        if not self._is_for_us():
            self._refuse(HTTPStatus.FORBIDDEN, "this server answers to its own address only")
        elif not self._may(parse_qs(asked.query)):
            self._refuse(HTTPStatus.UNAUTHORIZED, "the address lacks its token")
        elif asked.path not in self.server.pages:
            self._refuse(HTTPStatus.NOT_FOUND, "there is no such page")
        else:
            self._send(self.server.pages[asked.path], with_body)

    def _is_for_us(self) -> bool:
        """Return whether the browser was told one of our names; without a token only those."""
        if self.server.token is not None:
            return True
        host = urlsplit(f"//{self.headers.get('Host', '')}").hostname
        return host in LOOPBACK

    def _may(self, query: Mapping[str, list[str]]) -> bool:
        token = self.server.token
        given = query.get("token", [""])[0]
        return token is None or hmac.compare_digest(given.encode(), token.encode())

    def _send(self, make: Callable[[], Answer | None], with_body: bool) -> None:
        try:
            answer = make()
        except GsdmsrError as error:
            self._refuse(HTTPStatus.SERVICE_UNAVAILABLE, str(error))
            return
        if answer is None:
            self._refuse(HTTPStatus.NOT_FOUND, "there is nothing yet")
            return
        tag = None if answer.version is None else f'"{answer.version}"'
        if tag is not None and self.headers.get("If-None-Match") == tag:
            self._head(HTTPStatus.NOT_MODIFIED, None, 0, tag)
            return
        kind = KINDS.get(answer.name.rpartition(".")[2], "application/octet-stream")
        self._head(HTTPStatus.OK, kind, len(answer.data), tag)
        if with_body:
            self.wfile.write(answer.data)

    def _refuse(self, status: HTTPStatus, why: str) -> None:
        body = json.dumps({"error": why}).encode()
        self._head(status, KINDS["json"], len(body), None)
        if self.command != "HEAD":
            self.wfile.write(body)

    def _head(self, status: HTTPStatus, kind: str | None, length: int, tag: str | None) -> None:
        self.send_response(status)
        if kind is not None:
            self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(length))
        self.send_header("Cache-Control", "no-cache" if tag else "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Referrer-Policy", "no-referrer")
        if tag is not None:
            self.send_header("ETag", tag)
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        """Tell of requests only where details are wanted."""
        say.detail(f"view: {format % args}")
