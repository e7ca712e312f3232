"""The format html: a page with the run's file inside it, or beside it."""

from __future__ import annotations

import base64
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from export_checks import FACTS, Falling, usual_splats
from motion_checks import model_of

from gsdmsr_cli.exports import export, html
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.options.strict import Located

FILE = b"dsplat\r\n and more"


@pytest.fixture(autouse=True)
def coded(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Leave baking and coding to the tests of those; returns the options that it is called with."""
    asked: list[Any] = []

    def file_of(source: Any, facts: Any, options: Any, on_progress: Any) -> bytes:
        asked.append(options)
        return FILE

    monkeypatch.setattr(html, "file_of", file_of)
    return asked


@dataclass(frozen=True)
class Run:
    """What the command tells of a run, as far as a page wants to know."""

    held: bytes | None
    bound: float = FACTS.bound
    frames: int = FACTS.frames

    def file(self) -> bytes | None:
        return self.held


def write(out: Path, held: bytes | None = None, **settings: Any) -> list[Path]:
    model = model_of(usual_splats(3, 0), Falling())
    return export("html", model, Run(held), Located(settings), out).files


def test_the_page_holds_the_file(tmp_path: Path, coded: list[Any]) -> None:
    out = tmp_path / "made" / "a run.html"
    assert write(out, loss=0.2) == [out] == list(out.parent.iterdir())
    text = out.read_text("utf-8")
    held = re.search(r'<script type="text/plain" id="file">([^<]*)</script>', text)
    assert held and base64.b64decode(held[1]) == FILE
    assert "<title>a run</title>" in text and coded[0].loss == 0.2


def test_a_file_is_held_as_it_is(tmp_path: Path, coded: list[Any]) -> None:
    out = tmp_path / "page.html"
    write(out, held=b"dsplat\r\n of before")
    assert base64.b64encode(b"dsplat\r\n of before").decode() in out.read_text("utf-8")
    assert not coded


@pytest.mark.parametrize(
    ("url", "name"),
    [
        ("b.dsplat", "b.dsplat"), ("../files/b%20c.dsplat?version=2", "b c.dsplat"),
        ("https://example.org/d.dsplat", "d.dsplat"),
    ],
)  # fmt: skip
def test_the_file_lies_beside_a_page_that_names_it(tmp_path: Path, url: str, name: str) -> None:
    out = tmp_path / "page.html"
    assert write(out, embed=url) == [out, tmp_path / name]
    assert (tmp_path / name).read_bytes() == FILE
    text = out.read_text("utf-8")
    assert f'data-url="{url}"' in text and base64.b64encode(FILE).decode() not in text


@pytest.mark.parametrize("url", ["", "folder/", "scene.ply", "https://example.org"])
def test_what_is_named_is_such_a_file(tmp_path: Path, url: str) -> None:
    with pytest.raises(UsageError, match=r"embed is .* whose name ends in \.dsplat"):
        write(tmp_path / "page.html", embed=url)
    with pytest.raises(UsageError, match=r"does not end in \.html"):
        write(tmp_path / "page.htm")
    assert not list(tmp_path.iterdir())
