"""Writes a page that plays the splats in a browser, with the ``.dsplat`` inside it or beside it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import cast
from urllib.parse import unquote, urlsplit

from gsdmsr_cli.exports import _played
from gsdmsr_cli.exports._facts import Facts, RunFacts
from gsdmsr_cli.exports._moment import require_suffix, write_bytes
from gsdmsr_cli.exports._played import file_of, lost
from gsdmsr_cli.exports._source import Source
from gsdmsr_cli.ground.progress import OnProgress
from gsdmsr_cli.moving.container import SUFFIX
from gsdmsr_cli.options.strict import require
from gsdmsr_cli.player.page import page

BAKES = True

__all__ = ["BAKES", "Options", "lost", "write"]


@dataclass(frozen=True)
class Options(_played.Options):
    """Settings.

    Attributes:
        embed: URL of the file from where the page is, if the page is not to hold it; it is then
            written beside the page, under its name in the URL.
    """

    embed: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        named = self.embed is None or _name(self.embed).endswith(SUFFIX)
        require(self, "embed", named, f"the URL of a file whose name ends in {SUFFIX}")


def write(
    source: Source, facts: Facts, options: Options, out: Path, on_progress: OnProgress
) -> list[Path]:
    """Write the page, and the file if that is to lie beside it; of a file that file as it is.

    Raises:
        UsageError: ``out`` does not end in .html, or something is asked for that the file has not.
        DataError: a splat holds NaN or infinity, the finest coding loses too much, or a file
            cannot be written.
    """
    require_suffix(out, "html", ".html")
    data = cast(RunFacts, facts).file() or file_of(source, facts, options, on_progress)
    if options.embed is None:
        return write_bytes(out, page(data, None, out.stem).encode())
    beside = write_bytes(out.with_name(_name(options.embed)), data)
    return write_bytes(out, page(None, options.embed, out.stem).encode()) + beside


def _name(url: str) -> str:
    """Return the name of the file that a URL leads to."""
    return PurePosixPath(unquote(urlsplit(url).path)).name
