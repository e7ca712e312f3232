"""Puts the player's files together into one HTML text that plays a file of moving splats."""

from __future__ import annotations

import base64
import json
import re
from html import escape
from importlib import resources
from urllib.parse import urlsplit

from gsdmsr_cli.ground import splatting_constants

SCRIPTS = (
    "vectors", "figures", "decode", "moving", "tables", "sort", "worker", "helper", "shaders",
    "draw", "camera", "player", "controls", "live", "page", "main",
)  # fmt: skip
"""The modules of the script, each after those whose values it needs when it is read."""

_CONSTANTS = "NEAR", "DILATION", "ALPHA_MIN", "ALPHA_MAX", "FRUSTUM_MARGIN"

_POLICY = (
    "default-src 'none'; img-src data: blob:{pictures}; style-src 'unsafe-inline'; "
    "script-src 'unsafe-inline'; worker-src blob:; connect-src {origin}"
)


def page(data: bytes | None, embed_url: str | None, title: str, live: bool = False) -> str:
    """Return the page.

    Args:
        data: a file of moving splats (docs/file-format.md) that the page is to hold.
        embed_url: where the page finds the file in place of that, from where it lies itself.
        title: of the window, plain text.
        live: whether a server answers beside it how a training stands, see ``viewing``.

    Raises:
        ValueError: there are both data and a URL, or neither.
    """
    if (data is None) == (embed_url is None):
        raise ValueError("a page holds the data or the URL of a file, one of them")
    texts = {
        "policy": _POLICY.format(
            origin="'none'" if embed_url is None else _origin(embed_url),
            pictures=" 'self'" if live else "",
        ),
        "title": escape(title),
        "style": _text("page.css"),
        "url": ("" if embed_url is None else f' data-url="{escape(embed_url)}"')
        + (" data-live" if live else ""),
        "data": "" if data is None else base64.b64encode(data).decode("ascii"),
        "script": script(),
    }
    return re.sub(r"\{(\w+)\}", lambda found: texts[found[1]], _text("page.html"))


def script() -> str:
    """Return the script of the page and its worker: all modules as one, with the constants."""
    constants = {name: getattr(splatting_constants, name) for name in _CONSTANTS}
    known = f"const SPLATTING = {json.dumps(constants)};"
    modules = "\n".join(map(_module, SCRIPTS))
    return f'(() => {{\n"use strict";\n\n{known}\n\n{modules}}})();\n'


def _module(name: str) -> str:
    """Return a module as a part of a script that has all of them: no imports, no exports."""
    without = re.sub(r"^import [^;]*;\n", "", _text(f"{name}.js"), flags=re.MULTILINE)
    return re.sub(r"^export ", "", without, flags=re.MULTILINE)


def _origin(url: str) -> str:
    """Return from where a page may fetch a URL, as its policy says it."""
    parts = urlsplit(url)
    return f"{parts.scheme}://{parts.netloc}" if parts.netloc and parts.scheme else "'self'"


def _text(name: str) -> str:
    return resources.files(__package__).joinpath(name).read_text("utf-8")
