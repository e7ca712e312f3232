"""Downloads the weights of LPIPS, when the user asks for them, and checks their hashes."""

from __future__ import annotations

import hashlib
import http.client
import re
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from gsdmsr_cli.evaluation.lpips_trunks import ARCHITECTURES
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.files import replacing, require_folder
from gsdmsr_cli.ground.progress import OnProgress

TRUNKS = "https://download.pytorch.org/models/"
"""Where torchvision has its weights; their names carry the beginning of their hash."""

LINEAR = (
    "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/master/lpips/weights/v0.1/"
)
"""Where the authors of LPIPS have the layers on top."""

_LINEAR_HASHES = {
    "alex": "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0",
    "squeeze": "4a5350f23600cb79923ce65bb07cbf57dca461329894153e05a1346bd531cf76",
    "vgg": "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868",
}
_CHUNK = 1 << 20
_TIMEOUT = 30.0


@dataclass(frozen=True)
class Source:
    """A file of weights on the net.

    Attributes:
        url: where it is.
        name: what it is called on disk.
        sha256: its hash, or how that begins, in hexadecimal digits.
    """

    url: str
    name: str
    sha256: str


@dataclass(frozen=True)
class Fetched:
    """A file that has been fetched: where it lies, its size [bytes] and its SHA-256."""

    path: Path
    size: int
    sha256: str


def source(net: str, kind: str) -> Source:
    """Return where the "trunk" or the "linear" layers of a network come from."""
    if kind == "linear":
        return Source(f"{LINEAR}{net}.pth", f"lpips_{net}.pth", _LINEAR_HASHES[net])
    name = ARCHITECTURES[net].checkpoint
    found = re.search(r"-([0-9a-f]{8})\.pth$", name)
    assert found, name
    return Source(TRUNKS + name, name, found[1])


def fetch(wanted: Source, folder: Path, on_progress: OnProgress) -> Fetched:
    """Download a file into a folder, which is made; it is there whole and checked, or not at all.

    Raises:
        DataError: it cannot be reached, is not what it should be, or cannot be written.
    """
    require_folder(folder, "choose another --to or change the rights")
    path, digest, size = folder / wanted.name, hashlib.sha256(), 0
    with replacing(path) as beside, beside.open("wb") as file:
        for chunk in _download(wanted.url, on_progress):
            digest.update(chunk)
            size += len(chunk)
            file.write(chunk)
        found = digest.hexdigest()
        if not found.startswith(wanted.sha256):
            raise DataError(
                f"{wanted.url}: has SHA-256 {found}, not {wanted.sha256}...; nothing is kept: try "
                f"again, or put the file into {folder} by hand"
            )
    return Fetched(path, size, found)


def _download(url: str, on_progress: OnProgress) -> Iterator[bytes]:
    try:
        with urllib.request.urlopen(url, timeout=_TIMEOUT) as response:
            total, done = int(response.headers.get("Content-Length", 0)), 0
            while chunk := response.read(_CHUNK):
                done += len(chunk)
                on_progress(done, total)
                yield chunk
    except (OSError, http.client.HTTPException) as error:
        reason = getattr(error, "reason", None) or error
        raise DataError(
            f"{url}: cannot be fetched: {reason}; without a network, put the file where "
            "gsdmsr weights looks"
        ) from error
