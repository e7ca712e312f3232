"""Pictures on disk: exact pixels, straight alpha, damage found, nothing half written."""

from __future__ import annotations

import errno
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from datasets import noise, write_picture

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene import imaging
from gsdmsr_cli.scene.picture_files import IN_CAPTURES


def assert_one_line(error: pytest.ExceptionInfo[DataError], path: Path) -> None:
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_png_is_read_as_stored(tmp_path: Path, channels: int) -> None:
    pixels = noise(7, 5, channels)
    write_picture(tmp_path / "a.png", pixels)
    read = imaging.read_image(tmp_path / "a.png")
    assert read.dtype == np.uint8 and read.flags.c_contiguous
    np.testing.assert_array_equal(read, pixels)


def test_webp_is_the_picture_but_for_a_little() -> None:
    pixels = np.full((20, 30, 3), (250, 120, 10), np.uint8)
    found = cv2.imdecode(np.frombuffer(imaging.encode_webp(pixels, 90), np.uint8), 1)[..., ::-1]
    assert found.shape == pixels.shape
    assert np.abs(found.astype(int) - pixels).max() <= 6


def test_alpha_stays_straight(tmp_path: Path) -> None:
    pixels = np.array([[[200, 100, 50, 128], [9, 8, 7, 0]]], np.uint8)
    write_picture(tmp_path / "a.png", pixels)
    np.testing.assert_array_equal(imaging.read_image(tmp_path / "a.png"), pixels)


def test_sixteen_bits_are_scaled_to_eight(tmp_path: Path) -> None:
    wide = np.random.default_rng(1).integers(0, 65536, (6, 9, 4)).astype(np.uint16)
    write_picture(tmp_path / "a.png", wide)
    expected = np.rint(wide / 257.0).astype(np.uint8)
    np.testing.assert_array_equal(imaging.read_image(tmp_path / "a.png"), expected)


def test_grey_with_alpha_becomes_rgba(tmp_path: Path) -> None:
    from PIL import Image

    Image.fromarray(noise(4, 6, 2)).save(tmp_path / "a.png")
    grey, alpha = noise(4, 6, 2)[..., 0], noise(4, 6, 2)[..., 1]
    expected = np.stack([grey, grey, grey, alpha], axis=2)
    np.testing.assert_array_equal(imaging.read_image(tmp_path / "a.png"), expected)


def test_jpeg_is_read_as_rgb(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.jpg", np.full((16, 24, 3), (200, 100, 50), np.uint8))
    read = imaging.read_image(tmp_path / "a.jpg")
    assert read.shape == (16, 24, 3)
    assert np.abs(read.astype(int) - (200, 100, 50)).max() <= 3


@pytest.mark.parametrize("name", ["a.png", "a.jpg"])
@pytest.mark.parametrize("kept", [0.02, 0.5, 0.95])
def test_a_truncated_picture_is_refused(tmp_path: Path, name: str, kept: float) -> None:
    path = tmp_path / name
    write_picture(path, noise(64, 48, 3))
    whole = path.read_bytes()
    assert imaging.read_image(path).shape == (64, 48, 3)
    path.write_bytes(whole[: int(len(whole) * kept)])
    with pytest.raises(DataError) as error:
        imaging.read_image(path)
    assert_one_line(error, path)


def test_every_cut_of_a_png_is_found_from_its_header(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.png"
    write_picture(path, noise(6, 5))
    whole = path.read_bytes()
    for length in range(8, len(whole) - 8):
        path.write_bytes(whole[:length])
        with pytest.raises(DataError):
            imaging.image_size(path)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("content", [b"", b"hello", b"\x89PNG\r\n\x1a\n"])
@pytest.mark.parametrize("function", [imaging.read_image, imaging.image_size])
def test_what_is_no_picture_is_refused(tmp_path: Path, content: bytes, function) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(content)
    with pytest.raises(DataError) as error:
        function(path)
    assert_one_line(error, path)


@pytest.mark.parametrize("function", [imaging.read_image, imaging.image_size])
def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path, function) -> None:
    for path in (tmp_path / "missing.png", tmp_path):
        with pytest.raises(DataError, match="does not exist or is not a file") as error:
            function(path)
        assert_one_line(error, path)


def test_more_than_four_channels_are_refused(tmp_path: Path) -> None:
    import OpenImageIO

    path = tmp_path / "a.tif"
    out = OpenImageIO.ImageOutput.create(str(path))
    out.open(str(path), OpenImageIO.ImageSpec(3, 2, 5, "uint8"))
    out.write_image(noise(2, 3, 5))
    out.close()
    with pytest.raises(DataError, match="5 channels"):
        imaging.read_image(path, IN_CAPTURES)


@pytest.mark.parametrize("name", ["a.png", "a.jpg"])
def test_size_is_width_then_height(tmp_path: Path, name: str) -> None:
    write_picture(tmp_path / name, noise(7, 11, 3))
    assert imaging.image_size(tmp_path / name) == (11, 7)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_written_png_is_read_by_cv2(tmp_path: Path, channels: int) -> None:
    pixels = noise(5, 9, channels)
    imaging.write_png(tmp_path / "a.png", pixels)
    read = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED).reshape(5, 9, channels)
    order = {1: [0], 3: [2, 1, 0], 4: [2, 1, 0, 3]}[channels]
    np.testing.assert_array_equal(read[..., order], pixels)
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


