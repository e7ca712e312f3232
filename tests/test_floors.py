"""Imports inside the package point down only, and plug-ins leave one another alone."""

from __future__ import annotations

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import gsdmsr_cli
from gsdmsr_cli.backends.cpu import jit

PACKAGE = Path(gsdmsr_cli.__file__).parent
ROOMS = (
    "ground", "backends", "options", "gaussians", "scene", "ops", "raster", "model", "moving",
    "drawing", "runs", "formats", "player", "exports", "paths", "evaluation", "filming",
    "viewing",
    "reporting", "training", "capture", "demo", "calling", "benchmark", "commands", "cli",
)  # fmt: skip
"""The folders of the package, from the ground up: each imports only from those before it."""

PLUGINS = (
    "model.motion", "model.layers", "raster", "formats", "exports", "paths", "training.losses",
    "training.population",
)  # fmt: skip
"""Folders of the package whose files are plug-ins."""

KERNELS = "ops/*/cpu.py", "ops/*/cpu/*.py", "backends/cpu/*.py"
"""Where the kernels of the CPU are."""

CONSTANTS = {"gsdmsr_cli.ground.splatting_constants", "gsdmsr_cli.ground.ssim"}
"""What is compiled into kernels besides themselves."""

FOR_KERNELS = CONSTANTS | {
    "gsdmsr_cli.backends.cpu",
    "gsdmsr_cli.backends.kernel_folder",
    "gsdmsr_cli.ground",
    "gsdmsr_cli.ground.machine",
}
"""What kernels may import besides one another."""


def imports(path: Path, root: Path = PACKAGE, only_run: bool = False) -> set[str]:
    """Return the modules that a file imports, wherever in it, with full names.

    Args:
        path: of the file.
        root: folder of the package.
        only_run: leave out what is imported for annotations or by functions.
    """
    found: set[str] = set()
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in tree.body if only_run else ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            module = node.module or ""
            assert not node.level, f"{path}: imports are absolute"
            names = {f"{module}.{alias.name}" for alias in node.names}
            modules = {n for n in names if is_module(n, root)}
            found |= modules if modules and modules == names else {module} | modules
    return found


def path_of(module: str) -> Path:
    base = PACKAGE.parent.joinpath(*module.split("."))
    return base / "__init__.py" if base.is_dir() else base.with_suffix(".py")


def parents(module: str) -> set[str]:
    """Return the packages that a module lies in, which are imported whenever it is."""
    parts = module.split(".")
    return {".".join(parts[:i]) for i in range(1, len(parts))}


def is_module(name: str, root: Path) -> bool:
    relative = root.parent.joinpath(*name.split("."))
    return relative.is_dir() or relative.with_suffix(".py").is_file()


