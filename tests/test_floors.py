"""Imports inside the package point down only, and plug-ins leave one another alone."""

from __future__ import annotations

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import gsdmsr_cli

PACKAGE = Path(gsdmsr_cli.__file__).parent
PLUGINS = ("motion", "raster", "formats", "exports", "paths")


def imports(path: Path, root: Path = PACKAGE) -> set[str]:
    """Return the modules that a file imports, wherever in it, with full names."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            module = node.module or ""
            assert not node.level, f"{path}: imports are absolute"
            names = {f"{module}.{alias.name}" for alias in node.names}
            modules = {n for n in names if is_module(n, root)}
            found |= modules if modules and modules == names else {module} | modules
    return found


def is_module(name: str, root: Path) -> bool:
    relative = root.parent.joinpath(*name.split("."))
    return relative.is_dir() or relative.with_suffix(".py").is_file()


def name_of(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {name_of(path): imports(path) for path in sorted(PACKAGE.rglob("*.py"))}


def floor(module: str) -> str:
    """Return the folder or file right inside the package that a module belongs to."""
    return module.split(".")[1] if "." in module else ""


def test_all_modules_are_found() -> None:
    assert {"gsdmsr_cli.cli", "gsdmsr_cli.motion", "gsdmsr_cli.kernels.simd"} <= MODULES.keys()
    assert "gsdmsr_cli.motion" in MODULES["gsdmsr_cli.model"]
    assert "gsdmsr_cli.kernels.planes" in MODULES["gsdmsr_cli.fields.planes"]
    assert "gsdmsr_cli.fields.planes" in MODULES["gsdmsr_cli.motion.hexplane"]


def test_there_is_no_circle_between_floors() -> None:
    graph: dict[str, set[str]] = {}
    for module, imported in MODULES.items():
        own = {floor(name) for name in imported if name.startswith("gsdmsr_cli.")}
        graph.setdefault(floor(module), set()).update(own - {floor(module), ""})
    assert len(list(TopologicalSorter(graph).static_order())) == len(graph)  # or CycleError


@pytest.mark.parametrize("kind", PLUGINS)
def test_kinds_of_plugins_do_not_import_one_another(kind: str) -> None:
    others = set(PLUGINS) - {kind}
    for module, imported in MODULES.items():
        if floor(module) == kind:
            assert not {floor(name) for name in imported if "gsdmsr_cli" in name} & others, module


@pytest.mark.parametrize("kind", PLUGINS)
def test_plugins_do_not_import_their_siblings(kind: str) -> None:
    package = f"gsdmsr_cli.{kind}"
    plugins = {m for m in MODULES if m.startswith(f"{package}.") and "._" not in m}
    assert plugins
    for module in plugins:
        assert not MODULES[module] & (plugins - {module}), module


def test_kernels_know_nothing_of_torch() -> None:
    for module, imported in MODULES.items():
        if floor(module) == "kernels":
            assert not {name.split(".")[0] for name in imported} & {"torch"}, module


def test_one_module_keeps_the_order_in_which_native_libraries_are_imported() -> None:
    ordered = {"cv2", "OpenImageIO", "pycolmap", "av"}
    importing = {module for module, imported in MODULES.items() if imported & ordered}
    assert importing == {"gsdmsr_cli.native"}


def test_the_command_line_imports_commands_only_when_they_run() -> None:
    tree = ast.parse((PACKAGE / "cli.py").read_text(encoding="utf-8"))
    top = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
    names = {node.module for node in top if isinstance(node, ast.ImportFrom)}
    assert not any(name and name.startswith("gsdmsr_cli.commands") for name in names)
