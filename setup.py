"""Ships presets/ inside the package, which pyproject.toml alone cannot, and notes the commit."""

import sys
from pathlib import Path

from setuptools import find_packages, setup
from setuptools.command.build_py import build_py
from setuptools.command.sdist import sdist

ROOT = Path(__file__).parent
sys.path.insert(0, str(ROOT))

from gsdmsr_cli.ground.origin import BUILT_FROM, describe  # noqa: E402


def note_commit(package: Path) -> None:
    """Write the commit into a built package, unless it comes from no clone."""
    commit = describe(ROOT)
    if commit:
        (package / BUILT_FROM).write_text(commit + "\n", encoding="ascii")


class BuildWithCommit(build_py):
    """Builds the package; one that is installed as it stands in a clone needs no note."""

    def run(self) -> None:
        """Build, then write the note."""
        super().run()
        if not self.editable_mode:
            note_commit(Path(self.build_lib) / "gsdmsr_cli")


class SourceWithCommit(sdist):
    """Packs the source, which is no clone any more."""

    def make_release_tree(self, base_dir: str, files: list[str]) -> None:
        """Copy the files, then write the note beside them."""
        super().make_release_tree(base_dir, files)
        note_commit(Path(base_dir) / "gsdmsr_cli")


setup(
    packages=[*find_packages(include=["gsdmsr_cli", "gsdmsr_cli.*"]), "gsdmsr_cli.presets"],
    package_dir={"gsdmsr_cli.presets": "presets"},
    cmdclass={"build_py": BuildWithCommit, "sdist": SourceWithCommit},
)
