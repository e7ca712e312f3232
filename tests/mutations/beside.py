"""Which tests lie beside a file of the package, the nearest first."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

FURTHER = {
    "gsdmsr_cli/__": ("tests/cli",),
    "gsdmsr_cli/backends/tensors": ("tests/ops/adam", "tests/ops/planes"),
    "gsdmsr_cli/capture": ("tests/commands/test_bad_input.py",),
    "gsdmsr_cli/cli": ("tests/commands",),
    "gsdmsr_cli/commands": ("tests/cli", "tests/benchmark", "tests/runs"),
    "gsdmsr_cli/drawing": ("tests/raster", "tests/model", "tests/commands/test_render.py"),
    "gsdmsr_cli/evaluation": ("tests/commands/test_eval.py",),
    "gsdmsr_cli/filming": ("tests/commands/test_render.py",),
    "gsdmsr_cli/formats": ("tests/commands/test_layouts.py", "tests/commands/test_bad_input.py"),
    "gsdmsr_cli/gaussians": ("tests/raster", "tests/model", "tests/exports"),
    "gsdmsr_cli/ground": ("tests/runs", "tests/filming", "tests/cli", "tests/reporting"),
    "gsdmsr_cli/model": ("tests/seams", "tests/runs", "tests/training/test_trainer.py"),
    "gsdmsr_cli/ops": ("tests/raster", "tests/model/motion"),
    "gsdmsr_cli/options": ("tests/runs", "tests/test_docs.py"),
    "gsdmsr_cli/raster": ("tests/ops/rasterize", "tests/training/gradients"),
    "gsdmsr_cli/reporting": ("tests/commands/test_eval.py",),
    "gsdmsr_cli/runs": ("tests/training/test_trainer.py", "tests/commands"),
    "gsdmsr_cli/scene": ("tests/formats", "tests/raster", "tests/capture"),
    "gsdmsr_cli/training": ("tests/seams", "tests/runs"),
}
"""Tests of another folder that a part of the package is also tested by."""


def find_tests(root: Path, file: str) -> list[str]:
    """Return the files of tests, below ``root``: of the file, of its folder, then ``FURTHER``."""
    path = Path(file)
    folder = Path("tests", *path.parts[1:-1])
    while not _tests(root, folder):
        folder = folder.parent
    stem = path.stem.strip("_")
    found = sorted(_tests(root, folder), key=lambda test: stem not in Path(test).stem)
    for part, others in FURTHER.items():
        if file.startswith(part):
            found += [test for other in others for test in _tests(root, Path(other))]
    return list(dict.fromkeys(found))


def _tests(root: Path, place: Path) -> list[str]:
    def below() -> Iterator[Path]:
        if (root / place).is_dir():
            yield from sorted((root / place).rglob("test_*.py"))
        elif (root / place).is_file():
            yield root / place

    return [path.relative_to(root).as_posix() for path in below()]
