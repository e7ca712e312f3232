"""Copies a scene of `gsdmsr prepare` with fewer train pictures, or with some of them held out.

To measure what pictures are worth, and to choose options without a look at the test pictures.

python tests/training/fewer_frames.py SCENE OUT --keep 2
python tests/training/fewer_frames.py SCENE OUT --held 7
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path


def main() -> None:
    """Keep every so many of all frames for training; cameras and test pictures stay.

    Of those that are left every so many become the val split, from the middle of the first so many
    on, so that neither end is among them.
    """
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("scene", type=Path)
    asked.add_argument("out", type=Path)
    asked.add_argument("--keep", type=int, default=1)
    asked.add_argument("--held", type=int, default=0)
    args = asked.parse_args()
    shutil.copytree(args.scene, args.out)
    path = args.out / "transforms.json"
    document = json.loads(path.read_text(encoding="utf-8"))
    kept = {frame["file_path"] for frame in document["frames"][:: args.keep]}
    train = [name for name in document["train_filenames"] if name in kept]
    if args.held:
        document["val_filenames"] = train[args.held // 2 :: args.held]
        train = [name for name in train if name not in document["val_filenames"]]
    listed = {*train, *document["val_filenames"], *document["test_filenames"]}
    document["train_filenames"] = train
    document["frames"] = [one for one in document["frames"] if one["file_path"] in listed]
    path.write_text(json.dumps(document), encoding="utf-8")
    counts = {name: len(document[f"{name}_filenames"]) for name in ("train", "val", "test")}
    print(", ".join(f"{count} {name}" for name, count in counts.items()), "pictures")


if __name__ == "__main__":
    main()
