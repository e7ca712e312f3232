"""Says what a training would do, for ``gsdmsr train --dry-run``."""

from __future__ import annotations

import json
from typing import Any

from rich.markup import escape
from rich.table import Table

from gsdmsr_cli.backends.cpu.jit import threads
from gsdmsr_cli.commands._info_scene import facts_of
from gsdmsr_cli.commands.presets import describe_options
from gsdmsr_cli.ground import say
from gsdmsr_cli.training.gradients.workers import processes_for
from gsdmsr_cli.training.trainer import Trainer


def say_plan(trainer: Trainer, name: str, reason: str | None, device: str) -> None:
    """Print what a training that is ready to begin, or to go on, would do."""
    options = trainer.preset
    described = describe_options(options)
    changed = {o["key"]: o["value"] for o in described if o["value"] != o["default"]}
    camera = trainer.renderer.pictures.camera(trainer.scene.split("train")[0])
    plan: dict[str, Any] = {
        "preset": name,
        "reason": reason,
        "length": options.training.budget or f"{options.training.steps} steps",
        "begins_at_step": trainer.clock.step,
        "splats": len(trainer.model.splats),
        "splats_at_most": options.density.cap,
        "size": [camera.width, camera.height],
        "pictures_mib": _pictures_mib(trainer),
        "device": device,
        "threads": threads(),
        "processes": processes_for(options.training.views_per_step) if device == "cpu" else 1,
    }
    document = {"dry_run": True, **plan, "options": changed, "scene": facts_of(trainer.scene)}
    say.result(document, _table(plan), _options(changed), "nothing has been written")


def _pictures_mib(trainer: Trainer) -> int:
    """Return the memory that the train pictures and their halves would take, within the bound."""
    views, pictures = trainer.scene.split("train"), trainer.renderer.pictures
    cameras = [pictures.camera(view) for view in views]
    halves = 1.25 if trainer.preset.training.low_resolution_until > 0 else 1.0
    size = sum(3 * camera.width * camera.height for camera in cameras) * halves
    return min(round(size / (1 << 20)), trainer.preset.data.cache_mib)


def _table(plan: dict[str, Any]) -> Table:
    table = Table(show_header=False)
    for key, value in plan.items():
        if value is not None:
            text = " x ".join(map(str, value)) if isinstance(value, list) else str(value)
            table.add_row(key.replace("_", " "), escape(text))
    return table


def _options(changed: dict[str, Any]) -> str:
    lines = [f"  {key} = {json.dumps(value)}" for key, value in changed.items()]
    return "\n".join(["options other than their defaults:", *(lines or ["  none"])])
