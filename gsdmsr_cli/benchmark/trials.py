"""Trains and evaluates presets on scenes, each trial by the real commands in a process of its own.

A trial's folder is an ordinary run. What an interrupted benchmark has finished is not done again,
and a training that was cut short goes on from its checkpoint.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsdmsr_cli.calling.calls import Line, call, call_side_by_side
from gsdmsr_cli.evaluation.lpips import weights_hashes
from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.ground.files import read_json
from gsdmsr_cli.ground.limits import cores
from gsdmsr_cli.options.preset import Preset, load_preset
from gsdmsr_cli.runs.checkpoints import Checkpoint
from gsdmsr_cli.runs.outputs import EVALUATION, METRICS
from gsdmsr_cli.runs.run import Run, is_run, open_run


@dataclass(frozen=True)
class Terms:
    """What all trials have in common.

    Attributes:
        downscale: both sides of every picture are divided by this.
        background: "white" or "black".
        split: the views that are compared, "test" or "val".
        lpips_weights: folder of weights, or None for the usual places.
        jobs: how many run side by side.
        cpu_threads: of each, None for its share of the cores.
        workers: of Ray, see ``on_ray.connected``; None runs trials here.
        overrides: options that all trainings have, as ``--set`` takes them.
    """

    downscale: int
    background: str
    split: str
    lpips_weights: Path | None
    jobs: int = 1
    cpu_threads: int | None = None
    workers: str | None = None
    overrides: tuple[str, ...] = ()

    @property
    def threads(self) -> int | None:
        """CPU threads of each, None for what its preset says."""
        if self.cpu_threads is not None:
            return self.cpu_threads
        if self.workers is not None:
            return 1
        return cores() // self.jobs if self.jobs > 1 else None


@dataclass(frozen=True)
class Trial:
    """One preset on one scene.

    Attributes:
        scene: folder of the scene.
        preset: name of the preset, or a file of options that says what it is based on.
        length: a budget such as "8m", or a number of steps.
        seed: of every random choice.
    """

    scene: Path
    preset: str | Path
    length: str | int
    seed: int

    @property
    def name(self) -> str:
        """What the preset is called in tables."""
        return self.preset.stem if isinstance(self.preset, Path) else self.preset

    def options(self, terms: Terms) -> Preset:
        """Return all options of the training.

        Raises:
            UsageError: see ``load_preset``.
        """
        if isinstance(self.preset, Path):
            return load_preset(None, self.preset, self.overrides(terms))
        return load_preset(self.preset, None, self.overrides(terms))

    def folder(self, root: Path) -> Path:
        """Return the run folder below ``root``."""
        length = self.length if isinstance(self.length, str) else f"{self.length}steps"
        return root / self.scene.resolve().name / f"{self.name}-{length}-{self.seed}"

    def log(self, root: Path) -> Path:
        """Return the file for what the trial shows while others run beside it."""
        folder = self.folder(root)
        return folder.with_name(f"{folder.name}.log")

    def overrides(self, terms: Terms) -> list[str]:
        """Return what differs from the preset, as ``--set`` takes it.

        Raises:
            UsageError: an option that all have is one that the trial or the terms have already.
        """
        timed = isinstance(self.length, str)
        own = [
            f"training.budget={json.dumps(self.length) if timed else 'null'}",
            *([] if timed else [f"training.steps={self.length}"]),
            f"training.seed={self.seed}",
            f"data.downscale={terms.downscale}",
            f"data.background={terms.background}",
            *([f"training.threads={terms.threads}"] if terms.threads else []),
        ]
        given = {override.partition("=")[0] for override in own} | {"training.steps"}
        for override in terms.overrides:
            key = override.partition("=")[0]
            if key in given:
                raise UsageError(f"--set {override}: trials have a {key} already; drop it")
        return [*own, *terms.overrides]


def all_trials(
    scenes: Sequence[Path],
    presets: Sequence[str | Path],
    lengths: Sequence[str | int],
    seeds: Sequence[int],
) -> list[Trial]:
    """Return every combination, so ordered that a part of them is a table already.

    Presets follow each other on the same scene, so that a machine whose speed drifts is fair.

    Raises:
        DataError: two scenes or two presets would share a folder.
    """
    for kind, names in (
        ("scene", [scene.resolve().name for scene in scenes]),
        ("preset", [Trial(scenes[0], preset, 1, 0).name for preset in presets]),
    ):
        for name in names:
            if names.count(name) > 1:
                raise DataError(f"two {kind}s are called '{name}'; each needs its own name, once")
    combined = itertools.product(lengths, seeds, scenes, presets)
    return [Trial(scene, preset, length, seed) for length, seed, scene, preset in combined]


def run_trial(trial: Trial, root: Path, terms: Terms) -> dict[str, Any]:
    """Return the trial's ``metrics.json``; train and evaluate as far as that is still to do.

    Raises:
        DataError: the folder holds a training with other options or of other data.
        GsdmsrError: training or evaluation has failed; its own message stands above.
        KeyboardInterrupt: Ctrl-C; the training has saved a checkpoint.
    """
    for line in left_to_do(trial, root, terms):
        call(*line)
    return report_of(trial, root)


def run_side_by_side(trials: Sequence[Trial], root: Path, terms: Terms) -> list[dict[str, Any]]:
    """Do what ``run_trial`` does for several at once; what they show goes to ``trial.log(root)``.

    Raises:
        DataError, GsdmsrError, KeyboardInterrupt: see ``run_trial``; the others are finished, or
            interrupted as well.
    """
    works = {trial.log(root): left_to_do(trial, root, terms) for trial in trials}
    call_side_by_side(works, terms.threads or cores())
    return [report_of(trial, root) for trial in trials]


def report_of(trial: Trial, root: Path) -> dict[str, Any]:
    """Return the ``metrics.json`` of a trial that has come to its end."""
    return read_json(_report_path(trial, root))


def _report_path(trial: Trial, root: Path) -> Path:
    return trial.folder(root) / EVALUATION / METRICS


def left_to_do(trial: Trial, root: Path, terms: Terms) -> Iterator[Line]:
    """Yield the commands that are still to be run, each once those before have ended.

    Raises:
        DataError: see ``run_trial``.
    """
    folder = trial.folder(root)
    run = open_run(folder) if is_run(folder) else None
    if run is not None:
        _require_same(run, trial, terms)
    saved = run.load() if run is not None and run.checkpoint_path.is_file() else None
    if saved is None or saved.progress < 1:
        settings = [f"--set={override}" for override in trial.overrides(terms)]
        how = "--overwrite" if saved is None else "--resume"
        places = ["--data", str(trial.scene), "--out", str(folder)]
        kind = "--config" if isinstance(trial.preset, Path) else "--preset"
        yield ["train", *places, kind, str(trial.preset), *settings, how]
        saved = None
    if saved is None or not _is_report_of(_report_path(trial, root), saved, terms):
        weights = ["--lpips-weights", str(terms.lpips_weights)] if terms.lpips_weights else []
        yield ["eval", str(folder), "--split", terms.split, "--data", str(trial.scene), *weights]


def _require_same(run: Run, trial: Trial, terms: Terms) -> None:
    if run.preset != trial.options(terms):
        raise DataError(
            f"{run.root}: holds a training with other options than '{trial.name}' has now; "
            "choose another --out"
        )
    run.part_of(read_scene(trial.scene))


def _is_report_of(path: Path, saved: Checkpoint, terms: Terms) -> bool:
    """Return whether ``path`` is a report of this checkpoint on these terms.

    One that knows of no weights of LPIPS, where there are some now, or of others, is not.
    """
    if not path.is_file():
        return False
    about = read_json(path)["protocol"]
    found = about["split"], about["background"], about["downscale"], about.get("checkpoint_sha256")
    wanted = terms.split, terms.background, terms.downscale, saved.sha256
    weights, known = weights_hashes(terms.lpips_weights), about.get("lpips_weights", {})
    same = all(known.get(net) == hashes for net, hashes in weights.items() if hashes is not None)
    return found == wanted and same
