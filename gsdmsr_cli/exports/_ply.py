"""Reads and writes splats as PLY files in the layout of 3DGS (Kerbl et al. 2023)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from gsdmsr_cli.exports._source import as_written
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.files import replacing
from gsdmsr_cli.scene.vertices import read_vertices

Array = NDArray[np.float32]

_MEANS = ("x", "y", "z")
_NORMALS = ("nx", "ny", "nz")
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_OPACITY = ("opacity",)
_SCALES = ("scale_0", "scale_1", "scale_2")
_QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
_REST_COUNTS = (0, 9, 24, 45)  # spherical harmonics of degree 0 to 3, without the constant


def write_ply(path: Path, splats: Splats) -> None:
    """Write splats as the standard 3DGS PLY, little-endian float32.

    Columns: x y z, nx ny nz (zeros), f_dc_*, f_rest_* (all red, all green, all blue; none at
    degree 0), opacity (logit), scale_* (natural logarithm), rot_* (wxyz, unit length). Axes are
    the scene's, as COLMAP's. The file appears whole or not at all; its folder is made.

    Raises:
        DataError: a splat holds NaN or infinity, or the file cannot be written.
    """
    table = columns_of(as_written(splats, path))
    header = [*header_of(splats), "end_header", ""]
    with replacing(path) as beside:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside.write_bytes("\n".join(header).encode("ascii") + table.tobytes())


def header_of(splats: Splats) -> list[str]:
    """Return the lines of the header up to the end of the splats' properties."""
    names = _column_names(3 * (splats.sh.shape[1] - 1))
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(splats)}"]
    return header + [f"property float {name}" for name in names]


def read_ply(path: Path) -> Splats:
    """Read a 3DGS PLY; its properties may come in any order and have any scalar type.

    Raises:
        DataError: the file cannot be read, is cut short or is not a PLY of splats.
    """
    rows = read_vertices(path)
    return _splats(rows, _count_rest(path, rows.dtype.names or ()))


def _column_names(rest: int) -> tuple[str, ...]:
    """Return the standard columns with ``rest`` non-constant harmonics, in their order."""
    rests = tuple(f"f_rest_{i}" for i in range(rest))
    return _MEANS + _NORMALS + _DC + rests + _OPACITY + _SCALES + _QUATS


def columns_of(splats: Splats) -> Array:
    """Return columns, (N, 17 + 3 (K - 1)) little-endian float32; quaternions are of unit length."""
    columns = [
        splats.means,
        torch.zeros_like(splats.means),
        splats.sh[:, 0],
        splats.sh[:, 1:].transpose(1, 2).flatten(1),
        splats.logit_opacities[:, None],
        splats.log_scales,
        splats.quats,
    ]
    return torch.cat(columns, dim=1).numpy().astype("<f4", copy=False)


def _count_rest(path: Path, known: tuple[str, ...]) -> int:
    """Return the number of non-constant harmonics; raise DataError unless all columns are there."""
    rest = sum(name.startswith("f_rest_") for name in known)
    if rest not in _REST_COUNTS:
        raise DataError(f"{path} has {rest} f_rest properties; allowed: 0, 9, 24, 45")
    required = set(_column_names(rest)) - set(_NORMALS)
    if missing := sorted(required - set(known)):
        raise DataError(f"{path} is not a PLY of splats; it lacks {', '.join(missing)}")
    return rest


def _splats(rows: NDArray[np.void], rest: int) -> Splats:
    """Turn the rows of a file with ``rest`` non-constant harmonics into splats."""

    def columns(*names: str) -> torch.Tensor:
        stacked = [torch.from_numpy(rows[name].astype(np.float32)) for name in names]
        return torch.stack(stacked, dim=1) if stacked else torch.empty(len(rows), 0)

    harmonics = columns(*(f"f_rest_{i}" for i in range(rest)))
    higher = harmonics.reshape(len(rows), 3, rest // 3).transpose(1, 2)
    return Splats(
        means=columns(*_MEANS),
        quats=columns(*_QUATS),
        log_scales=columns(*_SCALES),
        logit_opacities=columns(*_OPACITY)[:, 0],
        sh=torch.cat([columns(*_DC)[:, None], higher], dim=1),
    )
