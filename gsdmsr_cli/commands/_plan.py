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
from gsdmsr_cli.options.preset import Preset
from gsdmsr_cli.training.gradients.workers import processes_for
from gsdmsr_cli.training.memory import estimate
from gsdmsr_cli.training.trainer import Trainer


def say_plan(trainer: Trainer, name: str, reason: str | None, device: str) -> None:
    """Print what a training that is ready to begin, or to go on, would do."""
    options = trainer.preset
    described = describe_options(options)
    changed = {o["key"]: o["value"] for o in described if o["value"] != o["default"]}
    views = trainer.scene.split("train")
    camera = trainer.renderer.pictures.camera(views[0])
    processes = processes_for(trainer.views_per_step) if device == "cpu" else 1
    plan: dict[str, Any] = {
        "preset": name,
        "reason": reason,
        "length": options.training.budget or f"{options.training.steps} steps",
        **_stream(options, trainer),
        "begins_at_step": trainer.clock.step,
        "splats": len(trainer.model.splats),
        "splats_at_most": options.density.cap,
        "size": [camera.width, camera.height],
        "memory_mib": estimate(views, options, processes).in_mib(),
        "device": device,
        "threads": threads(),
        "processes": processes,
    }
    document = {"dry_run": True, **plan, "options": changed, "scene": facts_of(trainer.scene)}
    say.result(document, _table(plan), _options(changed), "nothing has been written")


def _stream(options: Preset, trainer: Trainer) -> dict[str, Any]:
    """Return how many moments are trained one after the other, and how long all but the first."""
    if not options.stream.enabled:
        return {}
    each = options.stream.budget or f"{options.stream.steps} steps"
    return {"moments": len(trainer.scene.train_times), "each_moment": each}


def _table(plan: dict[str, Any]) -> Table:
    table = Table(show_header=False)
    for key, value in plan.items():
        if value is not None:
            table.add_row(key.replace("_", " "), escape(_text(value)))
    return table


def _text(value: Any) -> str:
    if isinstance(value, dict):  # a sum and its parts
        total, *parts = value.items()
        return f"{total[1]} ({', '.join(f'{name} {size}' for name, size in parts if size)})"
    return " x ".join(map(str, value)) if isinstance(value, list) else str(value)


def _options(changed: dict[str, Any]) -> str:
    lines = [f"  {key} = {json.dumps(value)}" for key, value in changed.items()]
    return "\n".join(["options other than their defaults:", *(lines or ["  none"])])
