"""LPIPS against a second writing on random trunks, and against published values on real ones."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from gsdmsr_cli.evaluation.lpips import NETS, Lpips, load_lpips, weights_hashes
from gsdmsr_cli.evaluation.lpips_trunks import ARCHITECTURES
from gsdmsr_cli.evaluation.metrics import Missing
from gsdmsr_cli.ground.errors import DataError, UsageError

Weights = dict[str, Tensor]


@pytest.fixture(autouse=True)
def nowhere_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide weights that this machine may have."""
    monkeypatch.delenv("GSDMSR_LPIPS_DIR", raising=False)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))


@pytest.fixture(scope="module", params=NETS)
def made(request, tmp_path_factory) -> tuple[str, Path, Weights, list[Tensor]]:
    """A network's name, a folder of random weights for it, and the weights themselves."""
    net, folder = request.param, tmp_path_factory.mktemp(request.param)
    generator = torch.Generator().manual_seed(7)
    trunk = {}
    with torch.device("meta"):
        shapes = {k: v.shape for k, v in ARCHITECTURES[net].build().state_dict().items()}
    for key, shape in shapes.items():
        spread = 0.1 if len(shape) == 1 else math.sqrt(2 / shape[1:].numel())
        trunk[key] = torch.randn(shape, generator=generator) * spread
    linear = [torch.rand(c, generator=generator) for c in ARCHITECTURES[net].channels]
    torch.save(trunk, folder / f"{net}.backbone.pth")
    torch.save(named(linear), folder / f"{net}.pth")
    return net, folder, trunk, linear


def named(linear: list[Tensor]) -> Weights:
    return {f"lin{i}.model.1.weight": w.view(1, -1, 1, 1) for i, w in enumerate(linear)}


def load(net: str, folder: Path) -> Lpips:
    lpips = load_lpips(net, folder)
    assert isinstance(lpips, Lpips)
    return lpips


