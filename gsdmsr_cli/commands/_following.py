"""What ``gsdmsr train`` does in every rank but the first: the same steps, and no run folder."""

from __future__ import annotations

from gsdmsr_cli import raster
from gsdmsr_cli.commands._party import Party
from gsdmsr_cli.commands._preparing import prepare, read, start_work
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.locks import one_of_readers
from gsdmsr_cli.options.preset import Preset
from gsdmsr_cli.scene.scene import Scene
from gsdmsr_cli.scene.segments import between
from gsdmsr_cli.training import loop
from gsdmsr_cli.training.request import Request


def follow(request: Request, party: Party) -> None:
    """Make the steps of a training that the first rank keeps.

    Raises:
        DataError: this rank cannot read the data.
        SystemExit: another rank cannot begin, as the first one says.
        KeyboardInterrupt: Ctrl-C ended the training.
    """
    say.speak_up_to(say.WARNINGS)  # notes and progress are the first rank's
    scene: Scene
    with one_of_readers(request.data):
        with party.all_or_none():
            device, scene = raster.pick_device(request.device), read(request)
        complete: bool | None = party.tell(None)
        if complete:
            return
        options: Preset = party.tell(None)
        with party.all_or_none():
            scene = between(scene, *options.data.between)
            party.require_same(scene)
        _make_steps(scene, options, request, party, device)


def _make_steps(scene: Scene, options: Preset, request: Request, party: Party, device: str) -> None:
    with party.all_or_none():
        trainer = prepare(scene, options, party, device)
    if request.dry_run:
        return
    with trainer:
        with party.all_or_none():
            pass  # the first one opens the run folder
        party.level(trainer)
        if request.out.is_dir():  # on a disk that all ranks share
            trainer.renderer.cache_in(request.out)
        start_work(trainer, device)
        finished = loop.follow(trainer)
    with party.all_or_none():
        pass  # the first one writes what it has to
    if not finished:
        raise KeyboardInterrupt
