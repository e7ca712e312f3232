"""Weights are fetched whole and checked, or not at all; from a server on this machine."""

from __future__ import annotations

import hashlib
import http.server
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from gsdmsr_cli.evaluation import weights
from gsdmsr_cli.evaluation.lpips import NETS
from gsdmsr_cli.evaluation.weights import Source, fetch, source
from gsdmsr_cli.ground.errors import DataError

CONTENT = bytes(range(256)) * 9000


class Handler(http.server.BaseHTTPRequestHandler):
    """Serves CONTENT; /short breaks off in the middle of it."""

    def do_GET(self) -> None:
        if self.path == "/absent":
            self.send_error(404)
            return
        self.send_response(200)
        self.send_header("Content-Length", str(len(CONTENT)))
        self.end_headers()
        self.wfile.write(CONTENT[: 5000 if self.path == "/short" else None])

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with http.server.HTTPServer(("127.0.0.1", 0), Handler) as httpd:
        thread = threading.Thread(target=httpd.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{httpd.server_port}"
        httpd.shutdown()
        thread.join()


HASH = hashlib.sha256(CONTENT).hexdigest()


def test_a_file_is_fetched_and_told_of(server: str, tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    wanted = Source(f"{server}/a", "a.pth", HASH[:8])
    fetched = fetch(wanted, tmp_path / "new", lambda *numbers: told.append(numbers))
    assert fetched.path == tmp_path / "new" / "a.pth" and fetched.path.read_bytes() == CONTENT
    assert (fetched.size, fetched.sha256) == (len(CONTENT), HASH)
    assert told[-1] == (len(CONTENT), len(CONTENT)) and len(told) > 1
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["a.pth"]


@pytest.mark.parametrize(
    ("path", "message"), [("wrong", "has SHA-256 "), ("short", "SHA-256"), ("absent", "Not Found")]
)
def test_what_is_not_right_is_not_kept(
    server: str, tmp_path: Path, path: str, message: str
) -> None:
    expected = "0" * 64 if path == "wrong" else HASH
    (tmp_path / "a.pth").write_bytes(b"before")
    with pytest.raises(DataError, match=message) as caught:
        fetch(Source(f"{server}/{path}", "a.pth", expected), tmp_path, lambda *_: None)
    assert "\n" not in str(caught.value) and f"{server}/{path}" in str(caught.value)
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [("a.pth", b"before")]


def test_without_a_network_the_place_for_the_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"cannot be fetched: .*refused.*gsdmsr weights looks"):
        fetch(Source("http://127.0.0.1:9/a", "a.pth", ""), tmp_path, lambda *_: None)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("net", NETS)
def test_sources_are_those_of_torchvision_and_of_the_authors(net: str) -> None:
    trunk, linear = source(net, "trunk"), source(net, "linear")
    assert trunk.url == weights.TRUNKS + trunk.name and f"-{trunk.sha256}.pth" in trunk.name
    assert linear.url.endswith(f"/v0.1/{net}.pth") and len(linear.sha256) == 64


@pytest.mark.parametrize("net", NETS)
def test_the_hashes_are_those_of_the_published_layers(net: str, shared_data: Path) -> None:
    content = (shared_data / "lpips" / "linear" / f"{net}.pth").read_bytes()
    assert hashlib.sha256(content).hexdigest() == source(net, "linear").sha256
