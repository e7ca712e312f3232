"""What a motion shares with another that would learn as a base first and then take over from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model.distilling import Distilling
from gsdmsr_cli.model.layer import Facts, Instant, Layer, start_layer
from gsdmsr_cli.model.parameter import Parameter

PACKAGE = __name__.rpartition(".")[0]

_BASE, _FLAG = "base.", "taken_over"


class TakingOver(Distilling):
    """A motion that is its base until it takes over; without a base it has done so from the start.

    What a subclass does itself it does while it is ``active``, and asks the methods here else.

    Args:
        own: parameters of the subclass.
        settings: name and options of the base, or None.
        facts, splats, generator: see ``start_layer``.

    Attributes:
        base: the motion that learns first, or None.
        active: whether it has taken over.
    """

    def __init__(
        self,
        own: Sequence[Parameter],
        settings: Mapping[str, Any] | None,
        facts: Facts,
        splats: Splats,
        generator: torch.Generator,
    ) -> None:
        self.base: Layer | None = None
        self.active = settings is None
        self._own = own
        self._taken_over = torch.tensor(int(self.active), dtype=torch.uint8)
        parameters = [*own, Parameter(_FLAG, self._taken_over)]
        if settings is not None:
            self.base = start_layer(PACKAGE, settings, facts, splats, generator)
            self.needs_jitter = self.base.needs_jitter
            self.identity_at_start = self.base.identity_at_start
            _refuse_what_is_not_carried(self.base, splats, str(settings["name"]))
            parameters += [replace(p, name=_BASE + p.name) for p in self.base.parameters()]
        super().__init__(parameters)

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the moved splats."""
        return self.at_instants(moment, [instant])[0]

    def at_instants(self, moment: Moment, instants: Sequence[Instant]) -> list[Moment]:
        """Return what the base makes of the splats at several times."""
        assert self.base is not None
        return self.base.at_instants(moment, instants)

    def take_over(self, count: int) -> list[str]:
        """Be active from now on, with so many splats; return the names of what was the base's."""
        self._taken_over.fill_(1)
        self.active = True
        return self._drop_base(count)

    def _drop_base(self, count: int) -> list[str]:
        """Leave nothing in the base's tensors, but rows where splats have them."""
        dropped = [p for p in self.parameters() if p.name.startswith(_BASE)]
        for parameter in dropped:
            shape = [0] * parameter.tensor.dim()
            if parameter.per_splat:
                shape[0] = count
            parameter.set_values(parameter.tensor.new_zeros(shape))
        return [parameter.name for parameter in dropped]

    def reanchor(self, splats: Splats) -> Sequence[str]:
        """Let the base adapt to where the splats are."""
        assert self.base is not None
        return [_BASE + name for name in self.base.reanchor(splats)]

    def take(self, rows: Tensor, fresh: Tensor) -> None:
        """Follow a resize: clones and children belong to what their parents do."""
        if self.base is None or self.active:
            super().take(rows, fresh)
            return
        for parameter in self._own:
            if parameter.per_splat:
                parameter.take(rows)
        self.base.take(rows, fresh)

    def advance(self, progress: float) -> None:
        """See, in a worker as well, whether it has taken over; if not, let the base go on.

        Workers are processes of a CPU; a GPU is not waited for.
        """
        self.active = self.active or (self._taken_over.is_cpu and bool(self._taken_over))
        if not self.active and self.base is not None:
            self.base.advance(progress)

    def penalty(
        self, moment: Moment, instant: Instant, generator: torch.Generator
    ) -> Tensor | None:
        """Return the base's regularisers."""
        assert self.base is not None
        return self.base.penalty(moment, instant, generator)

    def restore(self, tensors: Mapping[str, Tensor], count: int) -> None:
        """Take the values of a file, which has none of a base that was taken over from."""
        flag = tensors.get(_FLAG)
        self.active = flag is not None and bool(flag.any())
        if self.active:
            self._drop_base(count)
        super().restore(tensors, count)

    def check(self) -> None:
        """Raise ValueError unless there is a base that fits, or none is needed any more."""
        if self.active:
            return
        if self.base is None:
            raise ValueError("a motion that has a base, which the options do not name")
        self.base.check()


@torch.no_grad()
def _refuse_what_is_not_carried(base: Layer, splats: Splats, name: str) -> None:
    """Raise UsageError if a base does more than to move, turn and scale splats."""
    base.advance(1.0)
    more = ["colours that depend on the camera"] if base.needs_camera else []
    if not more:
        moment = base.at(Moment(splats), Instant(0.5))
        more += [n for n in ("axes", "features") if getattr(moment, n) is not None]
        kept = ("logit_opacities", "sh")
        more += [n for n in kept if getattr(moment.splats, n) is not getattr(splats, n)]
    base.advance(0.0)
    if more:
        raise UsageError(
            f"motion.base is '{name}', which has {' and '.join(more)} of its own; only positions, "
            "rotations and scales are taken over; name another motion"
        )
