"""Copies a scene of the PanopticSports layout, with some train cameras as those of the test split.

So options can be compared on views that nothing was trained on, without looking at the real test
split. Pictures that nobody asks for are not copied; masks of what moves are, by which ``eval``
tells the moving pixels from the others.

python tests/training/fewer_cameras.py SCENE OUT --held 4 11 18 26 --moments 1
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path
from typing import Any

LISTS = "k", "w2c", "fn", "cam_id"
"""By moment, then by camera."""


def part(document: dict[str, Any], cameras: set[int], moments: int) -> dict[str, Any]:
    """Return what a meta file says of some cameras and the first moments."""
    rows = [i for i, camera in enumerate(document["cam_id"][0]) if camera in cameras]
    chosen = {key: [[own[i] for i in rows] for own in document[key][:moments]] for key in LISTS}
    return {"w": document["w"], "h": document["h"], **chosen}


def copy(source: Path, target: Path) -> None:
    """Copy a file, with the folders that it lies in."""
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(source, target)


def main() -> None:
    """Write the scene."""
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("scene", type=Path)
    asked.add_argument("out", type=Path)
    asked.add_argument("--held", type=int, nargs="+", required=True)
    asked.add_argument("--moments", type=int, default=1000000)
    args = asked.parse_args()
    document = json.loads((args.scene / "train_meta.json").read_text(encoding="utf-8"))
    held, known = set(args.held), set(document["cam_id"][0])
    if not held < known:
        asked.error(f"--held names {sorted(held - known)}; there are {sorted(known)}")
    args.out.mkdir(parents=True)
    for name, cameras in (("train", known - held), ("test", held)):
        own = part(document, cameras, args.moments)
        for file in (file for moment in own["fn"] for file in moment):
            copy(args.scene / "ims" / file, args.out / "ims" / file)
            mask = Path("seg") / Path(file).with_suffix(".png")
            if (args.scene / mask).is_file():
                copy(args.scene / mask, args.out / mask)
        (args.out / f"{name}_meta.json").write_text(json.dumps(own), encoding="utf-8")
        print(f"{name}: {len(cameras)} cameras, {len(own['fn'])} moments")


if __name__ == "__main__":
    main()
