"""What every plug-in of a training must keep to, whatever its kind."""

from __future__ import annotations

import sys
from pathlib import Path

from training_checks import STEPS, assert_same_tensors, copies, preset_of, run_of, trainer_of

from gsdmsr_cli.backends.cpu import jit
from gsdmsr_cli.training.trainer import Trainer


def assert_trains_the_same_in_all_ways(data: Path, folder: Path, *options: str) -> Trainer:
    """Train alone, with a worker, and resumed from a checkpoint; return the first trainer.

    All three end with the same tensors to the last bit, and the loss falls.
    """
    # one loss all the time, so that its end can be told from its beginning
    preset = preset_of("training.views_per_step=2", "losses.quadratic=0", *options)
    alone = trainer_of(data, preset)
    losses = [float(alone.step().loss) for _ in range(STEPS)]
    assert sum(losses[-10:]) < sum(losses[:10])
    end = copies(alone.checkpoint().tensors)
    if sys.platform.startswith("linux") and jit.set_threads(2) == 2 and jit.may_fork():
        with trainer_of(data, preset) as helped:
            helped.start_workers(lambda: None)
            assert len(helped.workers) == 2
            assert [float(helped.step().loss) for _ in range(STEPS)] == losses
        assert_same_tensors(copies(helped.checkpoint().tensors), end)
    jit.set_threads(0)
    first, second = trainer_of(data, preset), trainer_of(data, preset)
    for _ in range(STEPS // 2):
        first.step()
    run = run_of(first, folder / "run")
    run.save(first.checkpoint())
    second.restore(run.load())
    for _ in range(STEPS - STEPS // 2):
        second.step()
    assert_same_tensors(copies(second.checkpoint().tensors), end)
    return alone
