"""Computes LPIPS (Zhang et al. 2018) in plain torch, from weights on this machine."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import torch
from torch import Tensor, nn

from gsdmsr_cli.evaluation.lpips_trunks import ARCHITECTURES
from gsdmsr_cli.evaluation.metrics import Missing
from gsdmsr_cli.ground.errors import DataError, UsageError, nearest

NETS = tuple(ARCHITECTURES)
"""Names of the networks: "alex", "squeeze", "vgg"."""

FOLDER_VARIABLE = "GSDMSR_LPIPS_DIR"
"""Environment variable that names a folder of weights."""

# Mean and standard deviation of ImageNet's colours for pictures in [-1, 1].
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_EPSILON = 1e-10

_CHUNK, _DIGITS = 1 << 20, 16


class Lpips:
    """The learned perceptual distance between two pictures; 0 for identical ones."""

    def __init__(self, net: str, trunk: nn.Sequential, weights: list[Tensor]) -> None:
        """Take the trunk of ``net`` and one weight vector (C,) per tap."""
        architecture = ARCHITECTURES[net]
        self.net = net
        self.smallest = architecture.smallest
        self._trunk = trunk.eval()
        self._weights = dict(zip(architecture.taps, weights, strict=True))
        self._shift = weights[0].new_tensor(_SHIFT).view(1, 3, 1, 1)
        self._scale = weights[0].new_tensor(_SCALE).view(1, 3, 1, 1)

    def __call__(self, rendered: Tensor, target: Tensor) -> float:
        """Return the distance between two (H, W, 3) pictures in [0, 1], mapped to [-1, 1].

        Raises:
            DataError: the pictures are smaller than ``smallest`` on a side.
            ValueError: the shapes differ or are not (H, W, 3).
        """
        return self.unscaled(rendered * 2.0 - 1.0, target * 2.0 - 1.0)

    def unscaled(self, rendered: Tensor, target: Tensor) -> float:
        """Return the distance between two (H, W, 3) pictures as they are.

        On [0, 1] this is the variant of the tables of 3DGS and of most papers after it.

        Raises:
            DataError, ValueError: as the distance itself.
        """
        first, second = (image.permute(2, 0, 1)[None] for image in (rendered, target))
        return float(self.distance(first, second))

    @torch.inference_mode()
    def distance(self, first: Tensor, second: Tensor) -> Tensor:
        """Return the distances (B,) between two batches (B, 3, H, W) of pictures in [-1, 1].

        Per tap, both features are divided by their norm over the channels, and the squared
        differences are weighted, summed over the channels and averaged over the picture.

        Raises:
            DataError: the pictures are smaller than ``smallest`` on a side.
            ValueError: the shapes differ or are not (B, 3, H, W).
        """
        self._check_shapes(first, second)
        features = torch.cat([first, second]).to(self._shift)
        features = (features - self._shift) / self._scale
        total = features.new_zeros(len(first))
        for index, layer in enumerate(self._trunk):
            features = layer(features)
            if index in self._weights:
                unit = features / (features.norm(dim=1, keepdim=True) + _EPSILON)
                squares = (unit[: len(first)] - unit[len(first) :]).square()
                total += squares.mean(dim=(2, 3)) @ self._weights[index]
        return total

    def _check_shapes(self, first: Tensor, second: Tensor) -> None:
        """Raise unless both are (B, 3, H, W) of one size, large enough for the trunk."""
        if first.ndim != 4 or first.shape[1] != 3 or first.shape != second.shape:
            raise ValueError(
                f"batches have shapes {tuple(first.shape)} and {tuple(second.shape)}, "
                "not both the same (B, 3, H, W)"
            )
        height, width = first.shape[2:]
        if min(height, width) < self.smallest:
            raise DataError(
                f"pictures of {width} x {height} px are too small for LPIPS with '{self.net}'; "
                f"it needs at least {self.smallest} px a side: lower --downscale"
            )


def load_lpips(net: str, folder: Path | None = None, device: str = "cpu") -> Lpips | Missing:
    """Load LPIPS on ``net`` ("alex", "squeeze" or "vgg"); nothing is ever downloaded.

    The two files, trunk and linear layers, are searched separately in ``folder``, in the folder
    named by $GSDMSR_LPIPS_DIR, then in torch.hub's checkpoints. The trunk may be named
    ``<net>.backbone.pth`` or as torchvision names it, and may hold the whole network or its
    ``features`` alone; the linear layers may be named ``linear/<net>.pth``, ``<net>.pth`` or
    ``lpips_<net>.pth``.

    Raises:
        UsageError: there is no such network.
        DataError: ``folder`` is not a folder, or a weights file is not what its name says.
    """
    trunk_file, linear_file = find_weights(net, folder).values()
    if isinstance(trunk_file, Missing):
        return trunk_file
    if isinstance(linear_file, Missing):
        return linear_file
    weights = _load_linear(linear_file, ARCHITECTURES[net].channels)
    trunk = _load_trunk(trunk_file, net).to(device)
    return Lpips(net, trunk, [weight.to(device) for weight in weights])


def search_folders(folder: Path | None = None) -> list[Path]:
    """Return the folders that are searched for weights, in order.

    Raises:
        DataError: ``folder`` is not a folder.
    """
    if folder is not None and not folder.is_dir():
        raise DataError(f"{folder} is not a folder; --lpips-weights names a folder of weights")
    named = os.environ.get(FOLDER_VARIABLE)
    folders = [folder, Path(named) if named else None, hub_folder()]
    return [path for path in folders if path is not None]


def hub_folder() -> Path:
    """Return the folder in which torch keeps weights."""
    return Path(torch.hub.get_dir()) / "checkpoints"


def weights_in_hub() -> list[Path]:
    """Return the files of weights that ``find_weights`` would use of torch's folder."""
    named = [name for net in NETS for names in _names(net).values() for name in names]
    return [path for path in (hub_folder() / name for name in named) if path.is_file()]