def name_of(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {name_of(path): imports(path) for path in sorted(PACKAGE.rglob("*.py"))}


def room(module: str) -> str:
    """Return the folder or file right inside the package that a module belongs to."""
    return module.split(".")[1] if "." in module else ""


def within(module: str, package: str) -> bool:
    return module == package or module.startswith(f"{package}.")


def own(imported: set[str]) -> set[str]:
    """Return those of some modules that are of the package."""
    return {name for name in imported if within(name, "gsdmsr_cli")}


def test_all_modules_are_found() -> None:
    assert {"gsdmsr_cli.cli.main", "gsdmsr_cli.model.motion"} <= MODULES.keys()
    assert "gsdmsr_cli.model.motion" in MODULES["gsdmsr_cli.model.building"]
    assert "gsdmsr_cli.ops.planes.cpu" in MODULES["gsdmsr_cli.ops.planes"]
    assert "gsdmsr_cli.ops.planes" in MODULES["gsdmsr_cli.model.motion.hexplane"]


def test_the_root_of_the_package_holds_rooms_only() -> None:
    files = {path.name for path in PACKAGE.iterdir() if path.is_file()}
    assert files == {"__init__.py", "__main__.py"}
    folders = {path.name for path in PACKAGE.iterdir() if any(path.glob("*.py"))}
    assert folders == set(ROOMS)
    assert all((PACKAGE / name / "__init__.py").is_file() for name in ROOMS)


@pytest.mark.parametrize("module", sorted(MODULES))
def test_imports_point_down(module: str) -> None:
    imported = {room(name) for name in own(MODULES[module])} - {"", "__version__", room(module)}
    below = ROOMS[: ROOMS.index(room(module))] if room(module) in ROOMS else ROOMS
    assert imported <= set(below)


def test_there_is_no_circle_between_modules() -> None:
    """Imports for annotations alone are not followed, nor are those of a package's own modules."""
    graph = {
        module: own(imports(path_of(module), only_run=True)) & MODULES.keys() - parents(module)
        for module in MODULES
    }
    assert len(list(TopologicalSorter(graph).static_order())) == len(graph)  # or CycleError


@pytest.mark.parametrize("kind", PLUGINS)
def test_kinds_of_plugins_do_not_import_one_another(kind: str) -> None:
    others = [f"gsdmsr_cli.{other}." for other in PLUGINS if other != kind]
    for module, imported in MODULES.items():
        if within(module, f"gsdmsr_cli.{kind}"):
            found = {name for name in imported if name.startswith(tuple(others))}
            assert not found, module


@pytest.mark.parametrize("kind", PLUGINS)
def test_plugins_do_not_import_their_siblings(kind: str) -> None:
    package = f"gsdmsr_cli.{kind}"
    plugins = {m for m in MODULES if m.startswith(f"{package}.") and "._" not in m}
    assert plugins
    for module in plugins:
        assert not MODULES[module] & (plugins - {module}), module


def test_kernels_know_nothing_of_torch() -> None:
    """Neither by themselves nor by what they import of the package."""
    kernels = {
        module
        for module, path in ((name_of(path), path) for path in PACKAGE.rglob("*.py"))
        if any(path.match(pattern) for pattern in KERNELS)
    }
    assert {"gsdmsr_cli.ops.rasterize.cpu.blending", "gsdmsr_cli.backends.cpu.jit"} <= kernels
    for module in kernels:
        assert not {name.split(".")[0] for name in MODULES[module]} & {"torch"}, module
        assert own(MODULES[module]) <= kernels | FOR_KERNELS, module


def test_kernels_are_compiled_anew_when_a_constant_changes() -> None:
    """The cache of compiled kernels goes by all of the files that they are made of."""
    files = {path_of(module) for module in CONSTANTS}
    files |= {path for pattern in KERNELS for path in PACKAGE.glob(pattern)}
    assert {*jit.sources()} == files


def test_every_operation_has_a_room_of_its_own() -> None:
    """Whose ``__init__`` says what it computes."""
    folders = [path for path in (PACKAGE / "ops").iterdir() if list(path.rglob("*.py"))]
    assert len(folders) > 10
    for folder in folders:
        assert ast.get_docstring(ast.parse((folder / "__init__.py").read_text("utf-8"))), folder
        assert (folder / "cpu.py").is_file() or (folder / "cpu").is_dir(), folder


def test_one_module_keeps_the_order_in_which_native_libraries_are_imported() -> None:
    ordered = {"cv2", "OpenImageIO", "pycolmap", "av"}
    importing = {module for module, imported in MODULES.items() if imported & ordered}
    assert importing == {"gsdmsr_cli.scene.native"}


def test_the_command_line_imports_commands_only_when_they_run() -> None:
    for path in (PACKAGE / "cli").glob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        top = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
        names = {node.module for node in top if isinstance(node, ast.ImportFrom)}
        assert not any(name and name.startswith("gsdmsr_cli.commands") for name in names), path


def test_every_command_of_the_command_line_has_a_file_of_options() -> None:
    files = {path.stem for path in (PACKAGE / "cli").glob("[!_]*.py")} - {"main", "options"}
    commands = {path.stem for path in (PACKAGE / "commands").glob("[!_]*.py")}
    assert files == {"benchmark" if c.startswith("benchmark_") else c for c in commands}
