"""How help is laid out: the panel that each option stands in, and an example of each command."""

from __future__ import annotations

import re

PANELS = {
    "Data": (
        "data", "downscale", "background", "split", "format_", "rig", "offset", "frames",
        "max_side", "test_every", "time", "view", "path", "folders",
    ),
    "Length": ("budget", "steps", "resume"),
    "Options of the training": ("preset", "config", "set_", "overrides", "seed"),
    "Cameras": (
        "features", "camera_model", "matching", "mapping", "min_registered",
    ),
    "Masks": ("masks", "invert_masks", "auto_mask", "no_mark_motion"),
    "Metrics": ("lpips_weights", "lpips_inria"),
    "Gates": ("fail_under", "fail_over", "baseline", "tolerance", "junit", "github_summary"),
    "Pictures": ("output", "video", "size", "scale", "supersample", "fps"),
    "Output": (
        "out", "overwrite", "keep", "keep_stages", "report", "dry_run", "tensorboard", "wandb",
        "live", "port",
    ),
    "Machine": ("device", "threads", "jobs", "workers", "ranks"),
}  # fmt: skip
"""Names of functions' parameters by the panel of their options."""

FEW = 8
"""Commands with no more options than this have no panels but the usual one."""

EXAMPLES = {
    "make": "gsdmsr make dog.mp4 --out dog --budget 10m",
    "prepare": "gsdmsr prepare dog.mp4 --out scenes/dog",
    "train": "gsdmsr train --data scenes/dog --out runs/dog --budget 8m",
    "eval": "gsdmsr eval runs/dog --report --fail-under psnr=22",
    "compare": "gsdmsr compare runs/dog runs/other --out compare.html",
    "render": "gsdmsr render runs/dog --path orbit --frames 90 --video mp4",
    "export": "gsdmsr export runs/dog --format ply --time 0.5 --out half.ply",
    "view": "gsdmsr view runs/dog --open",
    "info": "gsdmsr info runs/dog",
    "demo": "gsdmsr demo --out gsdmsr-demo",
    "presets": "gsdmsr presets video",
    "doctor": "gsdmsr doctor --json",
    "weights": "gsdmsr weights --fetch alex",
    "cache": "gsdmsr cache --clear",
    "kernels": "gsdmsr benchmark kernels --device cpu",
    "scenes": "gsdmsr benchmark scenes data/lego --out trials --preset dnerf --budget 2m",
    "resume": "gsdmsr benchmark resume data/lego --out kills --kills 3",
    "still": "gsdmsr benchmark still runs/dog --below 0.3 --below 1",
    "soak": "gsdmsr benchmark soak -- render runs/dog --path orbit",
    "reading": "gsdmsr benchmark reading --out large --pictures 1000",
}
"""An example of each command, by its name."""


def panel_of(parameter: str) -> str | None:
    """Return the panel that the option of a parameter stands in, None for the usual one."""
    return next((panel for panel, names in PANELS.items() if parameter in names), None)


def as_it_is(text: str) -> str:
    """Return a help text whose brackets, such as "[px]", rich takes for what they are."""
    return re.sub(r"\[(?=[a-zA-Z/@#])", r"\\[", text)
