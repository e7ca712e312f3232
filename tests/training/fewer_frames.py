"""Copies a scene of `gsdmsr prepare` with fewer train pictures, to measure what these are worth.

python tests/training/fewer_frames.py SCENE OUT --keep 2
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path


def main() -> None:
    """Keep every so many of all frames for training; cameras and test pictures stay."""
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("scene", type=Path)
    asked.add_argument("out", type=Path)
    asked.add_argument("--keep", type=int, default=2)
    args = asked.parse_args()
    shutil.copytree(args.scene, args.out)
    path = args.out / "transforms.json"
    document = json.loads(path.read_text(encoding="utf-8"))
    kept = {frame["file_path"] for frame in document["frames"][:: args.keep]}
    train = [name for name in document["train_filenames"] if name in kept]
    listed = {*train, *document["val_filenames"], *document["test_filenames"]}
    document["train_filenames"] = train
    document["frames"] = [one for one in document["frames"] if one["file_path"] in listed]
    path.write_text(json.dumps(document), encoding="utf-8")
    print(f"{len(train)} train pictures, {len(document['test_filenames'])} test pictures")


if __name__ == "__main__":
    main()
