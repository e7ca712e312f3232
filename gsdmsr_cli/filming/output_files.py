"""The files of one output of a film (pictures, numbers, videos), and a JSON file on their origin.

The JSON file says what the frames depend on, so that a second run keeps the frames that are still
right and draws the others.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsdmsr_cli import __version__
from gsdmsr_cli.filming.outputs import CHANNELS
from gsdmsr_cli.filming.request import VIDEOS
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.files import read_json, remove_if_empty, remove_leftovers, write_json
from gsdmsr_cli.scene.film import Shot
from gsdmsr_cli.scene.imaging import image_size

SCHEMA = 1
_KINDS = ("png", "openexr")
_ORIGIN = ".film.json"
_FRAME = re.compile(r"\d{4,}\.(?:png|exr)")


@dataclass(frozen=True, eq=False)
class OutputFiles:
    """One output of one film on disk.

        DIR/orbit-depth/0000.png ...   pictures, and 0000.exr for outputs with numbers
        DIR/orbit-depth.webm           videos of them
        DIR/orbit-depth.film.json      what the frames depend on; others are stale

    Attributes:
        output: its name.
        target: folder of all films.
        name: of the folder of pictures, "orbit" for rgb, "orbit-depth" for another output.
        count: number of frames.
        size: width and height [px].
        request: what the frames depend on, plain JSON.
        fps: frames a second of the videos.
    """

    output: str
    target: Path
    name: str
    count: int
    size: tuple[int, int]
    request: Mapping[str, Any]
    fps: float

    @property
    def folder(self) -> Path:
        """Where the pictures are."""
        return self.target / self.name

    @property
    def origin(self) -> Path:
        """Where the JSON file is that says what the frames depend on."""
        return self.target / f"{self.name}{_ORIGIN}"

    def video(self, kind: str) -> Path:
        """Where the video of a kind is."""
        return self.target / f"{self.name}.{kind}"

    def png(self, index: int) -> Path:
        """Where the picture of a frame is."""
        return self.folder / f"{index:04d}.png"

    def exr(self, index: int) -> Path | None:
        """Where the numbers of a frame are, if the output has any."""
        return self.folder / f"{index:04d}.exr" if self.output in CHANNELS else None

    def has(self, index: int) -> bool:
        """Return whether all files of a frame are there, whole."""
        files = [path for path in (self.png(index), self.exr(index)) if path is not None]
        try:
            return all(path.is_file() and image_size(path, _KINDS) == self.size for path in files)
        except DataError:
            return False

    def prepare(self, replaceable: bool, anew: bool) -> None:
        """Make the folder, and keep of its content only what the same request gave.

        Args:
            replaceable: frames may be removed even where no JSON file says what they are.
            anew: keep nothing.

        Raises:
            DataError: the folder holds frames that may not be removed, or cannot be written, or
                something else has the JSON file's name.
        """
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            earlier = self._read_origin()
            if earlier is None and not replaceable:
                self._refuse_foreign()
            kept = {} if anew or earlier is None else earlier
            if _of_frames(kept) != _of_frames(self._document()):
                self._remove_frames()
            if kept.get("fps") != self.fps:
                self._remove_videos()
            remove_leftovers(self.folder)
            for path in (self.origin, *map(self.video, VIDEOS)):
                remove_leftovers(self.target, path.name)
        except OSError as error:
            raise DataError(
                f"{self.folder}: cannot be written: {error.strerror or error}"
            ) from error
        write_json(self.origin, self._document())

    def remove(self) -> None:
        """Remove the film, and its folder if nothing else lies there.

        Raises:
            OSError: something cannot be removed.
        """
        self._remove_videos()
        if self.folder.is_dir() and not self.folder.is_symlink():
            self._remove_frames()
            remove_leftovers(self.folder)
            remove_if_empty(self.folder)
        self.origin.unlink()

    def _read_origin(self) -> dict[str, Any] | None:
        """Return what the JSON file says, None if there is none."""
        if not self.origin.exists():
            return None
        document = read_json(self.origin)
        if "gsdmsr" not in document:
            raise DataError(f"{self.origin}: is not of gsdmsr; move it or choose another --out")
        return document

    def _frames(self) -> list[Path]:
        return sorted(path for path in self.folder.iterdir() if _FRAME.fullmatch(path.name))

    def _refuse_foreign(self) -> None:
        """Raise DataError if there are files of the film's names without a JSON file."""
        videos = [self.video(kind) for kind in VIDEOS if self.video(kind).exists()]
        found = [*self._frames(), *videos]
        if found:
            raise DataError(
                f"{self.folder}: there are {len(found)} pictures or videos already that are not "
                f"known to be of gsdmsr, {found[0].name} the first; empty it or choose another "
                "--out"
            )

    def _remove_frames(self) -> None:
        self._remove_videos()
        for path in self._frames():
            path.unlink()

    def _remove_videos(self) -> None:
        for kind in VIDEOS:
            self.video(kind).unlink(missing_ok=True)

    def _document(self) -> dict[str, Any]:
        about = {"schema": SCHEMA, "gsdmsr": __version__, "output": self.output}
        return {**about, **self.request, "fps": self.fps}


def remove_films(target: Path) -> None:
    """Remove what ``render`` has written into a folder: the films that have a JSON file of ours.

    Raises:
        OSError: something cannot be removed.
    """
    for origin in sorted(target.glob(f"*{_ORIGIN}")):
        name = origin.name.removesuffix(_ORIGIN)
        files = OutputFiles("rgb", target, name, 0, (0, 0), {}, 0.0)
        if _is_ours(origin):
            files.remove()
    remove_if_empty(target)


def _is_ours(origin: Path) -> bool:
    """Return whether a JSON file says that it is of gsdmsr."""
    try:
        return "gsdmsr" in read_json(origin)
    except DataError:
        return False


def _of_frames(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return what frames depend on: neither the videos' speed nor where the run lies."""
    return {key: value for key, value in document.items() if key not in ("fps", "run")}


def shots_hash(shots: Sequence[Shot]) -> str:
    """Return a hash of all cameras and moments of a film."""
    digest = hashlib.sha256()
    for shot in shots:
        camera, view = shot.camera, shot.view
        lens = [camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height]
        picture = None if view is None else str(view.image_path.name)
        line = [camera.world_to_camera.tolist(), lens, shot.time, picture]
        digest.update(json.dumps(line).encode())
    return digest.hexdigest()