def find_weights(net: str, folder: Path | None = None) -> dict[str, Path | Missing]:
    """Return the files of the "trunk" and the "linear" layers, or why there is none.

    Raises:
        UsageError: there is no such network.
        DataError: ``folder`` is not a folder.
    """
    if net not in ARCHITECTURES:
        raise UsageError(f"unknown LPIPS network '{net}'; {nearest(net, NETS)}")
    folders = search_folders(folder)
    return {kind: _find(net, kind, names, folders) for kind, names in _names(net).items()}


def weights_hashes(folder: Path | None = None) -> dict[str, dict[str, str] | None]:
    """Return by network the beginnings of its files' SHA-256, None where one is missing.

    Raises:
        DataError: ``folder`` is not a folder, or a file cannot be read.
    """
    found: dict[str, dict[str, str] | None] = {}
    for net in NETS:
        hashes = {
            kind: _hash(path, path.stat().st_mtime_ns)
            for kind, path in find_weights(net, folder).items()
            if not isinstance(path, Missing)
        }
        found[net] = hashes if len(hashes) == len(_names(net)) else None
    return found


@cache
def _hash(path: Path, _changed: int) -> str:
    try:
        with path.open("rb") as file:
            state = hashlib.sha256()
            while chunk := file.read(_CHUNK):
                state.update(chunk)
            return state.hexdigest()[:_DIGITS]
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error


def _names(net: str) -> dict[str, tuple[str, ...]]:
    """Return what either file may be called."""
    return {
        "trunk": (f"{net}.backbone.pth", ARCHITECTURES[net].checkpoint),
        "linear": (f"linear/{net}.pth", f"{net}.pth", f"lpips_{net}.pth"),
    }


def _find(net: str, kind: str, names: tuple[str, ...], folders: list[Path]) -> Path | Missing:
    """Return the first of the named files that exists, folder by folder."""
    for path in (folder / name for folder in folders for name in names):
        if path.is_file():
            return path
    looked_for = f"found none of {', '.join(names)}"
    reason = f"no {kind} weights of LPIPS '{net}': {looked_for}; see gsdmsr weights --fetch {net}"
    return Missing(reason, tuple(map(str, folders)))


def _load_trunk(path: Path, net: str) -> nn.Sequential:
    """Load the trunk from a file of the network's ``features``, with or without that prefix."""
    # On "meta" nothing is initialised at random: the global generator stays as it was.
    with torch.device("meta"):
        trunk = ARCHITECTURES[net].build()
    expected = {key: tuple(value.shape) for key, value in trunk.state_dict().items()}
    found = {key.removeprefix("features."): value for key, value in _read(path).items()}
    trunk.load_state_dict(_pick(path, found, expected), assign=True)
    return trunk.requires_grad_(False)


def _load_linear(path: Path, channels: tuple[int, ...]) -> list[Tensor]:
    """Load one weight vector (C,) per tap."""
    expected = {f"lin{i}.model.1.weight": (1, count, 1, 1) for i, count in enumerate(channels)}
    return [weight.flatten() for weight in _pick(path, _read(path), expected).values()]


def _read(path: Path) -> dict[str, Tensor]:
    """Read a file of named tensors."""
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # the unpickler raises whatever the bytes in the file provoke
        summary = str(error).partition("\n")[0] or type(error).__name__
        raise DataError(f"{path} is not a readable weights file: {summary}") from error
    if not isinstance(state, Mapping) or not all(isinstance(v, Tensor) for v in state.values()):
        raise DataError(f"{path} does not hold named tensors; fetch the weights again")
    return {str(key): value for key, value in state.items()}


def _pick(
    path: Path, found: Mapping[str, Tensor], expected: Mapping[str, tuple[int, ...]]
) -> dict[str, Tensor]:
    """Return the expected tensors as float32, each checked for its shape and finite values."""
    for key, shape in expected.items():
        if key not in found:
            raise DataError(f"{path} lacks '{key}'; it holds the weights of something else")
        if tuple(found[key].shape) != shape:
            raise DataError(f"{path}: '{key}' has shape {tuple(found[key].shape)}, not {shape}")
        if not found[key].isfinite().all():
            raise DataError(f"{path}: '{key}' holds NaN or infinite values; fetch it again")
    return {key: found[key].float() for key in expected}
