"""Ships presets/ inside the package, which pyproject.toml alone cannot beside a package search."""

from setuptools import find_packages, setup

setup(
    packages=[*find_packages(include=["gsdmsr_cli", "gsdmsr_cli.*"]), "gsdmsr_cli.presets"],
    package_dir={"gsdmsr_cli.presets": "presets"},
)
