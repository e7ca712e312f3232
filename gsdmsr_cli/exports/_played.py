"""What exports that are played share: a ``.dsplat`` file of as few bytes as the loss allows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

from gsdmsr_cli.exports._asked import Asked
from gsdmsr_cli.exports._facts import Facts, RunFacts
from gsdmsr_cli.exports._source import Source
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.ground.progress import OnProgress
from gsdmsr_cli.moving.baking import bake
from gsdmsr_cli.moving.choosing import choose
from gsdmsr_cli.moving.coding import described
from gsdmsr_cli.moving.container import to_bytes
from gsdmsr_cli.moving.playing import model_of
from gsdmsr_cli.options.strict import require


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        loss: what coding may lose at most in the mean over some views, above 0 [dB].
    """

    loss: float = 0.1

    def __post_init__(self) -> None:
        require(self, "loss", 0 < self.loss <= 10, "above 0 and at most 10 dB")


def lost(source: Source, options: Options) -> list[str]:
    """Return what the file cannot carry."""
    return source.lost_at(0.0)


def file_of(source: Source, facts: Facts, options: Options, on_progress: OnProgress) -> bytes:
    """Return the file of a model; what it says of itself goes to ``source.details``.

    Raises:
        UsageError: something is asked for that files of moving splats do not have.
        DataError: a splat holds NaN or infinity, or the finest coding loses too much.
    """
    _refuse_what_stays(source.asked)
    run = cast(RunFacts, facts)
    baked = bake(source.model, facts.frames)
    judge = run.judge(source.model)
    chosen = choose(
        baked, facts.bound, options.loss, lambda other: judge.loss(model_of(other)), on_progress
    )
    header = {**described(baked), "scene": run.shown(source.model), "about": run.about()}
    data = to_bytes(header, chosen.parts)
    sizes = {part.name: len(part.stream) for part in chosen.parts}
    source.counts.append(len(baked.splats))
    source.details.update(
        bytes=len(data),
        bytes_of={"header": len(data) - sum(sizes.values()), **sizes},
        psnr=judge.psnr,
        loss_db=chosen.loss,
        measured_on="train views" if judge.knows_truth else "a circle",
    )
    return data


def _refuse_what_stays(asked: Asked) -> None:
    """Raise UsageError if other axes, units, harmonics or fewer splats are wanted."""
    usual = Asked(axes="scene", lossy=asked.lossy)
    for name in ("axes", "scale", "sh_degree", "min_opacity"):
        if getattr(asked, name) != getattr(usual, name):
            raise UsageError(
                f"--{name.replace('_', '-')} is not for files that are played: these hold the run "
                "as it is; drop it"
            )
