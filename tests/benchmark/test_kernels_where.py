"""What the table of kernels says of the device it was measured on."""

from __future__ import annotations

from gsdmsr_cli.backends.cpu.jit import threads
from gsdmsr_cli.commands.benchmark_kernels import _where


def test_of_a_gpu_its_name_and_the_memory_that_was_taken() -> None:
    given = {"gpu": "Some Card", "peak_gpu_mib": 5123.4}
    assert _where(given) == "Some Card, 5,123 MiB of its memory at most"


def test_of_a_cpu_the_threads() -> None:
    assert _where({"gpu": None, "peak_gpu_mib": None}) == f"{threads()} threads"