def test_a_full_disk_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.png"
    imaging.write_png(path, noise(2, 2, 3))
    old = path.read_bytes()

    def fail(self: Path, data: bytes) -> int:
        self.touch()
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(DataError, match="No space left on device") as error:
        imaging.write_png(path, noise(3, 3, 3))
    assert_one_line(error, path)
    assert path.read_bytes() == old
    assert list(tmp_path.iterdir()) == [path]


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    path = tmp_path / "missing" / "a.png"
    with pytest.raises(DataError, match="No such file or directory") as error:
        imaging.write_png(path, noise(2, 2, 3))
    assert_one_line(error, path)


def test_composite_is_straight_alpha_in_float() -> None:
    image = np.array([[[255, 0, 51, 0], [255, 0, 51, 51], [255, 0, 51, 255]]], np.uint8)
    result = imaging.composite(image, (0.5, 1.0, 0.0))
    assert result.dtype == np.float32
    expected = [[[0.5, 1, 0], [0.2 + 0.8 * 0.5, 0.8, 0.2 * 0.2], [1, 0, 0.2]]]
    np.testing.assert_allclose(result, expected, atol=1e-6)


def test_composite_repeats_grey_and_leaves_rgb() -> None:
    grey = noise(3, 4, 1)
    np.testing.assert_allclose(
        imaging.composite(grey, (1, 0, 0)), np.repeat(grey / 255, 3, axis=2), atol=1e-6
    )
    rgb = noise(3, 4, 3)
    np.testing.assert_allclose(imaging.composite(rgb, (1, 0, 0)), rgb / 255, atol=1e-6)


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("size", [(4, 3), (5, 5), (8, 9)])
def test_composite_and_shrink_is_composite_then_shrink(
    size: tuple[int, int], channels: int
) -> None:
    image = np.random.default_rng(0).integers(0, 256, (9, 8, channels), dtype=np.uint8)
    expected = imaging.resize_area(imaging.composite(image, (0.2, 1.0, 0.0)), *size)
    found = imaging.composite(image, (0.2, 1.0, 0.0), size)
    assert found.shape == (size[1], size[0], 3)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_area_resize_is_the_mean_of_blocks() -> None:
    image = np.random.default_rng(2).random((12, 9, 3)).astype(np.float32)
    expected = image.reshape(4, 3, 3, 3, 3).mean((1, 3))
    result = imaging.resize_area(image, 3, 4)
    assert result.dtype == np.float32
    np.testing.assert_allclose(result, expected, atol=1e-6)


def test_area_resize_weights_partly_covered_pixels() -> None:
    row = np.array([0.0, 1.0, 0.5], np.float32)
    image = np.broadcast_to(row[None, :, None], (3, 3, 3)).copy()
    halves = [(0 + 0.5 * 1) / 1.5, (0.5 * 1 + 0.5) / 1.5]
    np.testing.assert_allclose(imaging.resize_area(image, 2, 2)[0, :, 0], halves, atol=1e-6)


