"""What is to be done of a training in segments: the command of each part that is left."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import yaml

from gsdmsr_cli.calling.calls import Line
from gsdmsr_cli.commands._beginning import is_complete
from gsdmsr_cli.commands._results import remove_results
from gsdmsr_cli.ground.files import write_text
from gsdmsr_cli.ground.limits import cores
from gsdmsr_cli.model.layer import Facts
from gsdmsr_cli.options import strict
from gsdmsr_cli.options.durations import parse_duration
from gsdmsr_cli.options.preset import Preset, TrainingOptions
from gsdmsr_cli.runs import segments as parts
from gsdmsr_cli.runs.beginning import continue_run, create_run
from gsdmsr_cli.runs.run import Run, is_run, open_run
from gsdmsr_cli.scene.scene import Scene
from gsdmsr_cli.scene.segments import Segment, cut
from gsdmsr_cli.training.request import Request

_FOR_EVER = 10**9
"""Steps that no training makes."""


class _Dumper(yaml.SafeDumper):  # type: ignore[misc]
    """YAML without aliases, which options may not have."""

    def ignore_aliases(self, data: Any) -> bool:
        """Write values that are the same twice."""
        return True


@dataclass(frozen=True)
class Work:
    """A capture that is to be trained in segments.

    Attributes:
        request: the command line's.
        earlier: the run that goes on; None where it begins.
        options: of all segments, and of the run that joins them.
        name, reason: see ``Run``.
        scene: what is seen of the capture.
    """

    request: Request
    earlier: Run | None
    options: Preset
    name: str
    reason: str | None
    scene: Scene

    @property
    def root(self) -> Path:
        """The run folder that joins all; absolute, as workers elsewhere want it."""
        return self.request.out.absolute()

    @property
    def data(self) -> Path:
        """Folder of the capture, likewise."""
        return self.request.data.absolute()

    @cached_property
    def segments(self) -> list[Segment]:
        """The segments, in their order."""
        return cut(self.options.segments.count, self.options.segments.overlap)

    @property
    def config(self) -> Path:
        """The file of options that all parts are trained with."""
        return self.root / parts.FOLDER / f"{Path(self.name).stem}.yaml"

    @property
    def threads(self) -> int:
        """CPU threads of each part, 0 for all."""
        own, jobs = self.options.training.threads, self.request.jobs
        if own or (jobs == 1 and self.request.workers is None):
            return own
        return 1 if self.request.workers is not None else max(1, cores() // jobs)

    def moments(self, segment: Segment) -> int:
        """Return how many distinct times of train views lie in a segment."""
        return sum(map(segment.holds, self.scene.train_times))

    def open_folder(self) -> None:
        """Make the run folder, or describe it anew, and write the options of the parts.

        Raises:
            DataError: it cannot be written.
        """
        if self.earlier is not None:
            continue_run(self.earlier, self.options, self.scene)
        else:
            if self.request.overwrite:
                remove_results(self.root)
            bound = self.scene.bound
            box = (-bound, -bound, -bound), (bound, bound, bound)
            facts = Facts(bound, box, len(self.scene.train_times))
            about = self.name, self.options, facts, self.scene, self.request.overwrite
            create_run(self.root, *about, self.reason, self.request.verify)
        document = {"base": "default", **strict.dump(self.options)}
        self.config.parent.mkdir(exist_ok=True)
        write_text(self.config, yaml.dump(document, Dumper=_Dumper, sort_keys=False))

    def left_of_static(self) -> Iterator[Line]:
        """Yield the command that is left of the training of what stands still, if any is."""
        share = self.options.segments.static_share
        length = shortened(self.options.training, share)
        still = ["training.static_until=1", f"training.static_steps={_FOR_EVER}"]
        yield from self._left(parts.static_of(self.root), length, [*still, "training.window=1"])

    def left_of(self, number: int) -> Iterator[Line]:
        """Yield the command that is left of the training of a segment, if any is."""
        segment, (first, last) = self.segments[number], self.options.data.between
        ends = [first + end * (last - first) for end in (segment.start, segment.end)]
        own = [f"data.between={ends}", *self._start()]
        yield from self._left(parts.folder_of(self.root, number), self.options.training, own)

    def _start(self) -> list[str]:
        if not self.options.segments.static_share:
            return []
        return [f"splats.of_run={json.dumps(str(parts.static_of(self.root)))}"]

    def _left(self, folder: Path, length: TrainingOptions, own: Sequence[str]) -> Iterator[Line]:
        run = open_run(folder) if is_run(folder) else None
        begun = run is not None and run.has_checkpoint
        if run is not None and begun and is_complete(run, run.load_whole()[0], length):
            return
        request = self.request
        places = ["train", "--data", str(self.data), "--out", str(folder)]
        given = [f"training.budget={json.dumps(length.budget)}", f"training.steps={length.steps}"]
        given += [f"training.threads={self.threads}"]
        if begun:
            given += [text for text in own if text.startswith("splats.of_run=")]
        else:
            places += ["--config", str(self.config), "--overwrite"]
            given += ["segments.count=1", *own]
        settings = [f"--set={text}" for text in given]
        further = ["--device", request.device, *(["--resume"] if begun else [])]
        further += ["--verify-data"] if request.verify else []
        further += ["--tensorboard"] if request.tensorboard else []
        further += ["--wandb", request.wandb] if request.wandb else []
        yield [*places, *settings, *further]


def shortened(training: TrainingOptions, share: float) -> TrainingOptions:
    """Return options of a training with a share of the length."""
    steps, budget = max(1, round(training.steps * share)), training.budget
    if budget is not None:
        budget = f"{parse_duration(budget) * share:.12g}s"
    return replace(training, steps=steps, budget=budget)
