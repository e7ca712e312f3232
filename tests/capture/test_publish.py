"""Where a scene is put: what lay there before, what others keep there, and kills in between."""

from __future__ import annotations

import errno
import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from datasets import write_dnerf

from gsdmsr_cli.capture.options import Options
from gsdmsr_cli.commands import prepare as command
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.ground.locks import one_of_readers, sole_writer

Content = dict[str, bytes]


def prepare(given: Path, out: Path, overwrite: bool = False, keep: bool = False) -> None:
    command.run(given, out, None, None, Options(), overwrite, keep)


def content(folder: Path) -> Content:
    """The files below a folder but the one that differs between runs."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != "timings.json")
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


@pytest.fixture
def given(tmp_path: Path) -> Path:
    return write_dnerf(tmp_path / "given")


@pytest.fixture
def other(tmp_path: Path) -> Path:
    """Another data set, of fewer pictures."""
    return write_dnerf(tmp_path / "other", train=2, val=1, test=1)


@pytest.fixture
def expected(given: Path, tmp_path: Path) -> Content:
    prepare(given, tmp_path / "expected")
    assert not list(tmp_path.glob("*.stages"))
    return content(tmp_path / "expected")


def test_a_folder_that_is_there_and_empty_is_filled(
    given: Path, expected: Content, tmp_path: Path
) -> None:
    out = tmp_path / "scene"
    out.mkdir(mode=0o750)
    before = out.stat()
    prepare(given, out)
    assert content(out) == expected
    assert (out.stat().st_ino, out.stat().st_mode) == (before.st_ino, before.st_mode)


def test_what_a_link_leads_to_is_filled(given: Path, expected: Content, tmp_path: Path) -> None:
    target, out = tmp_path / "disk" / "target", tmp_path / "scene"
    target.mkdir(parents=True)
    out.symlink_to(target, target_is_directory=True)
    prepare(given, out)
    prepare(given, out, overwrite=True)
    assert out.is_symlink() and content(target) == expected
    assert sorted(path.name for path in target.parent.iterdir()) == ["target"]


@pytest.mark.skipif(
    sys.platform != "linux" or os.system("unshare -rm true 2>/dev/null") != 0,
    reason="this user may not mount",
)
@pytest.mark.parametrize("kind", ["tmpfs", "bind"])
def test_a_mount_is_filled(given: Path, expected: Content, tmp_path: Path, kind: str) -> None:
    """That of another file system, and that of the same, which cannot be told from a folder."""
    out, copy, source = tmp_path / "scene", tmp_path / "copy", tmp_path / "source"
    for folder in (out, source):
        folder.mkdir()
    how = "-t tmpfs none" if kind == "tmpfs" else f"--bind {source}"
    call = f"{sys.executable} -m gsdmsr_cli prepare {given} --out {out} --json"
    script = f"mount {how} {out} && {call} && {call} --overwrite && cp -a {out} {copy}"
    ended = subprocess.run(["unshare", "-rm", "sh", "-c", script], capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    assert content(copy) == expected
    assert not list(tmp_path.glob("*.stages")) and not list(copy.glob(".*"))


@pytest.mark.parametrize("code", [errno.EXDEV, errno.EBUSY])
def test_a_scene_that_cannot_be_renamed_is_copied(
    given: Path, expected: Content, tmp_path: Path, monkeypatch: Any, code: int
) -> None:
    real = Path.rename

    def rename(path: Path, target: Path) -> Path:
        if path.name.startswith("scene-"):
            raise OSError(code, os.strerror(code), str(path))
        return real(path, target)

    monkeypatch.setattr(Path, "rename", rename)
    prepare(given, tmp_path / "scene")
    assert content(tmp_path / "scene") == expected and not list(tmp_path.glob("*.stages"))


def test_stages_lie_inside_where_nothing_can_be_written_beside(
    given: Path, expected: Content, tmp_path: Path, monkeypatch: Any
) -> None:
    out, real = tmp_path / "parent" / "scene", os.access
    out.mkdir(parents=True)
    refused = out.parent, os.W_OK | os.X_OK
    monkeypatch.setattr(os, "access", lambda *asked: asked != refused and real(*asked))
    publish, inside = command.publish, list[Path]()

    def note(scene: Path, place: Path) -> None:
        inside.append(scene.parent)
        publish(scene, place)

    monkeypatch.setattr(command, "publish", note)
    prepare(given, out)
    prepare(given, out, overwrite=True)
    assert inside == [out / ".gsdmsr-stages"] * 2
    assert [path.name for path in out.parent.iterdir()] == ["scene"]
    assert content(out) == expected


def test_stages_of_somebody_else_are_left_alone(given: Path, tmp_path: Path) -> None:
    stages = tmp_path / "scene.stages"
    stages.mkdir()
    (stages / "thesis.tex").touch()
    with pytest.raises(DataError, match=r"holds thesis\.tex, which is not of prepare"):
        prepare(given, tmp_path / "scene")
    assert [path.name for path in stages.iterdir()] == ["thesis.tex"]
    assert not (tmp_path / "scene").exists()


def test_stages_of_earlier_versions_serve_and_what_others_put_there_stays(
    given: Path, expected: Content, tmp_path: Path
) -> None:
    stages = tmp_path / "scene.stages"
    for name in ("frames-0123456789abcdef", ".matches.part"):
        (stages / name).mkdir(parents=True)
    prepare(given, tmp_path / "scene", keep=True)
    (stages / "notes.txt").touch()
    prepare(given, tmp_path / "scene", overwrite=True)
    assert sorted(path.name for path in stages.iterdir()) == [".gsdmsr", "notes.txt"]
    assert content(tmp_path / "scene") == expected


def test_what_is_trained_inside_the_scene_stays(
    other: Path, given: Path, expected: Content, tmp_path: Path
) -> None:
    out = tmp_path / "scene"
    prepare(other, out)
    (out / "run").mkdir()
    (out / "run" / "checkpoint.safetensors").write_bytes(b"work of days")
    (out / "notes.txt").write_text("mine")
    prepare(given, out, overwrite=True)
    found = content(out)
    assert found.pop("run/checkpoint.safetensors") == b"work of days"
    assert found.pop("notes.txt") == b"mine" and found == expected


@pytest.mark.parametrize("name", ["images/mine.png", "images/deep/er/mine.txt", "masks/mine.png"])
def test_a_file_among_the_pictures_is_refused_by_name(
    given: Path, tmp_path: Path, name: str
) -> None:
    out = tmp_path / "scene"
    prepare(given, out)
    (out / name).parent.mkdir(parents=True, exist_ok=True)
    (out / name).write_text("mine")
    before = content(out)
    with pytest.raises(UsageError, match=f"{name}: lies in the scene but is not of prepare"):
        prepare(given, out, overwrite=True)
    assert content(out) == before and not list(tmp_path.glob("*.stages"))


def test_a_folder_of_pictures_that_is_a_link_is_refused(given: Path, tmp_path: Path) -> None:
    out = tmp_path / "scene"
    prepare(given, out)
    (out / "images").rename(tmp_path / "elsewhere")
    (out / "images").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UsageError, match="images: lies in the scene"):
        prepare(given, out, overwrite=True)
    assert (tmp_path / "elsewhere").is_dir()


def test_kept_stages_do_not_serve_other_pictures_of_the_same_layout(
    given: Path, tmp_path: Path
) -> None:
    prepare(given, tmp_path / "scene", keep=True)
    shutil.copyfile(given / "train" / "r_001.png", given / "train" / "r_002.png")
    prepare(given, tmp_path / "scene", overwrite=True)
    images = tmp_path / "scene" / "images" / "train_r_001.png", tmp_path / "scene" / "images"
    assert images[0].read_bytes() == (images[1] / "train_r_002.png").read_bytes()


def test_a_scene_is_not_its_own_input(given: Path, tmp_path: Path) -> None:
    prepare(given, tmp_path / "scene")
    with pytest.raises(UsageError, match="is INPUT"):
        prepare(tmp_path / "scene", tmp_path / "scene", overwrite=True)


def test_a_scene_that_an_earlier_version_had_moved_away_comes_back(
    given: Path, expected: Content, tmp_path: Path
) -> None:
    prepare(given, tmp_path / "scene")
    (tmp_path / "scene").rename(tmp_path / ".scene.earlier")
    with pytest.raises(UsageError, match="holds a scene already"):
        prepare(given, tmp_path / "scene")
    assert content(tmp_path / "scene") == expected


def test_what_is_called_earlier_is_nobodys_business(given: Path, tmp_path: Path) -> None:
    mine = tmp_path / ".scene.earlier"
    mine.mkdir()
    (mine / "thesis.tex").touch()
    for overwrite in (False, True):
        prepare(given, tmp_path / "scene", overwrite=overwrite)
        assert [path.name for path in mine.iterdir()] == ["thesis.tex"]


BEGIN = {"nothing": 1, "scene": 2, "folder": 3}
"""The first kill that is tried; after it every third."""

CHANGES = {"os.rename", "os.mkdir", "os.rmdir", "os.remove", "shutil.copyfile"}


def prepare_and_die(number: int, given: Path, out: Path, overwrite: bool) -> bool:
    """Prepare in a fork, killed before the n-th change of the disk; return whether it was."""
    pid = os.fork()
    if pid:
        return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == -signal.SIGKILL
    left = number

    def count(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal left
        writes = event == "open" and arguments[2] & (os.O_WRONLY | os.O_RDWR)
        if event in CHANGES or writes:
            left -= 1
            if not left:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(count)
    with suppress(BaseException):
        prepare(given, out, overwrite)
    os._exit(0)


@pytest.mark.skipif(sys.platform != "linux", reason="forks and kills")
@pytest.mark.parametrize("before", ["nothing", "scene", "folder"])
def test_a_kill_at_any_moment_leaves_what_the_next_command_goes_on_with(
    given: Path, other: Path, expected: Content, tmp_path: Path, before: str
) -> None:
    prepare(other, tmp_path / "old")
    old, kills, half = content(tmp_path / "old"), 0, 0
    for number in itertools.count(BEGIN[before], 3):
        place = tmp_path / str(number)
        out = place / "scene"
        place.mkdir()
        if before == "scene":
            shutil.copytree(tmp_path / "old", out)
            (out / "run").mkdir()
        elif before == "folder":
            out.mkdir()
        if not prepare_and_die(number, given, out, overwrite=before == "scene"):
            break
        kills += 1
        unfinished = (out / ".gsdmsr-publish").is_dir()
        half += unfinished
        if not unfinished:
            assert content(out) in ([old, expected] if before == "scene" else [{}, expected])
        try:
            prepare(given, out, overwrite=before == "scene")
        except UsageError as error:  # all was done but for the removal of an empty folder
            assert "holds a scene already" in str(error) and number > 45
        assert content(out) == expected, number
        assert (out / "run").is_dir() == (before == "scene")
        assert [path.name for path in place.iterdir()] == ["scene"], number
        assert not list(out.glob(".*")), number
    assert kills > 14 and bool(half) == (before != "nothing")


@pytest.mark.skipif(sys.platform != "linux", reason="forks and kills")
def test_after_a_kill_another_command_replaces_nothing_unasked(
    given: Path, other: Path, expected: Content, tmp_path: Path
) -> None:
    """It finishes what was begun, so that there is a whole scene, and is then refused."""
    prepare(other, tmp_path / "old")
    old, found = content(tmp_path / "old"), list[Content]()
    for number in itertools.count(30, 2):
        out = tmp_path / f"{number}" / "scene"
        shutil.copytree(tmp_path / "old", out)
        if not prepare_and_die(number, given, out, overwrite=True):
            break
        with pytest.raises(UsageError, match="holds a scene already"):
            prepare(other, out)
        assert not list(out.glob(".*"))
        found.append(content(out))
    assert all(scene in (old, expected) for scene in found) and found.count(expected) > 5


def test_a_scene_that_is_read_is_not_replaced(given: Path, tmp_path: Path) -> None:
    out = tmp_path / "scene"
    prepare(given, out)
    with one_of_readers(out), pytest.raises(DataError, match="another process is reading there"):
        prepare(given, out, overwrite=True)
    with sole_writer(tmp_path / "scene.stages"), pytest.raises(DataError, match="is writing"):
        prepare(given, out, overwrite=True)


@pytest.mark.skipif(sys.platform != "linux", reason="forks")
@pytest.mark.parametrize("before", ["nothing", "scene"])
def test_a_disk_that_is_full_at_any_change_is_told_and_costs_nothing(
    given: Path, other: Path, expected: Content, tmp_path: Path, before: str
) -> None:
    prepare(other, tmp_path / "old")
    old, failures = content(tmp_path / "old"), 0
    for number in itertools.count(1, 2):
        out = tmp_path / str(number) / "scene"
        out.parent.mkdir()
        if before == "scene":
            shutil.copytree(tmp_path / "old", out)
        said = prepare_on_a_full_disk(number, given, out, overwrite=before == "scene")
        if said is None:
            break
        failures += 1
        if not (out / ".gsdmsr-publish").is_dir() and (out / "transforms.json").is_file():
            assert content(out) in (old, expected)
        if said != "":  # what cannot be removed at the end is no failure
            assert re.search("cannot be (written|made): No space left on device", said), said
        prepare(given, out, overwrite=before == "scene" or said == "")
        assert content(out) == expected, number
    assert failures > 10


def prepare_on_a_full_disk(number: int, given: Path, out: Path, overwrite: bool) -> str | None:
    """Prepare where the n-th change of the disk fails; return what was said, None if none did."""
    reader, writer = os.pipe()
    pid = os.fork()
    if pid:
        os.close(writer)
        with os.fdopen(reader, encoding="utf-8") as file:
            said = file.read()
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        return {0: said, 9: None}[code]
    left = number

    def count(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal left
        writes = event == "open" and arguments[2] & os.O_CREAT
        if event in {"os.rename", "os.mkdir"} or writes:
            left -= 1
            if not left:
                raise OSError(errno.ENOSPC, "No space left on device", str(arguments[0]))

    sys.addaudithook(count)
    code = 1
    try:
        prepare(given, out, overwrite)
        code = 0
    except DataError as error:
        os.write(writer, str(error).encode())
        code = 0
    except BaseException as error:
        os.write(2, repr(error).encode())
    os._exit(9 if left > 0 else code)


def test_the_times_that_are_told_come_to_the_wall_time(
    given: Path, tmp_path: Path, capsys: Any, monkeypatch: Any
) -> None:
    told = list[dict[str, Any]]()
    monkeypatch.setattr(say, "result", lambda document, *_: told.append(document))
    started = time.perf_counter()
    prepare(given, tmp_path / "scene")
    wall, printed = time.perf_counter() - started, capsys.readouterr()
    seconds = told[0]["seconds"]
    assert {"reading the data set", "writing the scene", "other"} == seconds.keys()
    assert sum(seconds.values()) == pytest.approx(wall, abs=0.03)
    written = json.loads((tmp_path / "scene" / "timings.json").read_text())["seconds"]
    assert written.keys() == seconds.keys() and sum(written.values()) <= wall + 0.03
    lines = printed.err.splitlines()
    assert lines[0] == "reading the data set ..."
    assert lines[-1].startswith("writing the scene: 7")
