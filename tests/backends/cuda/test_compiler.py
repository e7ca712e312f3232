"""Every kernel compiles for every architecture, into registers alone; what is compiled is kept."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import cuda_shim
import pytest

from gsdmsr_cli.backends.cuda import compiler
from gsdmsr_cli.backends.cuda.nvrtc import Nvrtc, load_nvrtc
from gsdmsr_cli.ground.errors import GsdmsrError

ARCHITECTURES = (75, 80, 86, 89, 90, 100, 120)


@pytest.fixture(scope="module")
def nvrtc() -> Nvrtc:
    found = load_nvrtc()
    if found is None:
        pytest.skip("NVRTC is not installed: pip install 'gsdmsr[cuda]'")
    return found


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    compiler._cache_folder.cache_clear()
    yield tmp_path
    compiler._cache_folder.cache_clear()


@pytest.mark.parametrize("architecture", ARCHITECTURES)
@pytest.mark.parametrize("source", compiler.sources())
def test_every_source_compiles_for_every_architecture(
    nvrtc: Nvrtc, source: str, architecture: int
) -> None:
    """Without a stack: an array that does not fit into registers would be slow, unnoticed."""
    option, form = compiler.target(nvrtc, architecture)
    assert (option, form) == (f"sm_{architecture}", "CUBIN")
    program, log = compiler.translate(nvrtc, source, option, form, "--ptxas-options=-v")
    assert program.startswith(b"\x7fELF")
    used = [line for line in log.splitlines() if "stack frame" in line]
    assert len(used) >= len(cuda_shim.kernels_of(source)) > 0
    for line in used:
        assert "0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads" in line, log
    assert "warning" not in log


def test_what_is_compiled_is_read_again(
    nvrtc: Nvrtc, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = compiler.compiled(nvrtc, "binning", 90)
    (file,) = (path for path in cache.rglob("*") if path.is_file())
    assert file.name == "binning.sm_90.cubin"
    assert file.read_bytes() == program
    monkeypatch.setattr(compiler, "translate", lambda *_: pytest.fail("compiled again"))
    assert compiler.compiled(nvrtc, "binning", 90) == program


def test_the_cache_notices_edits(
    nvrtc: Nvrtc, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "sources"
    folder.mkdir()
    (folder / "one.cu").write_text('#include "two.cuh"\n', encoding="utf-8")
    (folder / "two.cuh").write_text('extern "C" __global__ void f() {}\n', encoding="utf-8")
    monkeypatch.setattr(compiler, "ROOT", folder)
    compiler.compiled(nvrtc, "one", 90)
    (folder / "two.cuh").write_text('extern "C" __global__ void g() {}\n', encoding="utf-8")
    compiler._cache_folder.cache_clear()
    assert b"g" in compiler.compiled(nvrtc, "one", 90)
    assert len(list((cache / "gsdmsr" / "cuda").iterdir())) == 2


def test_a_cache_that_cannot_be_written_does_no_harm(
    nvrtc: Nvrtc, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    compiler._cache_folder.cache_clear()
    assert compiler.compiled(nvrtc, "binning", 90).startswith(b"\x7fELF")
    compiler._cache_folder.cache_clear()


def test_a_full_disk_does_no_harm(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path, content: bytes) -> None:
        raise OSError(28, "No space left on device", str(path))

    found = SimpleNamespace(version=(12, 9), architectures=lambda: [90])
    monkeypatch.setattr(compiler, "translate", lambda *_: (b"a program", ""))
    monkeypatch.setattr(Path, "write_bytes", refuse)
    assert compiler.compiled(cast(Nvrtc, found), "binning", 90) == b"a program"
    assert not [path for path in cache.rglob("*") if path.is_file()]


def test_cards_newer_than_the_compiler_get_what_their_driver_can_compile(
    nvrtc: Nvrtc, cache: Path
) -> None:
    newest = nvrtc.architectures()[-1]
    assert compiler.target(nvrtc, newest + 100) == (f"compute_{newest}", "PTX")
    assert b".entry emit" in compiler.compiled(nvrtc, "binning", newest + 100)


def test_cards_older_than_the_compiler_are_refused(nvrtc: Nvrtc) -> None:
    with pytest.raises(GsdmsrError, match=r"compute capability 20.*--device cpu"):
        compiler.target(nvrtc, 20)


def test_what_does_not_compile_is_told_with_its_place(
    nvrtc: Nvrtc, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "bad.cu").write_text("__global__ void f() { nonsense; }\n", encoding="utf-8")
    monkeypatch.setattr(compiler, "ROOT", tmp_path)
    with pytest.raises(GsdmsrError, match=r"bad.cu does not compile for.*sm_90[\s\S]*nonsense"):
        compiler.translate(nvrtc, "bad", "sm_90", "CUBIN")