@pytest.mark.parametrize("channels", [("Z",), ("u", "v")])
def test_exr_holds_the_numbers_exactly(tmp_path: Path, channels: tuple[str, ...]) -> None:
    image = np.random.default_rng(3).normal(size=(7, 5, len(channels))).astype(np.float32)
    image[0, 0], image[1, 1], image[2, 2] = np.inf, 1e-30, -123456.78
    imaging.write_exr(tmp_path / "a.exr", image, channels)
    read, names = imaging.read_exr(tmp_path / "a.exr")
    assert names == channels and read.dtype == np.float32
    np.testing.assert_array_equal(read, image)
    assert imaging.image_size(tmp_path / "a.exr", ("openexr",)) == (5, 7)
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]


def test_an_exr_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    path = tmp_path / "missing" / "a.exr"
    with pytest.raises(DataError, match="No such file or directory") as error:
        imaging.write_exr(path, np.zeros((2, 2, 1), np.float32), ("Z",))
    assert_one_line(error, path)


@pytest.mark.skipif(sys.platform == "win32", reason="needs a limit on the size of files")
@pytest.mark.parametrize("missing", [20000, 3000, 900, 1])
def test_an_exr_that_does_not_fit_on_the_disk_leaves_nothing(tmp_path: Path, missing: int) -> None:
    """Not even if only its last bytes do not, which OpenImageIO writes when it closes the file."""
    program = f"""
import resource, signal
from pathlib import Path
import numpy as np
from gsdmsr_cli.scene import imaging
from gsdmsr_cli.scene.picture_files import IN_CAPTURES
from gsdmsr_cli.ground.errors import DataError
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
image = np.random.default_rng(0).random((100, 100, 1)).astype(np.float32)
path = Path({str(tmp_path / "a.exr")!r})
imaging.write_exr(path, image, ("Z",))
limit = path.stat().st_size - {missing}
path.unlink()
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
try:
    imaging.write_exr(path, image, ("Z",))
except DataError as error:
    print(error)
"""
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert "a.exr: cannot be written" in run.stdout, run.stderr
    assert run.stdout.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_eight_bits_are_clamped_and_rounded_as_eval_rounds() -> None:
    values = np.linspace(-0.2, 1.2, 70 * 61 * 3, dtype=np.float32).reshape(3, 70, 61)
    image = values.transpose(1, 2, 0)  # planes, as engines draw them
    expected = np.rint(image.clip(0, 1) * np.float32(255)).astype(np.uint8)
    np.testing.assert_array_equal(imaging.eight_bits(image), expected)
    np.testing.assert_array_equal(imaging.eight_bits(image[..., :1]), expected[..., :1])
    assert imaging.eight_bits(np.full((1, 1, 1), np.nan, np.float32)) == 0


def test_turbo_goes_from_blue_over_green_to_red() -> None:
    low, middle, high, beyond = imaging.turbo(np.array([[0.1, 0.5, 0.95, 7.0]], np.float32))[0]
    assert low.argmax() == 2 and middle.argmax() == 1 and high.argmax() == 0
    assert beyond[0] > 100 and beyond[1:].max() < 30  # clamped to dark red


@pytest.mark.parametrize(
    ("vector", "colour"),
    [
        ((0, 0), (255, 255, 255)),
        ((1, 0), (255, 0, 0)),
        ((0, 1), (128, 255, 0)),
        ((-1, 0), (0, 255, 255)),
        ((0, -1), (128, 0, 255)),
        ((9, 0), (255, 0, 0)),
        ((0.5, 0), (255, 128, 128)),
    ],
)
def test_the_colour_wheel_turns_clockwise_from_red(
    vector: tuple[float, float], colour: tuple[int, int, int]
) -> None:
    found = imaging.colour_wheel(np.array([[vector]], np.float32))
    assert np.abs(found[0, 0].astype(int) - colour).max() <= 1


def test_pngs_can_be_written_after_pycolmap_is_imported(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    program = f"""
from pathlib import Path
from gsdmsr_cli.scene.native import load_pycolmap
load_pycolmap()
from gsdmsr_cli.scene import imaging
from gsdmsr_cli.scene.picture_files import IN_CAPTURES
import numpy as np
path = Path({str(tmp_path / "a.png")!r})
imaging.write_png(path, np.zeros((64, 64, 4), np.uint8))
assert imaging.read_image(path).shape == (64, 64, 4)
"""
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
