"""How a training begins: anew, in a run folder of its own, or where an earlier one has stopped."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

from gsdmsr_cli.commands._choice import Choice
from gsdmsr_cli.commands._results import remove_results
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.ground.locks import sole_writer
from gsdmsr_cli.options import strict
from gsdmsr_cli.options.preset import Preset, TrainingOptions, load_preset
from gsdmsr_cli.runs import moments
from gsdmsr_cli.runs.beginning import continue_run, create_run, refuse_used
from gsdmsr_cli.runs.checkpoints import Checkpoint
from gsdmsr_cli.runs.outputs import OUTPUTS
from gsdmsr_cli.runs.run import Run, is_run, open_run
from gsdmsr_cli.runs.seen_pictures import check_whole
from gsdmsr_cli.scene.scene import Scene
from gsdmsr_cli.scene.segments import between
from gsdmsr_cli.training.request import Request
from gsdmsr_cli.training.schedule import new_clock
from gsdmsr_cli.training.streaming.trainer import StreamTrainer
from gsdmsr_cli.training.trainer import Trainer

MAY_CHANGE = (
    "training.budget", "training.steps", "training.threads", "training.checkpoint_minutes",
    "training.keep", "data.cache_mib", "stream.budget", "stream.steps",
    "splats.of_run", "training.views_per_step", "training.cuda_graphs",
)  # fmt: skip
"""Options that a resumed training may have otherwise: its length, what changes no result, such
as where the run lies now whose splats it has begun with, and what another device may want otherwise
or have no memory for."""


class _CompleteError(UsageError):
    """There is nothing left to train."""


class Anew:
    """A new training.

    Attributes:
        options: all of them, as far as they are known before the scene is.
        name: of the preset, or of the file of options, for reports.
        reason: which preset follows from the data, and why; None where it was named.

    Args:
        request: the command line's.
        held: where locks go that last until the training's end.

    Raises:
        UsageError: an option does not exist or is out of range.
        DataError: the run folder is in use.
    """

    def __init__(self, request: Request, held: ExitStack) -> None:
        self._request = request
        self._choice = Choice(request.preset, request.config, request.overrides)
        self.options = self._choice.check()  # an error now rather than after the data is read
        self.name = ""
        self.reason: str | None = None
        refuse_used(request.out, request.overwrite)
        for name in OUTPUTS:
            if (request.out / name).is_dir():  # goes with the run, but not from under a writer
                held.enter_context(sole_writer(request.out / name))

    def suit(self, scene: Scene) -> Scene:
        """Complete the options by the preset that suits the scene; return what is seen of it.

        Raises:
            UsageError: an option does not exist or is out of range.
            DataError: no train view lies in that part.
        """
        chosen = self._choice.suit(scene)
        self.options, self.name, self.reason = chosen.options, chosen.name, chosen.reason
        if self.reason is not None:
            say.note(f"{self.reason}; --preset names another")
        return between(scene, *self.options.data.between)

    def restore(self, trainer: Trainer) -> None:
        """Leave the training as it is: at its first step."""

    def open_folder(self, trainer: Trainer) -> Run:
        """Return the run folder, made, with a first checkpoint.

        Raises:
            DataError: it cannot be written; a full disk is an error now, not at the end.
        """
        request, scene = self._request, trainer.scene
        if request.overwrite:
            remove_results(request.out)
        about = self.name, self.options, trainer.facts, scene
        folder = create_run(request.out, *about, request.overwrite, self.reason, request.verify)
        folder.save(trainer.checkpoint())
        return folder


class Resumed:
    """A training that goes on from the last checkpoint of its run.

    Attributes, args and errors as those of ``Anew``; a DataError also says that there is no
    checkpoint which is whole, a UsageError that the training is complete.
    """

    def __init__(self, request: Request, held: ExitStack) -> None:
        self._request = request
        self._earlier = open_run(request.out)
        self.options = resumed_options(self._earlier, request)
        self.name, self.reason = self._earlier.name, self._earlier.reason
        self._checkpoint, damage = self._earlier.load_whole()
        if damage:
            say.warn(damage)
        self._require_rest()

    def _require_rest(self) -> None:
        """Raise UsageError if the training is complete; one that was killed as it ended is not."""
        checkpoint = self._checkpoint
        if is_complete(self._earlier, checkpoint, self.options.training):
            raise _CompleteError(
                f"{self._earlier.root}: is complete at step {checkpoint.step} after "
                f"{checkpoint.elapsed:.0f} s; give it a longer --budget or more --steps"
            )

    def suit(self, scene: Scene) -> Scene:
        """Return what is seen of the scene; raise DataError unless it is that of the run."""
        part = self._earlier.part_of(scene)
        if self._request.verify:
            check_whole(self._earlier.root, part)
        return part

    def restore(self, trainer: Trainer) -> None:
        """Take the training to where the checkpoint was made."""
        trainer.restore(self._checkpoint)

    def open_folder(self, trainer: Trainer) -> Run:
        """Return the run folder, with the present options and a log up to the checkpoint.

        Raises:
            DataError: it cannot be written.
        """
        folder = continue_run(self._earlier, self.options, trainer.scene)
        folder.rewind_log(trainer.clock.step)
        if isinstance(trainer, StreamTrainer):
            moments.rewind(folder.root, trainer.clock.moment)
        return folder


Beginning = Anew | Resumed


def after_restart(request: Request, job: str) -> Request | None:
    """Return how a training goes on of which torchrun has started all ranks anew.

    What the job has begun, it goes on with; what lies there from before is treated as asked.

    Returns:
        None where the job had come to its end.
    """
    if not is_run(request.out) or open_run(request.out).job != job:
        say.warn(f"{request.out}: holds nothing of this job, which begins again")
        return request
    if not open_run(request.out).has_checkpoint:
        return replace(request, overwrite=True, resume=False)
    again = replace(request, overwrite=False, resume=True)
    try:
        Resumed(again, ExitStack())
    except _CompleteError:
        return None
    return again


def is_complete(run: Run, checkpoint: Checkpoint, length: TrainingOptions) -> bool:
    """Return whether a training has ended; one that was killed as it did has not."""
    if run.preset.stream.enabled:
        return checkpoint.progress >= 1 and bool(run.account(checkpoint.step))
    clock = new_clock(length)
    clock.step, clock.before = checkpoint.step, checkpoint.elapsed
    return clock.progress >= 1 and bool(run.account(clock.step))


def resumed_options(earlier: Run, request: Request) -> Preset:
    """Return the run's own options, with another length where the command line asks for one.

    Raises:
        UsageError: the command line asks for anything else.
    """
    stored = strict.dump(earlier.preset)
    if request.preset is None and request.config is None:
        own = [f"{topic}={json.dumps(value)}" for topic, value in stored.items()]
        asked = load_preset(None, None, [*own, *request.overrides])
    else:
        asked = load_preset(request.preset, request.config, request.overrides)
    earlier_values, values = _by_option(stored), _by_option(strict.dump(asked))
    for name in earlier_values | values:
        was, now = earlier_values.get(name), values.get(name)
        if was != now and name not in MAY_CHANGE:
            raise UsageError(
                f"{earlier.root}: was trained with {name} = {json.dumps(was)}, not "
                f"{json.dumps(now)}; --resume may change only the length of a training"
            )
    return asked


def _by_option(dumped: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a dumped preset as "topic.key", and lists as "topic"."""
    values: dict[str, Any] = {}
    for topic, value in dumped.items():
        if isinstance(value, dict):
            values |= {f"{topic}.{key}": own for key, own in value.items()}
        else:
            values[topic] = value
    return values
