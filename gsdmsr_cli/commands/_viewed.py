"""Lets people look at a training: snapshots for whoever does, and a server if one is wanted."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import torch

from gsdmsr_cli.commands._showing import scene_facts
from gsdmsr_cli.commands.view import WITH_PARENT
from gsdmsr_cli.ground import say
from gsdmsr_cli.model.building import load_model
from gsdmsr_cli.model.model import MOVING, Model
from gsdmsr_cli.moving.quick import quick_file
from gsdmsr_cli.runs.run import Run
from gsdmsr_cli.training.loop import Report
from gsdmsr_cli.training.trainer import Trainer
from gsdmsr_cli.viewing.snapshots import Snapshots, forget

PATIENCE = 5.0
"""That the server has to end itself [s]."""


@contextmanager
def viewed(folder: Run, trainer: Trainer, port: int | None) -> Iterator[Callable[[Report], None]]:
    """Yield what is to be called at every report; whatever goes wrong with it ends no training.

    Args:
        folder: the run folder.
        trainer: that makes the steps.
        port: of a server that is to run meanwhile, 0 for a free one; None starts none.
    """
    facts = trainer.facts.frames, trainer.facts.bound

    def make() -> bytes:
        model = _copy_of(trainer)
        return quick_file(model, *facts, {"scene": scene_facts(folder, model, trainer.scene)})

    # a stream's page shows the moments that are over, from their files
    shown = not (trainer.model.needs_camera or trainer.preset.stream.enabled)
    snapshots = Snapshots(folder.root, make) if shown else None

    def offer(_report: Report) -> None:
        nonlocal snapshots
        try:
            if snapshots is not None:
                snapshots.offer()
        except Exception as error:  # whatever it is: it must not end a training
            say.warn(f"nothing more is shown of this training: {type(error).__name__}: {error}")
            snapshots = None

    server = None if port is None else _serve(folder, port)
    try:
        yield offer
    finally:
        if server is not None:
            _end(server)
        forget(folder.root)


def _serve(folder: Run, port: int) -> subprocess.Popen[bytes]:
    """Start a server, which says on stderr where it is."""
    command = [sys.executable, "-m", "gsdmsr_cli", "view", str(folder.root), "--port", str(port)]
    return subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=sys.stderr.fileno(),  # ours is for the training's answer
        start_new_session=True,  # Ctrl-C is for the training, which then ends the server
        env=os.environ | {WITH_PARENT: "1"},
    )


def _end(server: subprocess.Popen[bytes]) -> None:
    server.terminate()
    with suppress(subprocess.TimeoutExpired):
        server.wait(PATIENCE)
    server.kill()


@torch.no_grad()
def _copy_of(trainer: Trainer) -> Model:
    """Return the present model on the CPU, apart from the one that is trained."""
    model, preset = trainer.model, trainer.preset
    tensors = {name: tensor.detach().cpu().clone() for name, tensor in model.tensors().items()}
    tensors[MOVING] = torch.tensor(model.moving)
    return load_model(tensors, preset.motion, preset.layers, trainer.facts, trainer.clock.progress)