def pictures(height: int, width: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    x = torch.rand(height, width, 3, generator=generator)
    return x, (x + 0.2 * torch.randn(x.shape, generator=generator)).clamp(0, 1)


def taps(net: str, weights: Weights, x: Tensor) -> Iterator[Tensor]:
    """Yield the compared features, the networks written from their papers in float64."""

    def conv(name: str, x: Tensor, stride: int = 1, padding: int = 0) -> Tensor:
        kernel, bias = (weights[f"{name}.{kind}"].double() for kind in ("weight", "bias"))
        return F.conv2d(x, kernel, bias, stride, padding).clamp_min(0)

    def fire(name: str, x: Tensor) -> Tensor:
        x = conv(f"{name}.squeeze", x)
        one, three = conv(f"{name}.expand1x1", x), conv(f"{name}.expand3x3", x, padding=1)
        return torch.cat([one, three], 1)

    if net == "alex":
        yield (x := conv("0", x, 4, 2))
        yield (x := conv("3", F.max_pool2d(x, 3, 2), padding=2))
        yield (x := conv("6", F.max_pool2d(x, 3, 2), padding=1))
        yield (x := conv("8", x, padding=1))
        yield conv("10", x, padding=1)
    elif net == "vgg":
        for first, last in ((0, 2), (5, 7), (10, 14), (17, 21), (24, 28)):
            for index in range(first, last + 1, 2):
                x = conv(str(index), x, padding=1)
            yield x
            x = F.max_pool2d(x, 2)
    else:
        yield (x := conv("0", x, 2))
        for names in (("3", "4"), ("6", "7"), ("9",), ("10",), ("11",), ("12",)):
            if names[0] in ("3", "6", "9"):
                x = F.max_pool2d(x, 3, 2, ceil_mode=True)
            for name in names:
                x = fire(name, x)
            yield x


def second_writing(net: str, trunk: Weights, linear: list[Tensor], x: Tensor, y: Tensor) -> float:
    """Return LPIPS of two (H, W, 3) pictures in [0, 1], tap by tap and channel-last."""
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    x, y = (((2 * image - 1 - shift) / scale).permute(2, 0, 1)[None].double() for image in (x, y))
    total = 0.0
    for fx, fy, weight in zip(taps(net, trunk, x), taps(net, trunk, y), linear, strict=True):
        fx, fy = (f[0].permute(1, 2, 0) for f in (fx, fy))
        fx = fx / ((fx**2).sum(-1, keepdim=True).sqrt() + 1e-10)
        fy = fy / ((fy**2).sum(-1, keepdim=True).sqrt() + 1e-10)
        total += ((fx - fy) ** 2 @ weight.double()).mean().item()
    return total


def test_equals_the_second_writing_on_random_weights(made) -> None:
    net, folder, trunk, linear = made
    lpips = load(net, folder)
    x, y = pictures(45, 38)
    expected = second_writing(net, trunk, linear, x, y)
    assert expected > 0.01
    assert lpips(x, y) == pytest.approx(expected, rel=1e-5)


def test_identity_symmetry_and_batches(made) -> None:
    lpips = load(made[0], made[1])
    x, y = pictures(40, 33)
    assert lpips(x, x) == 0.0
    assert lpips(x, y) == pytest.approx(lpips(y, x), rel=1e-6)
    batch = torch.stack([x, y]).permute(0, 3, 1, 2) * 2 - 1
    alone = torch.tensor([lpips(x, y), lpips(y, y)])
    torch.testing.assert_close(lpips.distance(batch, batch[[1, 1]]), alone)


def test_smallest_picture_works_and_a_smaller_one_is_bad_data(made) -> None:
    lpips = load(made[0], made[1])
    assert math.isfinite(lpips(*pictures(lpips.smallest, lpips.smallest)))
    with pytest.raises(DataError, match=f"at least {lpips.smallest} px"):
        lpips(*pictures(lpips.smallest - 1, 64))


def test_loading_leaves_the_random_generator_alone(made) -> None:
    before = torch.get_rng_state()
    load(made[0], made[1])
    assert torch.equal(torch.get_rng_state(), before)


def test_shapes_that_do_not_agree_are_refused(made) -> None:
    lpips = load(made[0], made[1])
    with pytest.raises(ValueError, match="same"):
        lpips(torch.zeros(40, 40, 3), torch.zeros(1, 40, 3))


def test_whole_checkpoints_and_every_place_and_name_are_found(
    made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    net, folder, trunk, linear = made
    x, y = pictures(40, 40)
    expected = load(net, folder)(x, y)
    whole = {f"features.{key}": value for key, value in trunk.items()}
    whole["classifier.1.weight"] = torch.zeros(2, 2)
    checkpoints = tmp_path / "hub" / "checkpoints"
    (tmp_path / "named" / "linear").mkdir(parents=True)
    checkpoints.mkdir(parents=True)
    torch.save(whole, checkpoints / ARCHITECTURES[net].checkpoint)
    torch.save(named(linear), tmp_path / "named" / "linear" / f"{net}.pth")
    monkeypatch.setenv("GSDMSR_LPIPS_DIR", str(tmp_path / "named"))
    found = load_lpips(net)
    assert isinstance(found, Lpips)
    assert found(x, y) == expected
    (tmp_path / "named" / "linear" / f"{net}.pth").rename(checkpoints / f"lpips_{net}.pth")
    assert isinstance(load_lpips(net), Lpips)


@pytest.mark.parametrize("net", NETS)
def test_without_weights_the_reason_and_the_folders_are_told(
    net: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GSDMSR_LPIPS_DIR", str(tmp_path / "absent"))
    missing = load_lpips(net, tmp_path)
    assert isinstance(missing, Missing)
    hub = tmp_path / "hub" / "checkpoints"
    assert missing.searched == (str(tmp_path), str(tmp_path / "absent"), str(hub))
    assert f"{net}.backbone.pth" in missing.reason
    assert "trunk" in missing.reason
    (tmp_path / f"{net}.backbone.pth").touch()  # an empty trunk, but the search comes first
    missing = load_lpips(net, tmp_path)
    assert isinstance(missing, Missing)
    assert f"linear/{net}.pth" in missing.reason


def test_unknown_networks_and_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="did you mean 'alex'"):
        load_lpips("alexnet")
    with pytest.raises(DataError, match="not a folder"):
        load_lpips("alex", tmp_path / "absent")


def spoil(name: str, trunk: Weights, path: Path) -> None:
    """Write a broken trunk to ``path``."""
    if name == "garbage":
        path.write_bytes(b"<html>not found</html>")
    elif name == "empty":
        path.write_bytes(b"")
    elif name == "truncated":
        torch.save(trunk, path)
        path.write_bytes(path.read_bytes()[:5000])
    elif name == "list":
        torch.save([1, 2, 3], path)
    elif name == "missing key":
        torch.save({k: v for k, v in trunk.items() if k != "3.bias"}, path)
    elif name == "wrong shape":
        torch.save({**trunk, "0.weight": torch.zeros(64, 3, 3, 3)}, path)
    elif name == "nan":
        torch.save({**trunk, "0.bias": torch.full((64,), math.nan)}, path)
    elif name == "code":
        torch.save({"0.weight": print}, path)


KINDS = ("garbage", "empty", "truncated", "list", "missing key", "wrong shape", "nan", "code")


@pytest.mark.parametrize("kind", KINDS)
def test_broken_weights_are_bad_data_in_one_line(kind: str, tmp_path: Path) -> None:
    with torch.device("meta"):
        shapes = {k: v.shape for k, v in ARCHITECTURES["alex"].build().state_dict().items()}
    path = tmp_path / "alex.backbone.pth"
    spoil(kind, {key: torch.zeros(shape) for key, shape in shapes.items()}, path)
    linear = [torch.ones(count) for count in ARCHITECTURES["alex"].channels]
    torch.save(named(linear), tmp_path / "alex.pth")
    with pytest.raises(DataError) as caught:
        load_lpips("alex", tmp_path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_broken_linear_layers_are_bad_data(made, tmp_path: Path) -> None:
    net, _, trunk, linear = made
    torch.save(trunk, tmp_path / f"{net}.backbone.pth")
    torch.save(named(linear[:-1]), tmp_path / f"{net}.pth")
    with pytest.raises(DataError, match="lacks 'lin"):
        load_lpips(net, tmp_path)


def test_squeeze_reproduces_the_example_in_the_torchmetrics_documentation(
    shared_data: Path,
) -> None:
    lpips = load("squeeze", shared_data / "lpips")
    generator = torch.Generator().manual_seed(42)
    first, second = (torch.rand(2, 3, 100, 100, generator=generator) * 2 - 1 for _ in range(2))
    expected = torch.tensor([0.1024, 0.0938])
    torch.testing.assert_close(lpips.distance(first, second), expected, atol=5.1e-5, rtol=0)


@pytest.mark.parametrize("net", ["alex", "squeeze"])
def test_real_weights_grow_with_the_noise(net: str, shared_data: Path) -> None:
    lpips = load(net, shared_data / "lpips")
    rows, columns = torch.meshgrid(
        torch.linspace(0, 9, 64), torch.linspace(0, 7, 64), indexing="ij"
    )
    x = (0.5 + 0.4 * torch.stack([rows.sin(), columns.cos(), (rows + columns).sin()], -1)).float()
    noise = torch.randn(x.shape, generator=torch.Generator().manual_seed(1))
    values = [lpips((x + level * noise).clamp(0, 1), x) for level in (0.0, 0.02, 0.1, 0.4)]
    assert values == sorted(values)
    assert values[0] == 0.0
    assert values[1] > 1e-4


def test_weights_are_known_by_the_hashes_of_their_files(made, tmp_path: Path) -> None:
    net, folder, _, _ = made
    names = {"trunk": f"{net}.backbone.pth", "linear": f"{net}.pth"}
    expected = {
        kind: hashlib.sha256((folder / name).read_bytes()).hexdigest()[:16]
        for kind, name in names.items()
    }
    assert weights_hashes(folder) == {other: expected if other == net else None for other in NETS}
    assert weights_hashes(tmp_path) == dict.fromkeys(NETS)
