"""gsdmsr doctor: reports what this machine offers, and why the rest is missing."""

from __future__ import annotations

import platform
from importlib import metadata
from typing import Any

import llvmlite.binding as llvm
from rich.markup import escape
from rich.table import Table

from gsdmsr_cli import __version__, raster
from gsdmsr_cli.backends.cuda import availability
from gsdmsr_cli.evaluation.lpips import NETS, load_lpips
from gsdmsr_cli.evaluation.metrics import Missing
from gsdmsr_cli.filming.encode import require_encoder
from gsdmsr_cli.filming.request import VIDEOS
from gsdmsr_cli.ground import origin, plugins, say
from gsdmsr_cli.ground.errors import GsdmsrError
from gsdmsr_cli.ground.limits import cores
from gsdmsr_cli.options import preset_files

_PACKAGES = (
    "torch",
    "numba",
    "llvmlite",
    "numpy",
    "opencv-contrib-python-headless",
    "OpenImageIO",
    "pycolmap",
    "av",
    "safetensors",
    "PyYAML",
    "typer",
    "rich",
)
_SIMD = ("sse4.2", "avx", "avx2", "fma", "avx512f", "neon", "sve")
_DEVICES = ("cpu", "cuda")
_PLUGINS = ("gsdmsr_cli.model.motion", "gsdmsr_cli.formats", "gsdmsr_cli.exports")


def run() -> None:
    """Print the report."""
    report = examine()
    say.result(report, _table(report))


def examine() -> dict[str, Any]:
    """Return the report, fit for JSON; what is unavailable has a reason, what works has null."""
    return {
        "gsdmsr": __version__,
        "commit": origin.commit(),
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.release()} {platform.machine()}",
        "cpu": {"name": llvm.get_host_cpu_name(), "cores": cores(), "simd": _simd()},
        "gpu": availability.describe(),
        "packages": {name: _version(name) for name in _PACKAGES},
        "engines": {name: _engine(name) for name in raster.engine_names()},
        "lpips": {net: _lpips(net) for net in NETS},
        "plugins": {package.rpartition(".")[2]: plugins.names(package) for package in _PLUGINS},
        "presets": preset_files.preset_names(),
        "videos": {kind: _video(kind) for kind in VIDEOS},
    }


def _simd() -> list[str]:
    features = llvm.get_host_cpu_features()
    return [name for name in _SIMD if features.get(name)]


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _engine(name: str) -> dict[str, str | None]:
    """Return per device why the engine cannot draw on it, or None where it can."""
    try:
        engine = raster.load_engine(name)
    except ImportError as error:
        return dict.fromkeys(_DEVICES, f"cannot be imported: {error}")
    return {device: engine.unavailable(device) for device in _DEVICES}


def _lpips(net: str) -> str | None:
    """Return why LPIPS on ``net`` cannot be computed, or None where its weights load."""
    try:
        found = load_lpips(net)
    except GsdmsrError as error:
        return str(error)
    return found.reason if isinstance(found, Missing) else None


def _video(kind: str) -> str | None:
    """Return why videos of this kind cannot be written, or None where they can."""
    try:
        require_encoder(kind)
    except (GsdmsrError, ImportError) as error:
        return str(error)
    return None


def _table(report: dict[str, Any]) -> Table:
    table = Table("what", "found", title=f"gsdmsr {origin.version()}")
    cpu = report["cpu"]
    table.add_row("python", f"{report['python']} on {report['platform']}")
    table.add_row(
        "cpu", f"{cpu['name']}, {cpu['cores']} cores, {' '.join(cpu['simd']) or 'no SIMD'}"
    )
    table.add_row("gpu", _gpu(report["gpu"]))
    for name, version in report["packages"].items():
        table.add_row(name, version or "[red]missing[/]; pip install gsdmsr brings it")
    for name, devices in report["engines"].items():
        for device, reason in devices.items():
            table.add_row(f"engine {name} on {device}", _verdict(reason))
    for net, reason in report["lpips"].items():
        table.add_row(f"lpips_{net}", _verdict(reason))
    for kind, names in report["plugins"].items():
        table.add_row(kind, ", ".join(names) or "none")
    table.add_row("presets", ", ".join(report["presets"]))
    for kind, reason in report["videos"].items():
        table.add_row(f"video {kind}", _verdict(reason))
    return table


def _gpu(found: dict[str, Any]) -> str:
    if found["missing"] is not None:
        return f"[yellow]no[/]: {escape(found['missing'])}"
    return escape(
        f"{found['name']}, {found['memory_mib']} MiB, compute capability {found['capability']}; "
        f"torch for CUDA {found['cuda']}, NVRTC {found['nvrtc']}"
    )


def _verdict(reason: str | None) -> str:
    return "[green]ok[/]" if reason is None else f"[yellow]no[/]: {escape(reason)}"
