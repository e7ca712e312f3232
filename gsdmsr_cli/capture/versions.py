"""Lists the versions of the packages that a scene folder depends on."""

from __future__ import annotations

from importlib import metadata

from gsdmsr_cli import __version__

_PACKAGES = ("numpy", "opencv-contrib-python-headless", "OpenImageIO", "pycolmap")


def versions() -> dict[str, str]:
    """Return the versions of gsdmsr and of the packages that decode, match and map."""
    return {"gsdmsr": __version__, **{name: metadata.version(name) for name in _PACKAGES}}
