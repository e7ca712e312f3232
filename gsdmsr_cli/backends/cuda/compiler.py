"""From a CUDA source of the package to machine code for one architecture, kept on disk."""

from __future__ import annotations

import contextlib
import hashlib
import math
from functools import cache
from pathlib import Path

from gsdmsr_cli.backends.cuda.nvrtc import Nvrtc
from gsdmsr_cli.ground import splatting_constants as constants
from gsdmsr_cli.ground.errors import DataError, GsdmsrError
from gsdmsr_cli.ground.files import replacing
from gsdmsr_cli.ground.machine import cache_home

ROOT = Path(__file__).parents[2]
"""Where sources (.cu) and headers (.cuh) lie, in whatever folder; their names are unique."""

MOST_VIEWS = 16
"""Views that one launch can draw: cameras are passed by value, as part of a kernel's arguments."""

MOST_LEVELS = 8
"""Levels of grids that one launch can look up."""

MOST_HASH_LEVELS = 32
"""Levels of a hash grid that one launch can look up."""

MOST_TENSORS = 48
"""Tensors that one launch can move."""

OLDEST = 75
"""The oldest architecture that is compiled for and tested, sm_75 (Turing)."""

_OPTIONS = ("--std=c++17", "--ftz=true")
_CONSTANTS = (
    "NEAR", "DILATION", "ALPHA_MIN", "ALPHA_MAX", "TRANSMITTANCE_STOP", "FRUSTUM_MARGIN",
)  # fmt: skip


def sources() -> list[str]:
    """Return the names of all sources."""
    return sorted(path.stem for path in ROOT.rglob("*.cu"))


def source_path(source: str) -> Path:
    """Return where a source lies."""
    (path,) = ROOT.rglob(f"{source}.cu")
    return path


def headers() -> dict[str, Path]:
    """Return where each header lies, by the name under which sources include it."""
    return {path.name: path for path in sorted(ROOT.rglob("*.cuh"))}


def definitions() -> dict[str, str]:
    """Return the macros that every source is compiled with."""
    values = {name: f"{getattr(constants, name)!r}f" for name in _CONSTANTS}
    values["LOG2_ALPHA_MIN"] = f"{math.log2(constants.ALPHA_MIN)!r}f"
    limits = {
        "MOST_VIEWS": MOST_VIEWS, "MOST_LEVELS": MOST_LEVELS,
        "MOST_HASH_LEVELS": MOST_HASH_LEVELS, "MOST_TENSORS": MOST_TENSORS,
    }  # fmt: skip
    return values | {
        name: str(limit) for name, limit in ({"TILE": constants.TILE} | limits).items()
    }


def target(nvrtc: Nvrtc, capability: int) -> tuple[str, str]:
    """Return what to compile for on a card, as an option and as a form, see ``Nvrtc.compile``.

    A card newer than the compiler gets PTX, from which its driver makes machine code.

    Raises:
        GsdmsrError: the card is older than every architecture of the compiler.
    """
    known = nvrtc.architectures()
    if capability in known:
        return f"sm_{capability}", "CUBIN"
    older = [architecture for architecture in known if architecture < capability]
    if not older:
        raise GsdmsrError(
            f"the card is of compute capability {capability}, older than {known[0]}, the oldest "
            f"that NVRTC {nvrtc.version[0]}.{nvrtc.version[1]} compiles for; use --device cpu"
        )
    return f"compute_{older[-1]}", "PTX"


def compiled(nvrtc: Nvrtc, source: str, capability: int) -> bytes:
    """Return the program of a source, from the cache if it has been compiled before.

    Raises:
        GsdmsrError: it does not compile.
    """
    architecture, form = target(nvrtc, capability)
    path = _cache_folder(nvrtc.version) / f"{source}.{architecture}.{form.lower()}"
    if path.is_file():
        return path.read_bytes()
    program = translate(nvrtc, source, architecture, form)[0]
    with contextlib.suppress(OSError, DataError):  # what cannot be kept costs time, nothing else
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as beside:
            beside.write_bytes(program)
    return program


def translate(
    nvrtc: Nvrtc, source: str, architecture: str, form: str, *further: str
) -> tuple[bytes, str]:
    """Compile a source with ``further`` options; return the program and the compiler's log."""
    macros = [f"--define-macro={name}={value}" for name, value in definitions().items()]
    options = [f"--gpu-architecture={architecture}", *_OPTIONS, *macros, *further]
    included = {name: path.read_text(encoding="utf-8") for name, path in headers().items()}
    text = source_path(source).read_text(encoding="utf-8")
    return nvrtc.compile(f"{source}.cu", text, included, options, form)


@cache
def _cache_folder(version: tuple[int, int]) -> Path:
    """Return the folder of compiled programs; its name is a hash of all that they depend on."""
    digest = hashlib.sha256(repr((version, _OPTIONS, definitions())).encode())
    for path in (*map(source_path, sources()), *headers().values()):
        digest.update(path.name.encode() + path.read_bytes())
    return cache_home() / "cuda" / digest.hexdigest()[:16]
