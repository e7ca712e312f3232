"""Reads and writes the moments of a stream: one small file each, in a folder of the run.

    RUN/moments/000000.safetensors   the first: the splats, and all of the model that stays
    RUN/moments/000001.safetensors   where they are, and how they are turned, at the second
    ...

Places and turns are whole numbers of steps. A keyframe holds them whole, other moments hold the
difference from the keyframe before; both are compressed. So a moment is read from its own file and
that of its keyframe, and rounding does not add up. Files appear when they are whole.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save_file
from torch import Tensor

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.files import remove_if_empty, remove_leftovers, replacing, written_apart
from gsdmsr_cli.runs import steps
from gsdmsr_cli.runs.checkpoints import WRONG
from gsdmsr_cli.runs.steps import Array

FOLDER = "moments"
"""In a run folder."""

SCHEMA = 1

TRACKS = "offsets", "turns"
"""What a moment after the first holds, (R, 3) and (R, 4), see ``model.motion._streamed``."""

NOTHING: Mapping[str, Tensor] = MappingProxyType({})

_NAME = re.compile(r"(\d{6,})\.safetensors")


@dataclass(frozen=True)
class Rounding:
    """How moments are written.

    Attributes:
        place_step: what offsets are rounded to [scene bounds].
        turn_step: what turns are rounded to.
        keyframe_every: moments from one keyframe to the next.
    """

    place_step: float
    turn_step: float
    keyframe_every: int


@dataclass(frozen=True, eq=False)
class Written:
    """The file of a moment.

    Attributes:
        about: what it says of itself: "moment", "time", "keyframe", and what was told of it.
        tensors: what it holds.
        sha256: of the file.
        size: of the file [bytes].
    """

    about: dict[str, Any]
    tensors: dict[str, Tensor]
    sha256: str
    size: int


def path_of(root: Path, moment: int) -> Path:
    """Return the file of a moment of the run folder ``root``."""
    return root / FOLDER / f"{moment:06d}.safetensors"


def there(root: Path) -> list[int]:
    """Return the moments that there are, ascending; none where no stream has written any."""
    try:
        found = [_NAME.fullmatch(path.name) for path in (root / FOLDER).iterdir()]
    except OSError:
        return []
    return sorted(int(match[1]) for match in found if match is not None)


def rewind(root: Path, moment: int) -> None:
    """Remove the files of a moment and of all later ones, and what was being written.

    Raises:
        OSError: one cannot be removed.
    """
    if (root / FOLDER).is_dir():
        remove_leftovers(root / FOLDER)
        for later in reversed(there(root)):
            if later >= moment:
                path_of(root, later).unlink()
        remove_if_empty(root / FOLDER)


def write_first(
    root: Path, tensors: Mapping[str, Tensor], rows: int, time: float, told: object
) -> int:
    """Write the first moment; return its bytes.

    Args:
        root: the run folder.
        tensors: those of the model that stay.
        rows: how many rows the later moments have.
        time: of the moment, in [0, 1].
        told: plain JSON that is kept with it.

    Raises:
        DataError: it cannot be written.
    """
    whole = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    return _write(root, 0, whole, {"time": time, "keyframe": 0, "rows": rows, "told": told})


def write(
    root: Path,
    moment: int,
    time: float,
    values: Mapping[str, Tensor],
    rounding: Rounding,
    told: object,
    whole: Mapping[str, Tensor] = NOTHING,
) -> int:
    """Write a moment after the first; return its bytes.

    Args:
        root: the run folder.
        moment: its number, 1 or more.
        time: of the moment, in [0, 1].
        values: see ``TRACKS``, all finite.
        rounding: what they are rounded to.
        told: plain JSON that is kept with it.
        whole: further tensors, which are written in half precision, means in single.

    Raises:
        DataError: it cannot be written, or its keyframe not be read.
    """
    lengths = dict(zip(TRACKS, (rounding.place_step, rounding.turn_step), strict=True))
    key = moment - moment % rounding.keyframe_every
    levels_of = {n: steps.rounded(values[n].detach().cpu().numpy(), lengths[n]) for n in TRACKS}
    before = {} if key in (0, moment) else _levels(root, read(root, key))
    packed, described = {}, {}
    for name, tensor in whole.items():
        own = tensor.detach().cpu()
        packed[name] = (own if name.endswith("means") else own.half()).contiguous()
    for name, levels in levels_of.items():
        packed[name], described[name] = steps.encode(levels - before.get(name, 0))
    about = {"time": time, "keyframe": key, "steps": lengths, "packed": described, "told": told}
    return _write(root, moment, packed, about)


def read(root: Path, moment: int) -> Written:
    """Return the file of a moment.

    Raises:
        DataError: it is not there, or damaged.
    """
    path = path_of(root, moment)
    try:
        data = path.read_bytes()
        length = int.from_bytes(data[:8], "little")
        about = json.loads(json.loads(data[8 : 8 + length])["__metadata__"]["gsdmsr"])
        if about["schema"] != SCHEMA or about["moment"] != moment:
            raise ValueError(f"it says schema {about['schema']}, moment {about['moment']}")
        return Written(about, load(data), hashlib.sha256(data).hexdigest(), len(data))
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (SafetensorError, *WRONG) as error:
        raise _damaged(root, moment, error) from error


def tracks_of(root: Path, found: Written) -> dict[str, Tensor]:
    """Return offsets (R, 3) and turns (R, 4) of a moment after the first.

    Read with no other file than that of its keyframe.

    Raises:
        DataError: one of them is not there, or damaged.
    """
    key, moment = int(found.about["keyframe"]), int(found.about["moment"])
    try:
        levels = _levels(root, found)
        if key not in (0, moment):
            before = _levels(root, read(root, key))
            levels = {name: levels[name] + before[name] for name in TRACKS}
        return {
            name: torch.from_numpy(steps.values(levels[name], found.about["steps"][name]))
            for name in TRACKS
        }
    except WRONG as error:
        raise _damaged(root, moment, error) from error


def _levels(root: Path, found: Written) -> dict[str, Array]:
    """Return the whole numbers that a file holds."""
    try:
        described = found.about["packed"]
        return {name: steps.decode(found.tensors[name], described[name]) for name in TRACKS}
    except WRONG as error:
        raise _damaged(root, int(found.about["moment"]), error) from error


def _write(root: Path, moment: int, tensors: Mapping[str, Tensor], about: Mapping[str, Any]) -> int:
    path = path_of(root, moment)
    told = json.dumps({"schema": SCHEMA, "moment": moment, **about}, allow_nan=False)
    try:
        path.parent.mkdir(exist_ok=True)
    except OSError as error:
        raise DataError(f"{path.parent}: cannot be made: {error.strerror or error}") from error
    with replacing(path) as beside, written_apart(beside) as own:
        try:
            save_file(dict(tensors), own, metadata={"gsdmsr": told})
        except SafetensorError as error:
            raise OSError(str(error)) from error
    return path.stat().st_size


def _damaged(root: Path, moment: int, error: Exception) -> DataError:
    return DataError(
        f"{path_of(root, moment)}: damaged: {error}; train again with --overwrite, or remove it "
        "if it is no keyframe: the moments beside it are then joined"
    )
